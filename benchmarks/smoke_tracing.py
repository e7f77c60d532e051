"""Path-traced pictures of smoke: light of every order of scattering, separately for each light.

This is the reference for other methods: it has no bias, and noise with an estimate of its size.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from benchmarks import smoke_path
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, free_memory, stream, to_warp
from wlm.smoke.camera import Camera
from wlm.smoke.march.launch import medium_of
from wlm.smoke.shading import AnyLight, checked_albedo, checked_colour, in_voxels
from wlm_kernels.smoke.march import View

HIGHEST = 100_000
"""Number of scatterings after which a path always ends."""

_PARTS = 16  # parts of the samples, whose spread gives the noise
_BYTES = 2**31  # largest memory of the parts that are traced at once; also at most a quarter of the free memory
_DENSEST = 1e4  # largest optical depth of a voxel; in denser smoke paths would take far too long


@dataclass(frozen=True, eq=False)
class Transport:
    """Linear light that smoke sends to a camera with H x W pixels, from S light sources separately.

    Attributes:
        planes: float32 tensor [S, orders + 2, H, W, 3]: for each source the light that was scattered 0, 1, ... `orders`
            times, and last the light that was scattered more often. If the albedo is multiplied by a, the light of
            order n is multiplied by a^n.
        sources: Names of the sources: "light 1" and so on, "sky" and "emission".
        noise: float32 tensor [S, H, W, 3], standard error of the sum of all planes of each source.
        total_noise: float32 tensor [H, W, 3], standard error of `total`, larger than for sources with independent
            paths, since sources share their paths.
        albedo: Albedo of the smoke, R, G, B.
        camera: Camera of the images.
        samples: Number of paths per pixel.
    """

    planes: torch.Tensor
    sources: tuple[str, ...]
    noise: torch.Tensor
    total_noise: torch.Tensor
    albedo: tuple[float, float, float]
    camera: Camera
    samples: int

    @property
    def orders(self) -> int:
        """Number of orders of scattering with separate planes."""
        return self.planes.shape[1] - 2

    @property
    def total(self) -> torch.Tensor:
        """Sum of all light of all sources, [H, W, 3]."""
        return self.planes.sum((0, 1))

    @property
    def error(self) -> float:
        """Root mean square of the standard error of `total`, relative to `total`; 0 for a black picture."""
        power = float(self.total.double().square().mean())
        return math.sqrt(float(self.total_noise.double().square().mean()) / power) if power > 0 else 0.0


def trace(
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight] = (),
    *,
    sky: Sequence[float] | None = None,
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    g: float = 0.0,
    samples: int = 64,
    orders: int = 1,
    highest: int = HIGHEST,
    obstacles: tuple[np.ndarray, np.ndarray] | None = None,
    seed: int = 0,
) -> Transport:
    """Traces paths from the camera through the smoke.

    Args:
        volume: The smoke; emission of hot smoke is a light source too.
        camera: Any camera, outside the smoke or inside. Paths go through pixel centres, like rays of a march.
        lights: Any number of lights.
        sky: R, G, B, radiance from all directions, also visible behind the smoke; None: black.
        albedo: R, G, B, share of light that survives a scattering, 0 to 1.
        g: Mean cosine of the Henyey-Greenstein phase function, between -1 and 1.
        samples: Number of paths per pixel, at least 1. With 1 the noise is unknown and returned as infinite.
        orders: Number of orders of scattering with separate planes.
        highest: Number of scatterings after which a path ends; 1 is single scattering.
        obstacles: Corners [V, 3] in the world and triangles [F, 3] that absorb all light; None: none.
        seed: An integer of at least 0; the same seed gives the same result on one kind of device.

    Returns:
        The light on the smoke's device.

    Raises:
        ValueError: A setting is out of its range.
        WlmError: The smoke is too dense, or the planes do not fit into the memory.
    """
    if not -1 < g < 1:
        raise ValueError(f"g: expected a mean cosine above -1 and below 1, got {g}")
    for name, value, least in (
        ("samples", samples, 1),
        ("orders", orders, 0),
        ("highest", highest, 0),
        ("seed", seed, 0),
    ):
        if value < least:
            raise ValueError(f"{name}: expected at least {least}, got {value}")
    colour = checked_albedo(albedo)
    device = device_name(volume.device)
    with stream(device):
        medium = medium_of(volume)
        densest = float(volume.density.max()) * medium.extinction
        if not densest <= _DENSEST:
            raise WlmError(f"smoke: expected optical depths of at most {_DENSEST:g} per voxel, found {densest:.4g}")
        majorants = smoke_path.bounds(medium, densest)
        lamps = smoke_path.make_lights([in_voxels(light, volume) for light in lights])
        lamps = wp.array(lamps, dtype=smoke_path.PathLight, device=device)
        mesh = None if obstacles is None or not len(obstacles[1]) else _mesh(obstacles, volume, device)
        settings = smoke_path.PathSettings()
        settings.albedo, settings.g = wp.vec3(*map(float, colour)), float(g)
        settings.sky = wp.vec3(*map(float, checked_colour("sky", sky or (0.0, 0.0, 0.0))))
        settings.highest, settings.kept, settings.samples = min(highest, HIGHEST), orders, samples
        settings.key = wp.uint64(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
        view, parts = camera.view(volume), min(_PARTS, samples)
        sources, kept = len(lights) + 2, orders + 2
        planes = sources * kept
        room = min(_BYTES, free_memory(wp.get_device(device)) // 4)
        at_once = 1 if device == "cpu" else max(1, min(parts, room // (12 * planes * view.height * view.width)))
        _require(planes, sources, view, parts, at_once, device)
        total = torch.zeros((sources, kept, view.height, view.width, 3), device=volume.device)
        means = []
        for first in range(0, parts, at_once):
            count = min(at_once, parts - first)
            size = (count * planes, view.height, view.width, 3)
            out = torch.zeros(size, device=volume.device)
            arguments = (lamps, 0 if mesh is None else mesh.id, settings, first, parts)
            smoke_path.trace(medium, view, majorants, *arguments, to_warp(out, wp.vec3))
            each = out.reshape(count, *total.shape)
            total += each.sum(0)
            means.append(each.sum(2))
        means = torch.cat(means)
        noise, total_noise = _noise(means, samples), _noise(means.sum(1), samples)
    names = [f"light {n + 1}" for n in range(len(lights))] + ["sky", "emission"]
    there = [*range(len(lights)), *([len(lights)] * (sky is not None))]
    there += [len(lights) + 1] * (volume.temperature is not None)
    picked = torch.tensor(there, dtype=torch.long, device=volume.device)
    chosen = tuple(names[n] for n in there)
    return Transport(total[picked], chosen, noise[picked], total_noise, tuple(map(float, colour)), camera, samples)


def _require(planes: int, sources: int, view: View, parts: int, at_once: int, device: str) -> None:
    """Checks before the tracing that the planes fit into the free memory; raises a WlmError otherwise."""
    # The traced parts, their sum, the selected planes and their sums; the means and their spread.
    needed = 12 * view.height * view.width * (planes * (at_once + 3) + 3 * sources * parts)
    free = free_memory(wp.get_device(device))
    if needed > free:
        raise WlmError(
            f"orders: {planes} planes of {view.height} x {view.width} pixels need {needed / 2**30:.1f} GiB on {device},"
            f" but only {free / 2**30:.1f} GiB are free: use fewer orders or pixels"
        )


def _noise(means: torch.Tensor, samples: int) -> torch.Tensor:
    """Returns the standard error [...] of the sum of P images [P, ...], each from a part of the samples."""
    parts = len(means)
    if parts == 1:
        return torch.full_like(means[0], math.inf)
    counts = torch.tensor([samples // parts + (n < samples % parts) for n in range(parts)])
    weight = (counts.double() / samples).to(means).reshape(-1, *[1] * (means.ndim - 1))
    off = means - weight * means.sum(0)
    return (off.square().sum(0) * (parts / (parts - 1))).sqrt()


def _mesh(obstacles: tuple[np.ndarray, np.ndarray], volume: DensityVolume, device: str) -> wp.Mesh:
    corners, triangles = (np.asarray(part) for part in obstacles)
    if corners.ndim != 2 or corners.shape[1] != 3 or not np.isfinite(corners).all():
        raise ValueError(f"obstacles: expected corners [V, 3] of finite numbers, got shape {corners.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.min() < 0 or triangles.max() >= len(corners):
        raise ValueError(
            f"obstacles: expected triangles [F, 3] of indices from 0 to {len(corners) - 1}, got {triangles.shape} "
            f"with {triangles.min()} to {triangles.max()}"
        )
    points = (corners - np.asarray(volume.origin)) / volume.voxel
    return wp.Mesh(
        wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(triangles.astype(np.int32).ravel(), dtype=int, device=device),
    )
