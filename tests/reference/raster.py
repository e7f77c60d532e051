"""Rasterizing by its definition, with how sure it is: `benchmarks.plain` says how a pixel is weighed."""

from fractions import Fraction

import numpy as np
import torch

from benchmarks.plain import corner_weights, pixel_centres


def rasterize(
    position: np.ndarray, triangle: np.ndarray, height: int, width: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """All triangles at all pixels: the one seen or -1 [H, W], b / sum(b) [H, W, 3], z / w, and how sure that is.

    How sure: the least of |b / sum |b|| over all triangles that are about to be covered or uncovered, and of the gap in
    depth behind the one seen.
    """
    p = torch.tensor(position, dtype=torch.float64)
    t = torch.tensor(triangle, dtype=torch.int64)
    b = corner_weights(p, t[:, None, None], pixel_centres(height, width)[None], height, width)
    z = (b * p[t][:, None, None, :, 2]).sum(-1) if p.shape[1] == 4 else torch.zeros(b.shape[:3], dtype=b.dtype)
    share = b / b.abs().sum(-1, keepdim=True)
    inside = (b >= 0).all(-1)
    # The one part that is least decides, be it below zero or above.
    doubt = share.amin(-1).abs()
    depth = torch.where(inside, z, torch.inf)
    order, ids = depth.sort(dim=0, stable=True)
    seen = torch.where(order[0].isfinite(), ids[0], -1)
    gap = (order[1] - order[0]).abs() if len(t) > 1 and p.shape[1] == 4 else torch.full_like(order[0], torch.inf)
    gap = torch.where(gap.isnan(), torch.inf, gap)
    at = ids[:1, ..., None].expand(1, -1, -1, 3)
    one = (b / b.sum(-1, keepdim=True)).gather(0, at)[0]
    sure = torch.minimum(doubt.amin(0), gap)
    return seen.numpy(), one.numpy(), order[0].numpy(), sure.numpy()


def covers(corners: np.ndarray, height: int, width: int) -> np.ndarray:
    """Whether a triangle in clip space, float32 [3, 4], covers each pixel, in integers without rounding: [H, W].

    A pixel on an edge counts as a little to the right, and by less down.
    """
    v = [[int(Fraction(float(corners[i, j])) * 2**149) for j in (0, 1, 3)] for i in range(3)]
    det = sum(v[0][i] * (v[1][i - 2] * v[2][i - 1] - v[1][i - 1] * v[2][i - 2]) for i in range(3))
    covered = np.full((height, width), det != 0)
    x = (2 * np.arange(width) + 1 - width).astype(object)[None] * height
    y = (height - 1 - 2 * np.arange(height)).astype(object)[:, None] * width
    for i in range(3):
        a, b = v[i - 2], v[i - 1]
        n = [(a[j - 2] * b[j - 1] - a[j - 1] * b[j - 2]) * (1 if det > 0 else -1) for j in range(3)]
        e = n[0] * x + n[1] * y + n[2] * height * width
        tie = n[0] > 0 or (n[0] == 0 and n[1] < 0)
        covered &= (e > 0) | ((e == 0) & tie)
    return covered.astype(bool)
