"""The neural texture codec on small sets with known answers."""

import numpy as np
import pytest
from builders.checks import psnr
from builders.small_sets import moving_light

from benchmarks.rivals.lightmap_ntc import Latents, encode_ntc

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
def test_a_day_comes_back():
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
