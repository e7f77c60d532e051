"""The block codecs on small lightmaps with known answers."""

import numpy as np
import pytest
from builders.checks import psnr
from builders.lightmaps import smooth_light

from benchmarks.rivals.lightmap import RIVALS
from benchmarks.rivals.lightmap_blocks import encode_astc, encode_bc7

BLOCKS = {name: method.encode for name, method in RIVALS.items() if method.alone}
BITS = {f"astc{side}": 128.0 / side**2 for side in (4, 5, 6, 8, 10, 12)}
BITS |= {name: 8.0 for name in BLOCKS if name.startswith("bc")}
# What each reaches at least on the smooth image below; measured 2.5 to 4 dB above.
FLOOR = {"bc6h": 61.0, "bc7": 58.5}
FLOOR |= {"astc4": 64.5, "astc5": 63.5, "astc6": 62.5, "astc8": 60.5, "astc10": 58.0, "astc12": 56.5}
RANGES = 12  # bytes of a tile's range


@pytest.mark.parametrize("name", BLOCKS)
def test_size_and_error(name):
    image = smooth_light()
    result = BLOCKS[name](image, np.ones((120, 120), bool))
    assert result.name == name and result.size == (120, 120)
    assert result.decoded.shape == image.shape and result.decoded.dtype == np.float32
    ranges = RANGES if name == "bc7" or result.option == "LDR" else 0
    assert result.bytes - ranges == pytest.approx(BITS[name] / 8 * 120 * 120)
    assert 0 < result.disk_bytes < 0.95 * result.bytes
    assert FLOOR[name] < psnr(image, result.decoded) < 90.0
    assert result.encode_seconds > 0.0 and result.decode_seconds > 0.0


def test_a_range_for_each_tile():
    """A dim tile beside a bright one: with one scale for both its levels would be 70 times as coarse."""
    image = np.concatenate([1e-4 * smooth_light(128, 128), smooth_light(128, 128)], axis=1)
    mask = np.ones((128, 256), bool)
    for encode in (encode_bc7, lambda *args: encode_astc(*args, 6, profile="ldr")):
        result = encode(image, mask)
        dim, bright = (psnr(image[:, side], result.decoded[:, side]) for side in (slice(0, 128), slice(128, 256)))
        assert dim == pytest.approx(bright, abs=0.6)


def test_astc_takes_the_better_profile():
    mask = np.ones((48, 48), bool)
    assert encode_astc(smooth_light(48, 48), mask).option == "LDR"
    # A ramp over four decades: HDR's interpolation is nearly logarithmic.
    ramp = np.broadcast_to(10.0 ** (np.arange(48) / 12.0), (48, 48))[..., None] * [1.0, 0.8, 0.5]
    rivals = {profile: encode_astc(ramp, mask, profile=profile) for profile in ("ldr", "hdr", "best")}
    quality = {profile: psnr(ramp, rival.decoded) for profile, rival in rivals.items()}
    assert rivals["best"].option == "HDR" and quality["best"] == quality["hdr"] > quality["ldr"] + 1.0


@pytest.mark.parametrize("name", BLOCKS)
@pytest.mark.parametrize("shape", [(53, 34), (1, 1), (5, 3)])
def test_sizes_that_no_block_divides(name, shape):
    image = smooth_light(53, 34)[: shape[0], : shape[1]]
    result = BLOCKS[name](image, np.ones(shape, bool))
    assert result.decoded.shape == image.shape
    np.testing.assert_allclose(result.decoded, image, atol=0.25)
    assert result.bytes * 8 >= BITS[name] * image[..., 0].size - 1e-9  # padding is paid for
