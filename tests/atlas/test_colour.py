"""The colour texture as blocks: round trips, the ends of its range, and errors."""

import sys

import imagecodecs
import numpy as np
import pytest
import texture2ddecoder

from wlm.atlas.colour import BLOCK_CODECS, block_grid, decode, encode
from wlm.errors import WlmError


def _smooth(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width] / 20.0
    return (0.5 + (np.sin(y + 0.5) * np.cos(x) + 1.0) ** 2)[..., None] * np.array([1.0, 0.8, 0.5])


@pytest.mark.parametrize("codec", BLOCK_CODECS)
@pytest.mark.parametrize("shape", [(32, 48), (31, 45), (1, 1), (3, 9)])
def test_a_texture_comes_back(codec, shape):
    texels = _smooth(32, 48)[: shape[0], : shape[1]]
    blocks, decoded = encode(texels.astype(np.float16), codec)
    rows, columns = block_grid(*shape)
    assert blocks.dtype == np.uint8 and blocks.shape == (rows * columns, 16)
    assert decoded.dtype == np.float32 and decoded.shape == texels.shape
    np.testing.assert_allclose(decoded, texels, rtol=0.02, atol=0.02)
    np.testing.assert_array_equal(decode(blocks, *shape, codec), decoded)
    blocks.flags.writeable = False
    np.testing.assert_array_equal(decode(blocks, *shape, codec), decoded)


@pytest.mark.parametrize("codec", BLOCK_CODECS)
def test_blocks_are_row_by_row_and_padding_repeats_the_border(codec):
    texels = np.arange(1.0, 7.0).reshape(2, 3).repeat(4, 0).repeat(4, 1)[..., None].repeat(3, 2)
    blocks, _ = encode(texels, codec)
    for number, block in enumerate(blocks):
        np.testing.assert_allclose(decode(block[None], 4, 4, codec), number + 1.0, rtol=0.01)
    cut, _ = encode(texels[:5, :9], codec)
    np.testing.assert_array_equal(cut, blocks)


@pytest.mark.parametrize("codec", BLOCK_CODECS)
def test_the_range_is_clamped(codec):
    texels = np.full((4, 12, 3), -3.0)
    texels[:, 4:8] = np.inf
    texels[:, 8:] = 1e30
    _, decoded = encode(texels, codec)
    assert np.isfinite(decoded).all() and not decoded[:, :4].any()
    np.testing.assert_allclose(decoded[:, 4:], 65504.0, rtol=0.01)
    assert not encode(np.full((4, 4, 3), -np.inf), codec)[1].any()


def test_bc6h_is_what_another_decoder_reads():
    """The tone of an 8-bit decoder is its own, so only the order of the colours is compared."""
    blocks, decoded = encode(_smooth(8, 8) / 3.0, "bc6h")
    raw = imagecodecs.bcn_decode(blocks.tobytes(), 6, shape=(8, 8, 3))
    np.testing.assert_array_equal(raw.astype(np.float32), decoded)
    bgra = np.frombuffer(texture2ddecoder.decode_bc6(blocks.tobytes(), 8, 8), np.uint8).reshape(8, 8, 4)
    rgb = bgra[..., 2::-1].astype(np.float64)
    assert np.corrcoef(rgb.ravel(), np.clip(decoded, 0.0, 1.0).ravel())[0, 1] > 0.99


def test_what_is_refused():
    texels = _smooth(8, 8)
    texels[3, 2, 1] = np.nan
    with pytest.raises(ValueError, match="1 are NaN"):
        encode(texels, "astc")
    blocks, _ = encode(_smooth(8, 8), "astc")
    for bad in (blocks[:3], blocks.astype(np.int32), blocks.ravel()):
        with pytest.raises(ValueError, match=r"expected uint8 \[4, 16\]"):
            decode(bad, 8, 8, "astc")
    with pytest.raises(ValueError, match="uint8"):
        decode(blocks[:0], 0, 8, "astc")


def test_a_block_that_breaks_the_format():
    blocks, _ = encode(_smooth(8, 12), "astc")
    blocks[4] = 0  # a reserved block mode
    with pytest.raises(WlmError, match="row 1, column 1"):
        decode(blocks, 8, 12, "astc")
    # BC6H has a colour for every pattern: reserved modes are black.
    assert not decode(np.full((1, 16), 0b10011, np.uint8), 4, 4, "bc6h").any()


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "astc_encoder", None)  # makes the import fail
    with pytest.raises(WlmError, match=r"astc_encoder is missing.*wlm\[atlas\]"):
        encode(_smooth(8, 8), "astc")
