"""The block codecs on small lightmaps with known answers."""

import builtins
import sys

import imagecodecs
import numpy as np
import pytest
import texture2ddecoder
from builders.small_sets import moving_light, tiny_profile

from wlm.baselines.lightmap import RIVALS, encode_8bit, encode_astc, encode_bc6h, encode_bc7, evaluate_rivals
from wlm.errors import WlmError
from wlm.lightmap.data import from_arrays
from wlm.lightmap.fit import compress
from wlm.metrics import psnr

BITS = {"bc6h": 8.0, "bc7": 8.0, "astc10": 1.28, "astc12": 128.0 / 144.0, "8bit": 24.0}
# What each reaches at least on the smooth image below; measured 2.5 to 4 dB above.
FLOOR = {"bc6h": 61.0, "bc7": 51.0, "astc10": 50.0, "astc12": 49.0, "8bit": 54.0}


def smooth(height=120, width=120):
    y, x = np.mgrid[:height, :width] / 40.0
    base = 0.5 + (np.sin(y + 0.5) * np.cos(x) + 1.0) ** 2
    return (base[..., None] * np.array([1.0, 0.8, 0.5])).astype(np.float32)


@pytest.mark.parametrize("name", RIVALS)
def test_size_and_error(name):
    image = smooth()
    mask = np.ones(image.shape[:2], bool)
    result = RIVALS[name](image, mask)
    assert result.name == name
    assert result.decoded.shape == image.shape and result.decoded.dtype == np.float32
    # BC7 and plain 8 bits carry a float32 scale.
    assert result.bytes * 8 == pytest.approx(BITS[name] * 120 * 120 + (32 if name in ("bc7", "8bit") else 0))
    assert FLOOR[name] < psnr(image, result.decoded) < 90.0
    assert result.encode_seconds > 0.0 and result.decode_seconds > 0.0


def test_more_bits_less_error():
    # Noise, so that the blocks and not half float's rounding limit the quality.
    image = smooth() * (1.0 + 0.05 * np.random.default_rng(0).standard_normal((120, 120, 3)))
    mask = np.ones(image.shape[:2], bool)
    quality = [psnr(image, encode_astc(image, mask, block).decoded) for block in (4, 6, 8, 10, 12)]
    assert quality == sorted(quality, reverse=True)
    assert psnr(image, encode_8bit(image, mask).decoded) > psnr(image, encode_bc7(image, mask).decoded)
    low, high = (psnr(image, encode_astc(image, mask, 12, quality=q).decoded) for q in (0.0, 100.0))
    assert low < high
    low, high = (psnr(image, encode_bc6h(image, mask, profile).decoded) for profile in ("veryfast", "slow"))
    assert low < high


def test_eight_bits_by_hand():
    image = np.zeros((1, 3, 3), np.float32)
    image[0, 1], image[0, 2] = 1.0, 4.0
    decoded = encode_8bit(image, np.ones((1, 3))).decoded
    level = np.floor((1.0 / 4.0) ** (1.0 / 2.2) * 255.0 + 0.5)
    np.testing.assert_allclose(decoded[0, :, 0], [0.0, (level / 255.0) ** 2.2 * 4.0, 4.0], rtol=1e-6)


@pytest.mark.parametrize("name", RIVALS)
def test_gaps_are_filled_before_encoding(name):
    """Whatever lies outside the mask, even NaN, the valid texels come out the same."""
    image = smooth(48, 48)
    mask = np.ones((48, 48), bool)
    mask[7:30, 18:35] = False
    zeros, garbage = image.copy(), image.copy()
    zeros[~mask] = 0.0
    garbage[~mask] = np.nan
    garbage[8, 20] = 1e30
    a, b = RIVALS[name](zeros, mask), RIVALS[name](garbage, mask)
    np.testing.assert_array_equal(a.decoded, b.decoded)
    assert psnr(image, a.decoded, mask) > FLOOR[name] - 12.0


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("shape", [(130, 70), (1, 1), (5, 3)])
def test_sizes_that_no_block_divides(name, shape):
    image = smooth(130, 70)[: shape[0], : shape[1]]
    result = RIVALS[name](image, np.ones(shape, bool))
    assert result.decoded.shape == image.shape
    np.testing.assert_allclose(result.decoded, image, atol=0.25)
    assert result.bytes * 8 >= BITS[name] * image[..., 0].size - 1e-9  # padding is paid for


@pytest.mark.parametrize("name", RIVALS)
def test_empty_mask_one_texel_black_and_constant(name):
    encode = RIVALS[name]
    image = np.full((16, 16, 3), np.nan, np.float32)
    empty = np.zeros((16, 16), bool)
    assert not encode(image, empty).decoded.any()
    one = empty.copy()
    one[3, 4] = True
    image[3, 4] = [3.0, 2.0, 1.0]
    np.testing.assert_allclose(encode(image, one).decoded[3, 4], [3.0, 2.0, 1.0], rtol=0.03)
    assert not encode(np.zeros((16, 16, 3)), ~empty).decoded.any()
    np.testing.assert_allclose(encode(np.full((16, 16, 3), 0.7), ~empty).decoded, 0.7, rtol=0.01)


