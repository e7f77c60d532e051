"""Reading a tiled lightmap in float64, one point at a time, by `numpy.interp`."""

import numpy as np


def decode(uv, height: int, width: int, size: int, lut: np.ndarray, texels: np.ndarray) -> np.ndarray:
    """Light at points.

    Args:
        uv: [N, 2], finite.
        height, width: Texels of the lightmap.
        size: Texels along a tile.
        lut: int [ty, tx, 2], first texel * 16 + texels - 1, along x and y.
        texels: [Hp, Wp, 3].

    Returns:
        float64 [N, 3].
    """
    texels = np.asarray(texels, np.float64)
    return np.array([_point(at, (width, height), size, lut, texels) for at in np.asarray(uv, np.float64)])


def _point(at: np.ndarray, counts: tuple[int, int], size: int, lut: np.ndarray, texels: np.ndarray) -> np.ndarray:
    # In texels, from the first one's centre.
    place = [min(max(a * n - 0.5, 0.0), n - 1.0) for a, n in zip(at, counts, strict=True)]
    tile = [min(int(p // size), n - 1) for p, n in zip(place, lut.shape[1::-1], strict=True)]
    (x, nx), (y, ny) = (divmod(int(entry), 16) for entry in lut[tile[1], tile[0]])
    samples = texels[y : y + ny + 1, x : x + nx + 1]
    across, down = (p / size - t for p, t in zip(place, tile, strict=True))
    rows = [_between(row, across) for row in samples]
    return _between(np.array(rows), down)


def _between(samples: np.ndarray, place: float) -> np.ndarray:
    """Samples [n, 3], the outermost at 0 and 1."""
    knots = np.linspace(0.0, 1.0, len(samples)) if len(samples) > 1 else [0.0]
    return np.array([np.interp(place, knots, channel) for channel in samples.T])
