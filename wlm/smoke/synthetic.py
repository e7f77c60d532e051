"""Procedural smoke for demos, benchmarks and the fit of the weights of `transport.orders`."""

import numpy as np
import torch
from torch.nn.functional import interpolate

from wlm.fluid.volume import DensityVolume, from_array

_BILLOWS = 160
_MOST = 1.5  # density
_REACH = 1.5  # extent of a billow relative to its radius
_HOT = 0.3  # height up to which a plume is hot
_OCTAVES = range(1, 6)
_SHAPES = ("ball", "column", "shell", "fog")


def make_plume(
    n: int = 48, *, seed: int = 1, hot: bool = True, extinction: float = 1.0, device: str = "cpu"
) -> DensityVolume:
    """Makes smoke in a box of edge 1: a leaning column of billows that widens with height.

    Args:
        n: Number of voxels along an edge of the box, at least 1.
        seed: Seed of the billows.
        hot: Whether the smoke has a temperature, which is highest at the bottom.
        extinction: Optical depth of density 1 across the box.
        device: "cpu" or "cuda:N".

    Raises:
        WlmError: The device does not exist.
    """
    random = np.random.default_rng(seed)
    axis = (np.arange(n) + 0.5) / n
    density = np.zeros((n, n, n))
    for _ in range(_BILLOWS):
        height = random.uniform(0.06, 0.82)
        wide = 0.04 + 0.16 * height
        at = np.array([0.44 + 0.14 * height, height, 0.5]) + wide * random.normal(0, 0.6, 3) * [1, 0.3, 1]
        radius = wide * random.uniform(0.25, 0.6)
        # The voxels within its reach.
        near = [np.flatnonzero(np.abs(axis - centre) <= _REACH * radius) for centre in at]
        x, y, z = ((axis[voxels] - centre) ** 2 for voxels, centre in zip(near, at, strict=True))
        distance = np.sqrt(x[:, None, None] + y[:, None] + z)
        density[np.ix_(*near)] += np.clip(_REACH - distance / radius, 0, 1)
    density = np.minimum(density, _MOST).astype(np.float32)
    temperature = density * np.clip(1.0 - axis[:, None] / _HOT, 0, 1).astype(np.float32) if hot else None
    return from_array(density, extinction=extinction, voxel=1.0 / n, temperature=temperature, device=device)


def make_billows(n: int = 48, *, seed: int = 1, extinction: float = 1.0, device: str = "cpu") -> DensityVolume:
    """Makes smoke in the shape of a ball, column, shell or fog, rotated and stretched, with edges perturbed by noise.

    Args:
        n, extinction, device: As for `make_plume`.
        seed: Seed of the shape, its softness, and the noise.

    Raises:
        WlmError: The device does not exist.
    """
    random = np.random.default_rng(seed)
    shape = _SHAPES[int(random.integers(len(_SHAPES)))]
    roughness, wisps = random.uniform(0.35, 0.75), random.uniform(0.0, 0.6)
    sharpness = float(np.exp(random.uniform(np.log(0.7), np.log(8.0))))
    noise = torch.zeros(1, 1, n, n, n)
    for octave in _OCTAVES:
        k = min(2**octave + 1, n)
        coarse = torch.from_numpy(random.standard_normal((1, 1, k, k, k), np.float32))
        noise += roughness**octave * interpolate(coarse, (n, n, n), mode="trilinear", align_corners=k > 1)
    noise /= noise.std(correction=0).clamp(min=1e-6)
    turn, _ = np.linalg.qr(random.standard_normal((3, 3)))
    radii = random.uniform(0.2, 0.5, 3)
    axis = (np.arange(n) + 0.5) / n
    place = np.stack(np.meshgrid(axis, axis, axis, indexing="ij")) - random.uniform(0.4, 0.6, (3, 1, 1, 1))
    along = np.einsum("ij,jxyz->ixyz", turn, place) / radii[:, None, None, None]
    across = np.sqrt((along[:2] ** 2).sum(0))
    away = np.sqrt(across**2 + along[2] ** 2)
    distance = {"ball": away, "column": across, "shell": 2.5 * np.abs(away - 0.7), "fog": np.full_like(away, 0.5)}[
        shape
    ]
    density = np.clip(sharpness * (1.0 - distance + wisps * noise[0, 0].numpy()), 0.0, 1.0).astype(np.float32)
    return from_array(density, extinction=extinction, voxel=1.0 / n, device=device)
