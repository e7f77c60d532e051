"""Zstandard frames: round trip, and one line for every damaged frame."""

import re

import numpy as np
import pytest
import zstandard
from builders.checks import misuse_of

from wlm.formats.zstd import compress, decompress


@pytest.mark.parametrize("size", [0, 1, 100_000])
def test_round_trip(size):
    data = np.random.default_rng(0).integers(0, 4, size, np.uint8).tobytes()
    assert decompress(compress(data), size, "tile") == data
    packer = zstandard.ZstdCompressor(write_content_size=False)
    assert not size or decompress(packer.compress(data), size, "tile") == data


def test_damaged_frames_are_refused():
    frame = compress(bytes(5000))
    for damaged in (frame[:-1], frame + b"x", frame + frame, b"", b"no frame at all", frame[:6] + b"\xff" + frame[7:]):
        assert re.search("^tile 3: ", misuse_of(decompress, damaged, 5000, "tile 3"))


def test_frame_of_another_size_is_refused():
    with pytest.raises(ValueError, match="expected a frame of 4999 decompressed bytes, found 5000"):
        decompress(compress(bytes(5000)), 4999, "tile")
    packer = zstandard.ZstdCompressor(write_content_size=False)
    for size in (4999, 5001):
        assert re.search("^tile: ", misuse_of(decompress, packer.compress(bytes(5000)), size, "tile"))
