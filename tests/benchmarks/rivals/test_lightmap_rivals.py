"""Rivals for lightmaps: what comes back of a set, texels in gaps, and sizes and errors of blocks."""

import numpy as np
import pytest
from builders.checks import error_of, psnr
from builders.lightmaps import smooth_light
from builders.small_sets import moving_light

from benchmarks.rivals.lightmap import RIVALS, encode_set
from benchmarks.rivals.lightmap_blocks import encode_astc, encode_bc7
from benchmarks.rivals.lightmap_ntc import Latents, encode_ntc
from benchmarks.rivals.lightmap_pca import encode_pca_bc4
from benchmarks.rivals.lightmap_video import fill_smoothly
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


# One of each kind with a package that it needs; other names differ in a number.
PACKAGES = {
    "bc6h": "imagecodecs",
    "bc7": "ispc_texcomp",
    "astc4": "astc_encoder",
    "astc12": "astc_encoder",
    "pca-bc4-4": "imagecodecs",
    "av1-85": "imagecodecs",
}


def decoded(name: str, frames: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Encodes lightmaps [T, H, W, 3] at once or one by one, and decodes them."""
    method = RIVALS[name]
    if not method.alone:
        return method.encode(frames, mask).decoded
    return np.stack([method.encode(frame, mask).decoded for frame in frames])


def hours(height: int, width: int) -> np.ndarray:
    light = smooth_light(height, width)
    return np.stack([light, light[::-1]]).astype(np.float32)


@pytest.mark.parametrize("name", PACKAGES)
def test_texels_in_gaps_have_no_influence(name):
    frames, mask = hours(48, 48), np.ones((48, 48), bool)
    mask[7:30, 18:35] = False
    zeros, garbage = frames.copy(), frames.copy()
    zeros[:, ~mask] = 0.0
    garbage[:, ~mask] = np.nan
    garbage[:, 8, 20] = 1e30
    a, b = (decoded(name, given, mask) for given in (zeros, garbage))
    np.testing.assert_array_equal(a, b)
    # The ring that a filtered read reaches is like the texels beside it.
    np.testing.assert_allclose(a[:, 7, 21:32], frames[:, 6, 21:32], atol=0.12 * frames.max())


SMALL = Latents(2, 4, 4, 4)
NETWORK = 28 * 64 + 64 + 64 * 64 + 64  # weights and biases of two layers, of 4 * 4 + 4 + 8 inputs


def encode(frames: np.ndarray, mask: np.ndarray | None = None, latents=SMALL, steps: int = 150, **options):
    mask = np.ones(frames.shape[1:3], bool) if mask is None else mask
    return encode_ntc(frames, mask, latents, steps=steps, samples=256, **options)


def bytes_of(height: int, width: int, times: int, latents: Latents = SMALL) -> int:
    """Latents at their bits, the network in halves, and half ranges of one tile."""
    grids = [(-(-height // step) + 1) * (-(-width // step) + 1) for step in (latents.fine_step, latents.coarse_step)]
    latent = (grids[0] * latents.fine + 1) // 2 + grids[1] * latents.coarse
    return latent + 2 * (NETWORK + 65 * 3 * times) + 12


@pytest.mark.slow
def test_a_day_by_ntc_comes_back():
    frames = moving_light(40, 60).light.frames
    short, long = encode(frames, steps=20), encode(frames, steps=300)
    assert short.name == "ntc-latents" and short.decoded.dtype == np.float32
    mean = np.broadcast_to(frames.mean((1, 2), keepdims=True), frames.shape)
    assert psnr(frames, mean) < psnr(frames, short.decoded) < psnr(frames, long.decoded) - 3.0
    assert psnr(frames, long.decoded) > 28.0
    assert long.bytes == bytes_of(40, 60, 5) and 0 < long.disk_bytes <= long.bytes
    assert "6 bits of latents a texel, 300 steps on cpu" in long.option


def test_what_lies_in_the_gaps_changes_nothing():
    frames, mask = moving_light(24, 40).light.frames, np.ones((24, 40), bool)
    mask[7:20, 10:35] = False
    zeros, garbage = frames.copy(), frames.copy()
    zeros[:, ~mask] = 0.0
    garbage[:, ~mask] = np.nan
    a, b = (encode(given, mask, steps=80) for given in (zeros, garbage))
    np.testing.assert_array_equal(a.decoded, b.decoded)
    # The ring that a filtered read reaches is like the texels beside it; beyond it nothing is stored.
    np.testing.assert_allclose(a.decoded[:, 7, 12:33], frames[:, 6, 12:33], atol=0.25 * frames.max())
    assert not np.ptp(a.decoded[:, 9:18, 12:33], axis=(1, 2)).any()
    part, full = encode(zeros, mask, steps=2), encode(frames, steps=2)
    assert part.bytes == full.bytes and part.disk_bytes < full.disk_bytes


# One of each kind; the rest differ in a number.
KINDS = ("pca-bc4-4", "av1-85")


def day(height=72, width=140, hours=5, seed=0) -> np.ndarray:
    """Lights of three kinds, each with a rhythm of its own, and a little noise; over one tile's edge."""
    light = smooth_light(height, width)
    lights = np.stack([light, light[::-1], light[:, ::-1] ** 2])
    share = 1.0 + np.sin(np.arange(hours)[:, None] * [1.0, 2.0, 0.7])
    noise = np.random.default_rng(seed).normal(1.0, 0.01, (hours, height, width, 3))
    return (np.einsum("tk,khwc->thwc", share, lights) * noise).astype(np.float32)


@pytest.mark.parametrize("name", KINDS)
def test_a_day_comes_back(name):
    frames = day()
    rival = RIVALS[name].encode(frames, np.ones((72, 140), bool))
    assert rival.name == name and rival.decoded.dtype == np.float32
    assert psnr(frames, rival.decoded) > 36.0
    assert 0 < rival.disk_bytes <= rival.bytes < frames.nbytes / 4
    assert rival.encode_seconds > 0.0 and rival.decode_seconds > 0.0


def test_one_light_in_three_strengths_is_one_component():
    light = smooth_light(64, 64)
    frames = np.stack([light, 0.5 * light, 0.1 * light])
    blocks = encode_pca_bc4(frames, np.ones((64, 64), bool), components=1)
    # Half a byte a texel; then mean and axis of 9 halves, two floats a map, and 12 bytes of ranges.
    assert blocks.bytes == 64 * 64 // 2 + 18 + 18 + 8 + 12
    assert psnr(frames, blocks.decoded) > 42.0


def test_gaps_are_filled_smoothly():
    image, mask = smooth_light(37, 50), np.ones((37, 50), bool)
    mask[5:30, 5:45] = False
    filled = fill_smoothly(np.where(mask[..., None], image, np.float32(np.nan)), mask)
    np.testing.assert_array_equal(filled[mask], image[mask])
    # Means of what is round them.
    gap = filled[~mask]
    assert image[mask].min() <= gap.min() and gap.max() <= image[mask].max() + 1e-5
    assert np.abs(np.diff(filled[17, 5:45], axis=0)).mean() < 0.1
    assert not fill_smoothly(image, np.zeros((37, 50), bool)).any()


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
