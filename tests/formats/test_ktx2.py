"""KTX2 files: the header's and descriptor's numbers, and what can't be written."""

import os
import struct

import numpy as np
import pytest

from wlm.formats.ktx2 import VK_FORMATS, write_ktx2

# Byte offsets, from the KTX specification's section on the file's structure.
FORMAT, TYPE_SIZE, WIDTH, HEIGHT, DEPTH, LAYERS, FACES, LEVELS, SCHEME = range(12, 48, 4)
DESCRIPTOR, DESCRIPTOR_BYTES, PAIRS, PAIRS_BYTES, LEVEL = 48, 52, 56, 60, 80
TEXEL = {
    "R16G16_UNORM": 4,
    "R16G16_UINT": 4,
    "R16G16_SFLOAT": 4,
    "R16G16B16_SFLOAT": 6,
    "R32G32_SFLOAT": 8,
    "R16G16B16A16_SFLOAT": 8,
    "E5B9G9R9_UFLOAT_PACK32": 4,
}
ONE, MINUS_ONE = 0x3F800000, 0xBF800000


def _data(fmt: str, width: int = 5, height: int = 3) -> bytes:
    size = width * height * TEXEL[fmt] if fmt in TEXEL else -(-width // 4) * -(-height // 4) * 16
    return np.random.default_rng(size).integers(0, 256, size, np.uint8).tobytes()


def _word(data: bytes, at: int) -> int:
    return struct.unpack_from("<I", data, at)[0]


@pytest.mark.parametrize("fmt", VK_FORMATS)
def test_the_header(tmp_path, fmt):
    path = tmp_path / "a.ktx2"
    assert write_ktx2(path, _data(fmt), 5, 3, fmt) == path.stat().st_size
    data = path.read_bytes()
    assert data[:12] == bytes([0xAB, 0x4B, 0x54, 0x58, 0x20, 0x32, 0x30, 0xBB, 0x0D, 0x0A, 0x1A, 0x0A])
    found = [_word(data, at) for at in (FORMAT, TYPE_SIZE, WIDTH, HEIGHT, DEPTH, LAYERS, FACES, LEVELS, SCHEME)]
    word = (4 if fmt.startswith(("E", "R32")) else 2) if fmt in TEXEL else 1
    assert found == [VK_FORMATS[fmt], word, 5, 3, 0, 0, 1, 1, 0]
    assert struct.unpack_from("<2Q", data, 64) == (0, 0)
    start, length, plain = struct.unpack_from("<3Q", data, LEVEL)
    assert length == plain == len(_data(fmt)) and data[start:] == _data(fmt)
    assert start % TEXEL.get(fmt, 16) == 0 and start % 4 == 0
    # Descriptor, pairs and level follow each other with less than one element of padding.
    assert _word(data, DESCRIPTOR) == 104 and _word(data, PAIRS) == 104 + _word(data, DESCRIPTOR_BYTES)
    assert 0 <= start - _word(data, PAIRS) - _word(data, PAIRS_BYTES) < 16
    pairs = data[_word(data, PAIRS) :][: _word(data, PAIRS_BYTES)]
    assert pairs == b"\x12\0\0\0KTXorientation\0rd\0\0\0\x0e\0\0\0KTXwriter\0wlm\0\0\0"
    assert os.listdir(tmp_path) == ["a.ktx2"]


@pytest.mark.parametrize(
    ("fmt", "model", "sides", "plane", "samples"),
    [
        ("R16G16_UNORM", 1, 0, 4, [(0, 15, 0, 0, 0xFFFF), (16, 15, 1, 0, 0xFFFF)]),
        ("R16G16_UINT", 1, 0, 4, [(0, 15, 0, 0, 1), (16, 15, 1, 0, 1)]),
        ("R16G16_SFLOAT", 1, 0, 4, [(0, 15, 0xC0, MINUS_ONE, ONE), (16, 15, 0xC1, MINUS_ONE, ONE)]),
        ("R32G32_SFLOAT", 1, 0, 8, [(32 * i, 31, 0xC0 + i, MINUS_ONE, ONE) for i in range(2)]),
        ("R16G16B16_SFLOAT", 1, 0, 6, [(16 * i, 15, 0xC0 + i, MINUS_ONE, ONE) for i in range(3)]),
        ("R16G16B16A16_SFLOAT", 1, 0, 8, [(16 * i, 15, 0xC0 + (i, 15)[i == 3], MINUS_ONE, ONE) for i in range(4)]),
        (
            "E5B9G9R9_UFLOAT_PACK32", 1, 0, 4,
            [pair for i in range(3) for pair in ((9 * i, 8, i, 0, 8448), (27, 4, 0x20 + i, 15, 31))],
        ),
        ("BC6H_UFLOAT_BLOCK", 133, 0x303, 16, [(0, 127, 0x80, 0, ONE)]),
        ("ASTC_4x4_SFLOAT_BLOCK", 162, 0x303, 16, [(0, 127, 0xC0, MINUS_ONE, ONE)]),
    ],
)  # fmt: skip
def test_the_data_format_descriptor(tmp_path, fmt, model, sides, plane, samples):
    path = tmp_path / "a.ktx2"
    write_ktx2(path, _data(fmt), 5, 3, fmt)
    data = path.read_bytes()
    size = _word(data, DESCRIPTOR_BYTES)
    words = struct.unpack_from(f"<{size // 4}I", data, _word(data, DESCRIPTOR))
    block = 24 + 16 * len(samples)
    # Total; vendor and type; version and size; model, BT.709, linear; sides; bytes of planes.
    assert words[:7] == (size, 0, 2 | block << 16, model | 1 << 8 | 1 << 16, sides, plane, 0) and size == 4 + block
    for i, (offset, bits, channel, lower, upper) in enumerate(samples):
        assert words[7 + 4 * i :][:4] == (offset | bits << 16 | channel << 24, 0, lower, upper)
