"""The score of Tencent's High Performance Rendering Competition (HPRC), as far as its rules are public.

Its README (TencentGemes/HRPC_Data) weighs the ratio of compression with 30, the time of decompression with 30, PSNR
with 20, SSIM with 10 and LPIPS with 10 points. A measure earns points in proportion between a worst and a best value,
and none or all of them beyond. PSNR, relative to the largest value, and SSIM are means over blocks of 256 x 256 texels.
The bounds here are those of an entrant's script: the organisers keep theirs in a file that isn't with the data, and may
adjust them. The script has none for the time, and LPIPS needs a trained network: these two have no points here. The
others keep theirs, 60 of 100.
"""

import math
from dataclasses import dataclass

import numpy as np

from wlm.metrics.error import psnr
from wlm.metrics.structural import ssim

BLOCK = 256
HOURS = 24
"""Lightmaps that count for the ratio; the contest decodes two more of each map, at 5.9 h and 18.1 h."""

WEIGHTS = {"ratio": 30.0, "psnr": 20.0, "ssim": 10.0}
BOUNDS = {"ratio": (0.5, 0.0), "psnr": (20.0, 55.0), "ssim": (0.73, 0.999)}
"""The values that earn no points and all."""


@dataclass(frozen=True)
class ContestScore:
    """The contest's measures and their points.

    Attributes:
        ratio: Bytes of what is decoded from, over those of the input in float32.
        psnr, ssim: Means over the blocks and times; NaN where no block has one.
        seconds: To decode all times once; no points.
        times: How many these are.
        device: Where they were decoded.
        points: Of `ratio`, `psnr` and `ssim`, NaN without a value.
        total: Their sum.
        most: What `total` can be: 60, less where a value is NaN.
    """

    ratio: float
    psnr: float
    ssim: float
    seconds: float
    times: int
    device: str
    points: dict[str, float]
    total: float
    most: float


def block_scores(ref: np.ndarray, test: np.ndarray, mask: np.ndarray) -> tuple[list[float], list[float]]:
    """PSNR and SSIM of the blocks of one lightmap.

    PSNR is that of the valid texels. For SSIM texels that aren't valid are 0 in both images, and the range is that of
    the block. A block without light has no score.

    Args:
        ref, test: `[H, W, 3]`, linear.
        mask: bool `[H, W]`, the valid texels.

    Returns:
        PSNR in dB, an exact block's capped as ours is, and SSIM, NaN for blocks below 11 x 11.

    Raises:
        WlmError: Shapes differ, or a valid texel is NaN or infinite.
    """
    decibels, similarities = [], []
    for y in range(0, mask.shape[0], BLOCK):
        for x in range(0, mask.shape[1], BLOCK):
            window = slice(y, y + BLOCK), slice(x, x + BLOCK)
            valid = mask[window]
            light, decoded = (np.where(valid[..., None], image[window], 0.0) for image in (ref, test))
            if not light.max() > 0.0:
                continue
            decibels.append(psnr(light, decoded, valid, float(light.max())))
            similarities.append(ssim(light, decoded))
    return decibels, similarities


def points_of(name: str, value: float) -> float:
    """The points of "ratio", "psnr" or "ssim"; NaN of NaN."""
    worst, best = BOUNDS[name]
    return WEIGHTS[name] * float(np.clip((value - worst) / (best - worst), 0.0, 1.0))


def contest_points(ratio: float, psnr: float, ssim: float, seconds: float, times: int, device: str) -> ContestScore:
    """Makes the score of the measures, see `ContestScore`."""
    points = {name: points_of(name, value) for name, value in (("ratio", ratio), ("psnr", psnr), ("ssim", ssim))}
    known = [name for name, value in points.items() if math.isfinite(value)]
    total, most = (sum(table[name] for name in known) for table in (points, WEIGHTS))
    return ContestScore(ratio, psnr, ssim, seconds, times, device, points, total, most)
