"""Sizes on disk."""

import numpy as np

from benchmarks.rivals.rival import disk_size, measure


def test_disk_size_is_the_shorter_of_two():
    noise = np.random.default_rng(0).bytes(500)
    assert disk_size(noise) == 500 and disk_size(b"") == 0
    assert disk_size(noise * 20) < 600


def test_what_is_measured():
    rival = measure("plain", lambda: b"ab" * 400, lambda data: data[:1], option=lambda data: data[:2].decode())
    assert (rival.bytes, rival.disk_bytes, rival.decoded, rival.option) == (800, None, b"a", "ab")
    assert measure("plain", lambda: b"ab" * 400, len, disk_bytes=disk_size).disk_bytes < 40
    assert rival.encode_seconds >= 0.0 and rival.decode_seconds >= 0.0