@pytest.mark.parametrize("name", RIVALS)
def test_the_ends_of_half_floats_range(name):
    mask = np.ones((24, 24), bool)
    bright = np.full((24, 24, 3), 60000.0)
    np.testing.assert_allclose(RIVALS[name](bright, mask).decoded, 60000.0, rtol=0.01)
    decoded = RIVALS[name](bright * 1e6, mask).decoded  # becomes 65,504, not infinity
    np.testing.assert_allclose(decoded, 65504.0, rtol=0.01)
    assert not RIVALS[name](np.full((24, 24, 3), -5.0), mask).decoded.any()


@pytest.mark.parametrize("name", RIVALS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_bad_valid_texels_are_refused(name, value):
    image = smooth(16, 16)
    image[3, 3, 1] = value
    with pytest.raises(WlmError, match="NaN or infinite"):
        RIVALS[name](image, np.ones((16, 16), bool))


def test_shapes_and_settings_are_checked():
    image, mask = smooth(16, 16), np.ones((16, 16), bool)
    for bad in (image[..., :2], image[..., 0], np.zeros((0, 16, 3))):
        with pytest.raises(WlmError, match=r"\[H, W, 3\]"):
            encode_bc6h(bad, np.ones(bad.shape[:2], bool))
    with pytest.raises(WlmError, match="mask"):
        encode_8bit(image, mask[:8])
    with pytest.raises(WlmError, match="'best'"):
        encode_bc6h(image, mask, profile="best")
    with pytest.raises(WlmError, match="'best'"):
        encode_bc7(image, mask, profile="best")
    with pytest.raises(WlmError, match="got 7"):
        encode_astc(image, mask, block=7)
    with pytest.raises(WlmError, match="quality"):
        encode_astc(image, mask, quality=101.0)


def test_a_reused_astc_context_forgets_the_last_lightmap():
    mask = np.ones((36, 36), bool)
    first = encode_astc(smooth(36, 36), mask)
    encode_astc(1000.0 * smooth(36, 36)[::-1], mask)
    again = encode_astc(smooth(36, 36), mask)
    np.testing.assert_array_equal(first.decoded, again.decoded)


@pytest.mark.parametrize(
    ("name", "package"), [("bc6h", "ispc_texcomp"), ("bc7", "imagecodecs"), ("astc12", "astc_encoder")]
)
def test_a_missing_package_names_the_extra(name, package, monkeypatch):
    monkeypatch.setitem(sys.modules, package, None)  # makes the import fail
    with pytest.raises(WlmError, match=rf"{package} is missing.*wlm\[baselines\]"):
        RIVALS[name](smooth(16, 16), np.ones((16, 16), bool))
    # Plain 8 bits need no package.
    assert encode_8bit(smooth(16, 16), np.ones((16, 16), bool)).bytes == 16 * 16 * 3 + 4


def test_bc7_is_decoded_as_another_decoder_does(monkeypatch):
    """imagecodecs against texture2ddecoder, on the very blocks that were encoded."""
    calls = []
    original = imagecodecs.bcn_decode

    def spy(data, *args, **kwargs):
        texels = original(data, *args, **kwargs)
        calls.append((builtins.bytes(data), texels))
        return texels

    monkeypatch.setattr(imagecodecs, "bcn_decode", spy)
    encode_bc7(smooth(32, 48), np.ones((32, 48), bool))
    data, texels = calls[0]
    bgra = np.frombuffer(texture2ddecoder.decode_bc7(data, 48, 32), np.uint8).reshape(32, 48, 4)
    np.testing.assert_array_equal(texels[..., :3], bgra[..., 2::-1])


def test_sets_are_scored_over_the_texels_of_the_model():
    moving = moving_light(128, 228)
    mask = moving.mask.copy()
    mask[:, 200:] = False
    lightmaps = from_arrays(moving.frames, moving.times, mask, 24.0)
    model = compress(lightmaps, tiny_profile(steps=10), tiles=[1])
    (plain, score), (_, bc6h) = evaluate_rivals(model, lightmaps, ("8bit", "bc6h"), metrics=("psnr",))
    times = len(moving.times)
    assert (plain.name, plain.decoded) == ("8bit", None) and plain.encode_seconds > 0.0 < plain.decode_seconds
    assert score.bytes == plain.bytes == times * (128 * 228 * 3 + 4) and score.bpp == pytest.approx(24.0, abs=0.01)
    assert bc6h.bpp == pytest.approx(8.0, abs=0.2) and score.to_json()["ssim"] is None
    # Not scored where the model holds nothing: noise there changes nothing.
    frames = lightmaps.frames.copy()
    frames[:, :, :128] *= 1.0 / np.random.default_rng(0).uniform(1.0, 9.0, frames[:, :, :128].shape)
    noisy = from_arrays(frames, lightmaps.times, mask, 24.0)
    ((_, again),) = evaluate_rivals(model, noisy, ("bc6h",), metrics=("psnr",))
    assert again.psnr == bc6h.psnr
    with pytest.raises(WlmError, match="unknown codec"):
        evaluate_rivals(model, lightmaps, ("jpeg",))
