"""Lightmaps at a lower resolution, to be read bilinearly."""

import numpy as np
import scipy.sparse as sparse

from wlm.formats.exr import HALF_MAX
from wlm.texels import fill_gaps

FILTERS = ("bilinear", "box", "lanczos", "fit")
_LOBES = 3
# Of conjugate gradients: 5 are within 0.1 dB of these, and three times as many gain nothing.
_ROUNDS = 20
# Regularisation towards the box filter's result: it decides texels that no chart reads, and hardly changes any other.
_PULL = 1e-4


def fitting_size(height: int, width: int, budget: float, block: tuple[int, int], bits: float) -> tuple[int, int] | None:
    """The largest size of a given aspect ratio whose blocks are within a budget.

    Args:
        height, width: The shape, and the largest size.
        budget: Bits.
        block: Rows and columns of texels in a block, 1 and 1 for none.
        bits: Bits per texel; blocks count whole.

    Returns:
        Rows and columns; None if not even one block fits.
    """
    longest = max(height, width)
    for side in range(longest, 0, -1):
        rows, columns = (max(1, round(side * size / longest)) for size in (height, width))
        if -(-rows // block[0]) * -(-columns // block[1]) * block[0] * block[1] * bits <= budget:
            return rows, columns
    return None


def resize(lightmap: np.ndarray, mask: np.ndarray, height: int, width: int, filter: str = "fit") -> np.ndarray:
    """Makes a smaller lightmap, to be read bilinearly.

    Args:
        lightmap: [H, W, 3], finite, in [0, 65504] in the mask.
        mask: bool [H, W], true where a texel counts.
        height, width: 1 to H and 1 to W.
        filter: "bilinear" reads the lightmap at the new texels' centres; "box" averages it over their squares;
            "lanczos" has 3 lobes; "fit" has the least squared error when it is read at the mask's texels.

    Returns:
        float64 [height, width, 3] in [0, 65504]; at the lightmap's own size it is the lightmap with its gaps filled.

    Raises:
        ValueError: No such filter, or a size out of range.
    """
    if filter not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, got {filter!r}")
    if not (1 <= height <= lightmap.shape[0] and 1 <= width <= lightmap.shape[1]):
        raise ValueError(f"size: expected up to {lightmap.shape[:2]}, got {(height, width)}")
    filled = fill_gaps(lightmap, mask).astype(np.float64)
    if (height, width) == mask.shape:
        return filled
    weights = _WEIGHTS["box" if filter == "fit" else filter]
    # Separable: rows, then columns, with sparse matrices.
    rows = (weights(height, mask.shape[0]) @ filled.reshape(mask.shape[0], -1)).reshape(height, mask.shape[1], 3)
    columns = np.ascontiguousarray(rows.swapaxes(0, 1)).reshape(mask.shape[1], -1)
    small = (weights(width, mask.shape[1]) @ columns).reshape(width, height, 3).swapaxes(0, 1)
    if filter == "fit":
        small = _fit(filled, mask, small)
    return np.clip(small, 0.0, HALF_MAX)


def _fit(filled: np.ndarray, mask: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Minimises the squared error at the mask's texels by conjugate gradients, from an initial [h, w, 3]."""
    inside = mask.reshape(-1)
    read = sparse.kron(*(_bilinear(old, new) for old, new in zip(mask.shape, start.shape[:2], strict=True)), "csr")
    read = read[inside]
    normal = (read.T @ read + _PULL * sparse.identity(read.shape[1])).tocsr()
    change = np.zeros((read.shape[1], 3))
    residual = read.T @ (filled.reshape(-1, 3)[inside] - read @ start.reshape(-1, 3))
    direction, energy = residual.copy(), (residual * residual).sum(axis=0)
    for _ in range(_ROUNDS):
        image = normal @ direction
        curvature = (direction * image).sum(axis=0)
        # A channel that is solved already has a curvature of 0.
        step = np.divide(energy, curvature, out=np.zeros(3), where=curvature > 0.0)
        change += step * direction
        residual -= step * image
        before, energy = energy, (residual * residual).sum(axis=0)
        direction = residual + np.divide(energy, before, out=np.zeros(3), where=before > 0.0) * direction
    return start + change.reshape(start.shape)


def _bilinear(new: int, old: int) -> sparse.csr_matrix:
    """[new, old], reads `old` texels at the centres of `new` ones, clamped."""
    place = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(place).astype(np.int64)
    column = np.clip(np.stack([first, first + 1]), 0, old - 1)
    weight = np.stack([1.0 - (place - first), place - first])
    row = np.broadcast_to(np.arange(new), (2, new))
    return sparse.csr_matrix((weight.reshape(-1), (row.reshape(-1), column.reshape(-1))), shape=(new, old))


def _box(new: int, old: int) -> sparse.csr_matrix:
    """[new, old], means of `old` texels over the squares of `new` ones."""
    side, texel = np.arange(new + 1) * (old / new), np.arange(old)
    weight = np.minimum(side[1:, None], texel + 1.0) - np.maximum(side[:-1, None], texel)
    return _normalised(np.maximum(weight, 0.0))


def _lanczos(new: int, old: int) -> sparse.csr_matrix:
    """[new, old], a windowed sinc with the bandwidth of `new` texels."""
    scale = old / new
    x = (np.arange(old) + 0.5 - (np.arange(new) + 0.5)[:, None] * scale) / scale
    return _normalised(np.where(np.abs(x) < _LOBES, np.sinc(x) * np.sinc(x / _LOBES), 0.0))


def _normalised(weight: np.ndarray) -> sparse.csr_matrix:
    return sparse.csr_matrix(weight / weight.sum(axis=1, keepdims=True))


_WEIGHTS = {"bilinear": _bilinear, "box": _box, "lanczos": _lanczos}
