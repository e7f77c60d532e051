"""BC7 of all modes against two other decoders, bit for bit."""

import sys

import imagecodecs
import numpy as np
import pytest
import texture2ddecoder
from builders.synthetic import any_blocks

from wlm.errors import WlmError
from wlm.formats.bc7 import blocks_image
from wlm.formats.bc7_modes import RESERVED, block_modes, decode_blocks, encode_image

ROWS, COLUMNS = 64, 96


def test_two_other_decoders_agree_bit_for_bit():
    blocks = any_blocks(ROWS, COLUMNS, seed=3)
    assert np.array_equal(np.bincount(block_modes(blocks).ravel()), [ROWS * COLUMNS // 8] * 8)
    found, shape = blocks_image(decode_blocks(blocks)), (4 * ROWS, 4 * COLUMNS, 4)
    assert np.array_equal(found, imagecodecs.bcn_decode(blocks.tobytes(), 7, shape=shape))
    bgra = texture2ddecoder.decode_bc7(blocks.tobytes(), 4 * COLUMNS, 4 * ROWS)
    assert np.array_equal(found, np.frombuffer(bgra, np.uint8).reshape(shape)[..., [2, 1, 0, 3]])


@pytest.mark.parametrize("mode", [0, 1, 2, 3, 7])
def test_every_partition_is_read(mode):
    """The number of a partition is in the bits above those of the mode."""
    rng, count = np.random.default_rng(mode), 16 if mode == 0 else 64
    blocks = rng.integers(0, 256, (count, 64, 16), np.uint8)
    number = np.arange(count, dtype=np.uint16)[:, None] << mode + 1
    low = blocks[..., 0].astype(np.uint16) | blocks[..., 1].astype(np.uint16) << 8
    low = low & ~np.uint16((2 * count << mode) - 1) | number | np.uint16(1 << mode)
    blocks[..., 0], blocks[..., 1] = low & 255, low >> 8
    expected = imagecodecs.bcn_decode(blocks.tobytes(), 7, shape=(4 * count, 256, 4))
    assert np.array_equal(blocks_image(decode_blocks(blocks)), expected)


def test_what_is_of_no_mode_is_black():
    blocks = any_blocks(4)
    blocks[2, 0] = 0
    assert block_modes(blocks).tolist() == [0, 1, RESERVED, 3]
    assert not decode_blocks(blocks)[2].any() and decode_blocks(blocks)[3].any()
    with pytest.raises(ValueError, match="expected blocks uint8"):
        decode_blocks(blocks[:, :15])


def test_an_encoded_picture_is_near(monkeypatch):
    v, u = np.mgrid[:64, :32] / 64.0
    picture = (255 * np.stack([u, v, u * v], 2)).astype(np.uint8)
    blocks = encode_image(picture, "frames")
    assert blocks.shape == (16, 8, 16)
    apart = blocks_image(decode_blocks(blocks)).astype(int)[..., :3] - picture
    assert np.abs(apart).max() <= 3 and not (block_modes(blocks) == RESERVED).any()
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    with pytest.raises(
        WlmError, match=r"^frames: ispc_texcomp is missing; needs the extra: pip install 'wlm.frames.'$"
    ):
        encode_image(picture, "frames")
