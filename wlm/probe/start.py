"""Where a fit begins: the Gaussians' first places and sizes (gaussian-probe-compression, section 3.2)."""

import numpy as np
from scipy.spatial import cKDTree

__all__ = ["first_gaussians", "local_spread", "morton_order"]

_BITS = 10  # of each coordinate in a Morton code
_NEIGHBOURS = 9  # that a probe's surroundings are judged by, itself among them
_ROUNDS = 4  # of k-means; more undo what the draw gave to detail
_PLAIN_ROUNDS = 20  # without it
_FLOOR = 0.05  # of the mean spread, below which no surroundings fall
_SMALLEST = 1e-4  # of the box: first scales are no smaller


def morton_order(x: np.ndarray) -> np.ndarray:
    """Order of points [N, 3] of the unit cube along a Z-curve, int [N]; ties keep their order."""
    cell = np.clip(x * (2**_BITS - 1), 0, 2**_BITS - 1).astype(np.uint64)
    code = np.zeros(len(x), np.uint64)
    for bit in range(_BITS):
        for axis in range(3):
            code |= (cell[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")


def local_spread(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """How much the light varies round each probe.

    Args:
        x: [N, 3].
        values: [N, D].

    Returns:
        float64 [N], the deviation over each probe and its eight nearest, plus a little everywhere; positive.
    """
    near = cKDTree(x).query(x, k=min(_NEIGHBOURS, len(x)))[1].reshape(len(x), -1)
    # In pieces: all neighbours' numbers at once would be nine times the set.
    spread = np.concatenate([np.sqrt(values[part].astype(np.float64).var(1).sum(1)) for part in _pieces(near)])
    floor = _FLOOR * spread.mean()
    return spread + (floor if floor > 0 else 1.0)


def _pieces(array: np.ndarray, size: int = 4096):
    return [array[at : at + size] for at in range(0, len(array), size)]


def first_gaussians(
    x: np.ndarray, values: np.ndarray, count: int, detail: float, first_scale: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Centres by k-means on the positions, begun where the light varies, and scales from the nearest centre.

    Args:
        x: float32 [N, 3], normalised positions.
        values: float32 [N, D].
        count: Gaussians that are wanted; no more than there are distinct positions are made.
        detail, first_scale: See ``wlm.probe.model.Profile``.
        random: Where the draw comes from.

    Returns:
        Centres float64 [K, 3] and scales float64 [K].
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
        # One that no probe is nearest to stays where it is.
        centre = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], centre)
    return centre
