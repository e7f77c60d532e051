"""Patches of triangles, their distances and the greedy groups, in float64 NumPy with the whole matrix of pairs."""

from itertools import permutations

import numpy as np

ORDERS = tuple(permutations(range(3)))


def bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Samples [H, W, C] at texels (x, y), 0 at the first one's centre, clamped: [N, C]."""
    height, width = image.shape[:2]
    x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
    left, top = np.floor(x).astype(int), np.floor(y).astype(int)
    right, low = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    fx, fy = (x - left)[:, None], (y - top)[:, None]
    upper = image[top, left] * (1 - fx) + image[top, right] * fx
    lower = image[low, left] * (1 - fx) + image[low, right] * fx
    return upper * (1 - fy) + lower * fy


def barycentrics(size: int) -> np.ndarray:
    """Returns the barycentric coordinates of a patch's samples in their stored order, [N, 3]."""
    return np.array([(i, j, size - 1 - i - j) for j in range(size) for i in range(size - j)]) / (size - 1)


def patch(image: np.ndarray, corners: np.ndarray, size: int) -> np.ndarray:
    """Samples a triangle with corners [3, 2], in texels from the first one's centre: [N, C]."""
    at = barycentrics(size) @ corners
    return bilinear(image, at[:, 0], at[:, 1])


def reordered(samples: np.ndarray, size: int, order: tuple[int, int, int]) -> np.ndarray:
    """The patch [N, ...] of the triangle whose vertex `order[k]` is this one's vertex k (section 3.1, figure 3)."""
    lattice = np.rint(barycentrics(size) * (size - 1)).astype(int)
    index = {tuple(weights): i for i, weights in enumerate(lattice.tolist())}
    return samples[[index[tuple(weights)] for weights in lattice[:, list(order)].tolist()]]


def dominant(levels: np.ndarray) -> tuple[int, int, int]:
    """The commonest of 32 x 32 x 32 bins of 8-bit colours [N, 3], the lowest of equals."""
    counts: dict[tuple[int, int, int], int] = {}
    for colour in levels:
        key = tuple(int(c) // 8 for c in colour)
        counts[key] = counts.get(key, 0) + 1
    return min(counts, key=lambda key: (-counts[key], key))


def _doubled(grid: np.ndarray) -> np.ndarray:
    """Puts a sample between every two neighbours of the lattice, by their mean."""
    made = np.full((2 * len(grid) - 1, 2 * len(grid) - 1, 3), np.nan)
    made[::2, ::2] = grid
    made[1::2, ::2], made[::2, 1::2] = (grid[1:] + grid[:-1]) / 2, (grid[:, 1:] + grid[:, :-1]) / 2
    made[1::2, 1::2] = (grid[1:, :-1] + grid[:-1, 1:]) / 2
    return made


def upsampled(samples: np.ndarray, size: int, target: int) -> np.ndarray:
    """The colours at the first two weights of a larger lattice, [T, T, 3], NaN beyond it."""
    made = np.full((size, size, 3), np.nan)
    made[*np.rint(barycentrics(size)[:, :2] * (size - 1)).astype(int).T] = samples
    while len(made) < target:
        made = _doubled(made)
    return made


def distances(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Dist of 8-bit patches [N, 3] and [N', 3] (eq. 2) with vertex k of b on vertex p[k] of a, in all six orders."""
    sizes = [round((2 * len(values)) ** 0.5 - 0.5) for values in (a, b)]
    a, b = (upsampled(values, size, max(sizes)) for values, size in zip((a, b), sizes, strict=True))
    at = np.rint(barycentrics(len(a)) * (len(a) - 1)).astype(int).T
    return np.array([np.abs(a[at[0], at[1]] - b[at[p[0]], at[p[1]]]).mean() / 255 for p in ORDERS])


def adjacency(patches: list[np.ndarray], threshold: float, colour_threshold: float) -> np.ndarray:
    """Which patches are alike, bool [M, M], false on the diagonal (eq. 3 to 5)."""
    bins = np.array([dominant(levels) for levels in patches]).reshape(-1, 3)
    edges = np.zeros((len(patches), len(patches)), bool)
    for i in range(len(patches)):
        for j in range(i):
            if np.linalg.norm((bins[i] - bins[j]) / 32) <= colour_threshold:
                edges[i, j] = edges[j, i] = distances(patches[i], patches[j]).min() < threshold
    return edges


def greedy(edges: np.ndarray) -> list[tuple[int, list[int]]]:
    """The groups, each with who represents it, as they are taken; single ones last (section 3.2.2)."""
    left, groups = list(range(len(edges))), []
    while left:
        degree = [int(edges[v, left].sum()) for v in left]
        chosen = left[degree.index(max(degree))]
        group = [v for v in left if v == chosen or edges[v, chosen]]
        groups.append((chosen, group))
        left = [v for v in left if v not in group]
    return groups
