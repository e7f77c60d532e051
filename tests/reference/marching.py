"""Marching through a density grid in float64 NumPy: every sample marches to its light alone, nothing is shared."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import map_coordinates


@dataclass
class Scene:
    """A grid [X, Y, Z], its extinction per voxel, and a camera in voxels as `marching.View` has it."""

    density: np.ndarray
    extinction: float
    origin: np.ndarray
    right: np.ndarray
    up: np.ndarray
    toward: np.ndarray
    pitch: float
    height: int
    width: int
    perspective: bool = False

    def rays(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions [H, W, 3]."""
        u = (np.arange(self.width) + 0.5 - self.width / 2) * self.pitch
        v = (self.height / 2 - np.arange(self.height) - 0.5) * self.pitch
        across = u[None, :, None] * self.right + v[:, None, None] * self.up
        if self.perspective:
            d = across - self.toward
            return np.broadcast_to(self.origin, d.shape), d / np.linalg.norm(d, axis=-1, keepdims=True)
        return self.origin + across, np.broadcast_to(-self.toward, across.shape)


def trilinear(grid: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The grid at points [..., 3], voxel centres at i + 1/2, zero outside."""
    grid = np.pad(np.asarray(grid, np.float64), 1)
    return map_coordinates(grid, p.reshape(-1, 3).T + 0.5, order=1, mode="constant").reshape(p.shape[:-1])


def span(shape: tuple, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First and last distance within the smoke's support, for rays [..., 3]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (-0.5 - o) / d, (np.array(shape) + 0.5 - o) / d
    flat = np.abs(d) <= 1e-9
    inside = (o >= -0.5) & (o <= np.array(shape) + 0.5)
    near = np.where(flat, np.where(inside, -np.inf, np.inf), np.minimum(a, b))
    far = np.where(flat, np.where(inside, np.inf, -np.inf), np.maximum(a, b))
    return near.max(-1), far.min(-1)


def samples(
    scene: Scene, o: np.ndarray, d: np.ndarray, h: float
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Samples of rays [..., 3] from their origins on, in equal steps no longer than h: distances, lengths of the steps,
    and densities, 0 for a ray with fewer samples."""
    near, far = span(scene.density.shape, o, d)
    first = np.maximum(near, 0.0)
    length = np.maximum(far - first, 0.0)
    steps = np.ceil(length / h)
    dt = length / np.maximum(steps, 1)
    for n in range(int(steps.max(initial=0))):
        s = np.where(n < steps, first + (n + 0.5) * dt, 0.0)
        yield s, dt, np.where(n < steps, trilinear(scene.density, o + s[..., None] * d), 0.0)


def depth_to(scene: Scene, p: np.ndarray, toward: np.ndarray, h: float) -> np.ndarray:
    """Optical depth from points [..., 3] towards a light, in equal steps no longer than h."""
    total = np.zeros(p.shape[:-1])
    for _, dt, density in samples(scene, p, np.broadcast_to(toward, p.shape), h):
        total += density * dt
    return total * scene.extinction


def phase(g: float, cosine) -> np.ndarray:
    """Henyey and Greenstein's, times 4 pi."""
    return (1 - g * g) / (1 + g * g - 2 * g * cosine) ** 1.5


def guide(scene: Scene, step: float, g: float, threshold: float) -> np.ndarray:
    """Algorithm 1 without jitter, marching from each sample: light, transparency, depth, [3, H, W]."""
    o, d = scene.rays()
    light, t, depth = np.zeros(d.shape[:2]), np.ones(d.shape[:2]), np.zeros(d.shape[:2])
    rise = d @ scene.up
    for s, dt, density in samples(scene, o, d, step):
        p, sigma = o + s[..., None] * d, scene.extinction * density
        depth = np.where((depth == 0) & (sigma > threshold), s, depth)
        x = sigma * dt
        sides = phase(g, rise) * np.exp(-depth_to(scene, p, scene.up, step))
        sides += phase(g, -rise) * np.exp(-depth_to(scene, p, -scene.up, step))
        light += phase(g, -1.0) * t * t * (1 - np.exp(-2 * x)) / 2 + t * (1 - np.exp(-x)) * sides
        t = t * np.exp(-x)
    return np.stack([light, t, depth])


def lit(scene: Scene, toward: np.ndarray, step: float, g: float) -> np.ndarray:
    """Single scattering under one light, [H, W]."""
    o, d = scene.rays()
    light, tau = np.zeros(d.shape[:2]), np.zeros(d.shape[:2])
    for s, dt, density in samples(scene, o, d, step):
        x = scene.extinction * density * dt
        light += np.exp(-tau - depth_to(scene, o + s[..., None] * d, toward, step)) * (1 - np.exp(-x))
        tau += x
    return light * phase(g, d @ toward)


def six_way(
    scene: Scene, step: float, g: float, temperature: np.ndarray | None = None, emission: float = 0.0
) -> np.ndarray:
    """Right, left, top, bottom, front, back, transparency, emission, [8, H, W], in equal steps up to `step`."""
    corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(scene.density.shape) + 1.0) - 0.5
    depths = (corners - scene.origin) @ -scene.toward
    o, d = scene.rays()

    def steps(first: float, last: float) -> tuple[np.ndarray, float]:
        count = max(int(np.ceil((last - first) / step)), 0)
        dz = (last - first) / max(count, 1)
        return first + (np.arange(count) + 0.5) * dz, dz

    at, dz = steps(depths.min(), min(depths.max(), 0.0))
    behind = sum((trilinear(scene.density, o + s * d) for s in at), np.zeros(o.shape[:2])) * dz * scene.extinction
    parts = int(np.ceil(scene.pitch / step))
    ds = scene.pitch / parts
    # A line reaches this many steps beyond its pixels, out of the smoke.
    beyond = int((max(o.shape) * scene.pitch + np.linalg.norm(corners[-1] - corners[0])) / ds) + 1
    at, dz = steps(max(depths.min(), 0.0), depths.max())
    out = np.zeros((8, *o.shape[:2]))
    tau = np.zeros(o.shape[:2])
    for s in at:
        p = o + s * d
        x = trilinear(scene.density, p) * dz * scene.extinction
        share = np.exp(-tau) * -np.expm1(-x)
        for axis, way, ahead, back in ((1, scene.right, 0, 1), (0, -scene.up, 3, 2)):
            long = (o.shape[axis] - 1) * parts
            line = p.take(0, axis)[:, None] + (np.arange(-beyond, long + beyond) + 0.5)[:, None] * ds * way
            sums = np.cumsum(np.pad(trilinear(scene.density, line), ((0, 0), (1, 0))), 1) * ds * scene.extinction
            passed = sums[:, beyond : beyond + long + 1 : parts]
            for plane, side in ((ahead, sums[:, -1:] - passed), (back, passed)):
                out[plane] += phase(g, 0.0) * share * np.exp(-(side if axis else side.T))
        if temperature is not None:
            hot = emission * trilinear(temperature, p) * dz
            out[7] += hot * np.exp(-tau) * np.where(x > 0, (1 - np.exp(-x)) / np.where(x > 0, x, 1.0), 1.0)
        tau += x
    out[4] = phase(g, -1.0) * np.exp(-behind) * -np.expm1(-2 * tau) / 2
    out[5] = phase(g, 1.0) * tau * np.exp(-tau)
    out[6] = np.exp(-tau)
    return out
