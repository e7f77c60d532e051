"""Rivals of whole sets: their names, sizes and scores."""

import numpy as np
import pytest
from builders.checks import error_of, psnr
from builders.small_sets import moving_light

from benchmarks.rivals.lightmap import encode_set
from benchmarks.rivals.rival import disk_size, measure


def test_a_set_goes_through_a_method_time_by_time():
    moving = moving_light(40, 60).light
    visited = []

    def visit(i, decoded):
        assert decoded.shape == (40, 60, 3) and decoded.dtype == np.float32
        visited.append(i)
        return psnr(moving.frames[i], decoded)

    for name in ("bc7", "pca-bc4-4", "av1-85"):
        visited.clear()
        rival, scores = encode_set(name, moving, visit)
        assert visited == list(range(5)) and min(scores) > 22.0
        assert rival.name == name and rival.decoded is None
        # Of some of the times: sizes and seconds are of all, estimated or measured.
        visited.clear()
        part, some = encode_set(name, moving, visit, [1, 3])
        assert visited == [1, 3] and some == [scores[1], scores[3]]
        assert part.bytes == rival.bytes and part.disk_bytes == pytest.approx(rival.disk_bytes, rel=0.05)
        assert part.encode_seconds > 0.0
    assert "unknown method 'jpeg'" in error_of(encode_set, "jpeg", moving, visit)


def test_what_is_measured():
    rival = measure("plain", lambda: b"ab" * 400, lambda data: data[:1], option=lambda data: data[:2].decode())
    assert (rival.bytes, rival.disk_bytes, rival.decoded, rival.option) == (800, None, b"a", "ab")
    assert measure("plain", lambda: b"ab" * 400, len, disk_bytes=disk_size).disk_bytes < 40
    assert rival.encode_seconds >= 0.0 and rival.decode_seconds >= 0.0
