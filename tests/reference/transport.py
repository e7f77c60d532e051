"""Light scattered twice in a density grid, by quadrature in float64 NumPy; `marching.py` has light scattered once."""

import numpy as np

from reference.marching import Scene, depth_to, phase, span, trilinear


def directions(polar: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions [N, 3] over the sphere and their weights, which add up to 1: Gauss's in height, even around."""
    height, weight = np.polynomial.legendre.leggauss(polar)
    turn = (np.arange(around) + 0.5) * 2 * np.pi / around
    z, phi = np.meshgrid(height, turn, indexing="ij")
    across = np.sqrt(1 - z * z)
    ways = np.stack([across * np.cos(phi), across * np.sin(phi), z], -1).reshape(-1, 3)
    return ways, np.repeat(weight / 2 / around, around)


def _samples(scene: Scene, o: np.ndarray, d: np.ndarray, h: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [K, ..., 3] along rays [..., 3], and the share of light that each scatters towards the ray's start."""
    near, far = span(scene.density.shape, o, d)
    first = np.maximum(near, 0.0)
    length = np.maximum(far - first, 0.0)
    count = max(int(np.ceil(length.max() / h)), 1)
    s = first + (np.arange(count).reshape(-1, *[1] * length.ndim) + 0.5) * length / count
    p = o + s[..., None] * d
    x = scene.extinction * trilinear(scene.density, p) * length / count
    before = np.cumsum(x, 0) - x
    return p, np.exp(-before) * (1 - np.exp(-x))


def scattered_twice(scene: Scene, toward: np.ndarray, g: float, h: float, polar: int, around: int) -> np.ndarray:
    """Light of a light of irradiance 4 pi, scattered exactly twice, at albedo 1, [H, W]."""
    ways, weights = directions(polar, around)
    out = np.zeros((scene.height, scene.width))
    origins, rays = scene.rays()
    for pixel in np.ndindex(out.shape):
        d = rays[pixel]
        points, share = _samples(scene, origins[pixel], d, h)
        # From each point in all directions: the light that is scattered there towards the point.
        p, again = _samples(scene, points[:, None], np.broadcast_to(ways, (len(points), *ways.shape)), h)
        lit = np.exp(-depth_to(scene, p, toward, h)) * phase(g, ways @ toward)
        inner = ((again * lit).sum(0) * phase(g, ways @ d) * weights).sum(1)
        out[pixel] = (share * inner).sum()
    return out
