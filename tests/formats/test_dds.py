import os
import struct

import numpy as np
import pytest
from PIL import Image

from wlm.formats.bc7 import decode_image
from wlm.formats.dds import DXGI_FORMATS, write_dds

# Byte offsets, from Microsoft's description of DDS_HEADER and DDS_HEADER_DXT10.
FLAGS, HEIGHT, WIDTH, PITCH, DEPTH, MIPS = 8, 12, 16, 20, 24, 28
PIXEL_FLAGS, FOUR_CC, CAPS, CAPS2 = 80, 84, 108, 112
FORMAT, DIMENSION, MISC, ARRAY, ALPHA = 128, 132, 136, 140, 144
FOUR_BYTES = "R16G16_FLOAT R16G16_UNORM R16G16_UINT R9G9B9E5_SHAREDEXP R10G10B10A2_UNORM R11G11B10_FLOAT R8G8B8A8_UNORM"
FOUR_BYTES = FOUR_BYTES.split()


def _blocks(count: int) -> bytes:
    blocks = np.random.default_rng(9).integers(0, 256, (count, 16), np.uint8)
    blocks[:, 0] = blocks[:, 0] & 0x80 | 0x40
    return blocks.tobytes()


def _field(data: bytes, at: int) -> int:
    return struct.unpack_from("<I", data, at)[0]


def test_pillow_reads_the_same_picture(tmp_path):
    path = tmp_path / "a.dds"
    write_dds(path, _blocks(6 * 4), width=24, height=16, fmt="BC7_UNORM")
    expected = decode_image(np.frombuffer(_blocks(24), np.uint8).reshape(4, 6, 16))
    with Image.open(path) as image:
        assert image.mode == "RGBA" and np.array_equal(np.asarray(image), expected)


TEXELS = np.arange(15 + 2 + 1, dtype="<u4").tobytes()  # 5x3, 2x1, 1x1


@pytest.mark.parametrize(
    ("texels", "options", "fields"),
    [
        (
            _blocks(6 * 4),
            {"width": 22, "height": 13, "fmt": "BC7_UNORM_SRGB"},
            {4: 124, FLAGS: 0x81007, HEIGHT: 13, WIDTH: 22, PITCH: 384, DEPTH: 0, MIPS: 1, 76: 32, PIXEL_FLAGS: 4}
            | {CAPS: 0x1000, CAPS2: 0, FORMAT: 99, DIMENSION: 3, MISC: 0, ARRAY: 1, ALPHA: 0},
        ),
        (
            TEXELS,
            {"width": 5, "height": 3, "fmt": "R9G9B9E5_SHAREDEXP", "mips": 2},
            {FLAGS: 0x2100F, PITCH: 20, MIPS: 3, CAPS: 0x401008, FORMAT: 67},
        ),
        (
            _blocks(2 * 3 * 5),
            {"width": 8, "height": 12, "depth": 5, "fmt": "BC7_UNORM"},
            {FLAGS: 0x881007, PITCH: 96, DEPTH: 5, CAPS: 0x1008, CAPS2: 0x200000, DIMENSION: 4},
        ),
        # DDSD_PITCH and the bytes of a row take the place of DDSD_LINEARSIZE and those of the texture.
        (bytes(range(30)), {"width": 3, "height": 5, "fmt": "R8G8_UNORM"}, {PITCH: 6, FORMAT: 49, DIMENSION: 3}),
        # DDSCAPS_COMPLEX, and the size of an array.
        (
            _blocks(6),
            {"width": 8, "height": 4, "layers": 3, "fmt": "BC7_UNORM"},
            {CAPS: 0x1008, CAPS2: 0, DEPTH: 0, DIMENSION: 3, ARRAY: 3},
        ),
    ],
)
def test_the_header(tmp_path, texels, options, fields):
    path = tmp_path / "a.dds"
    write_dds(path, texels, **options)
    data = path.read_bytes()
    assert {at: _field(data, at) for at in fields} == fields and data[148:] == texels
    assert data[:4] == b"DDS " and data[FOUR_CC : FOUR_CC + 4] == b"DX10"


@pytest.mark.parametrize("fmt", DXGI_FORMATS)
@pytest.mark.parametrize("depth", [0, 3])
def test_every_format(tmp_path, fmt, depth):
    path = tmp_path / "a.dds"
    texel = {"R32G32B32A32_FLOAT": 16, "R8G8_UNORM": 2, "R8_UNORM": 1} | dict.fromkeys(FOUR_BYTES, 4)
    texel |= dict.fromkeys(("R16G16B16A16_FLOAT", "R16G16B16A16_UINT"), 8)
    texel = texel.get(fmt)
    blocks = _blocks(60)[: (5 * 4 * texel if texel else 2 * 16) * (depth or 1)]
    write_dds(path, blocks, width=5, height=4, depth=depth, fmt=fmt)
    data = path.read_bytes()
    assert struct.unpack_from("<2I", data, 12) == (4, 5) and data[148:] == blocks
    assert struct.unpack_from("<I", data, 128) == (DXGI_FORMATS[fmt],)
    assert [_field(data, at) for at in (DEPTH, DIMENSION)] == ([depth, 4] if depth else [0, 3])
    assert os.listdir(tmp_path) == ["a.dds"]
