"""The first centres and scales of a fit's Gaussians (gaussian-probe-compression, section 3.2)."""

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 9  # probes whose spread is the local spread of one of them
_PIECE = 4096  # probes per piece
_ROUNDS = 4  # of k-means where the draw follows detail, which more rounds would undo
_PLAIN_ROUNDS = 20  # of k-means where the draw is uniform
_FLOOR = 0.05  # smallest local spread, as a share of the mean
_SMALLEST = 1e-4  # smallest first scale, as a share of the box


def local_spread(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Measures how much the light varies around each probe.

    Args:
        x: [N, 3].
        values: [N, D].

    Returns:
        float64 [N], positive: the standard deviation over each probe and its eight nearest, plus a small floor.
    """
    near = cKDTree(x).query(x, k=min(_NEIGHBOURS, len(x)))[1].reshape(len(x), -1)
    # In pieces: all neighbours' numbers at once would be nine times the set.
    pieces = (near[start : start + _PIECE] for start in range(0, len(near), _PIECE))
    spread = np.concatenate([np.sqrt(values[piece].astype(np.float64).var(1).sum(1)) for piece in pieces])
    floor = _FLOOR * spread.mean()
    return spread + (floor if floor > 0 else 1.0)


def first_gaussians(
    x: np.ndarray, values: np.ndarray, count: int, detail: float, first_scale: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Places centres by k-means that starts where the light varies, with scales from the nearest other centre.

    Args:
        x: float32 [N, 3], normalised positions.
        values: float32 [N, D].
        count: Number of Gaussians; there are never more than distinct positions.
        detail, first_scale: See `wlm.probe.model.Profile`.
        random: Source of the draw.

    Returns:
        Centres, float64 [K, 3], and scales, float64 [K].
    """
    distinct, index = np.unique(x, axis=0, return_index=True)
    count = min(count, len(distinct))
    if count == len(distinct):
        centre = distinct.astype(np.float64)
    else:
        weight = local_spread(x, values)[index] ** detail
        centre = distinct[random.choice(len(distinct), count, replace=False, p=weight / weight.sum())]
        centre = _kmeans(x.astype(np.float64), centre.astype(np.float64), _ROUNDS if detail > 0 else _PLAIN_ROUNDS)
    if count == 1:
        return centre, np.array([max(np.linalg.norm(x - centre, axis=1).max(), _SMALLEST)])
    nearest = cKDTree(centre).query(centre, k=2)[0][:, 1]
    return centre, np.maximum(first_scale * nearest, _SMALLEST)


def _kmeans(x: np.ndarray, centre: np.ndarray, rounds: int) -> np.ndarray:
    for _ in range(rounds):
        label = cKDTree(centre).query(x)[1]
        size = np.bincount(label, minlength=len(centre))
        total = np.stack([np.bincount(label, x[:, axis], len(centre)) for axis in range(3)], 1)
        # A centre that is nearest to no probe keeps its position.
        centre = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], centre)
    return centre
