"""Path-traced pictures of smoke: light of every order of scattering, one light's apart from another's.

The truth that other methods are measured by: without bias, with noise, and with an estimate of this noise.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, free_memory, stream, to_warp
from wlm.smoke.camera import Camera
from wlm.smoke.march.launch import medium_of
from wlm.smoke.transport.lights import AnyLight, Environment, checked_albedo, in_voxels
from wlm.system import Meter, OnProgress
from wlm_kernels.smoke import path
from wlm_kernels.smoke.march import View

HIGHEST = 100_000
"""Scatterings after which a path ends whatever is left of its light."""

_PARTS = 16  # that samples are divided into, whose spread tells the noise
_BYTES = 2**31  # at most, and a fourth of the memory, of the planes of the parts that are traced at once
_DENSEST = 1e4  # optical depth of a voxel: of more, paths would hardly end


@dataclass(frozen=True, eq=False)
class Transport:
    """Light that smoke sends to a camera; H x W pixels, S sources, linear.

    Attributes:
        planes: float32 tensor [S, orders + 2, H, W, 3]: of each source the light that was never scattered, scattered
            once, twice and so on, and last all that was scattered more than `orders` times.
        sources: The lights by number, "light 1" and so on, "environment" and "emission".
        noise: float32 tensor [S, H, W, 3], the standard error of each source's sum over its planes.
        total_noise: float32 tensor [H, W, 3], the standard error of `total`; sources share their paths, so that it is
            more than the root of the sum of the squares of theirs.
        albedo: R, G, B.
        camera: The view.
        samples: Paths a pixel.
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
        """Orders of scattering that have planes of their own."""
        return self.planes.shape[1] - 2

    @property
    def total(self) -> torch.Tensor:
        """All light of all sources, [H, W, 3]."""
        return self.planes.sum((0, 1))

    @property
    def error(self) -> float:
        """Root of the mean square of the standard error of `total`, over that of `total`; 0 of a black picture."""
        power = float(self.total.double().square().mean())
        return math.sqrt(float(self.total_noise.double().square().mean()) / power) if power > 0 else 0.0

    def up_to(self, order: int) -> torch.Tensor:
        """Light scattered at most so often, of each source, [S, H, W, 3].

        Raises:
            ValueError: The order isn't among those kept apart.
        """
        if not 0 <= order <= self.orders:
            raise ValueError(f"order: expected 0 to {self.orders}, got {order}")
        return self.planes[:, : order + 1].sum(1)

    def with_albedo(self, albedo: Sequence[float]) -> "Transport":
        """The same paths at another albedo: an order n counts for the n-th power of the ratio.

        What was scattered more than `orders` times is left out, and the noise is scaled as the sum is.

        Args:
            albedo: R, G, B, 0 to 1.

        Raises:
            ValueError: Not an albedo; or one of 0 was traced.
        """
        wanted = checked_albedo(albedo)
        if min(self.albedo) <= 0.0:
            raise ValueError("albedo: expected paths of an albedo above 0")
        ratio = torch.tensor(wanted / np.asarray(self.albedo)).to(self.planes)
        powers = ratio ** torch.arange(self.orders + 1, device=ratio.device, dtype=ratio.dtype)[:, None]
        planes = torch.zeros_like(self.planes)
        planes[:, :-1] = self.planes[:, :-1] * powers[:, None, None]

        def scaled(noise: torch.Tensor, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
            return torch.where(after > 0, noise * (after / before.clamp(min=1e-30)), 0.0)

        noise = scaled(self.noise, self.planes.sum(1), planes.sum(1))
        total_noise = scaled(self.total_noise, self.total, planes.sum((0, 1)))
        return replace(self, planes=planes, noise=noise, total_noise=total_noise, albedo=tuple(map(float, wanted)))


def trace(
    volume: DensityVolume,
    camera: Camera,
    lights: Sequence[AnyLight] = (),
    *,
    environment: Environment | None = None,
    albedo: Sequence[float] = (1.0, 1.0, 1.0),
    g: float = 0.0,
    samples: int = 64,
    orders: int = 1,
    highest: int = HIGHEST,
    obstacles: tuple[np.ndarray, np.ndarray] | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> Transport:
    """Traces paths from the camera through the smoke.

    Args:
        volume: The smoke; where it is hot its emission is a light as well, seen and scattered.
        camera: Any, outside the smoke or inside. Paths go through pixel centres, as those of a march.
        lights: Any number. Their `visibility` isn't used.
        environment: Light from all around, seen behind the smoke too.
        albedo: R, G, B, the share of light that a scattering leaves, 0 to 1.
        g: Mean cosine of the Henyey-Greenstein phase function, within -1 and 1.
        samples: Paths a pixel, at least 1. Of one path the noise isn't known: it is infinite.
        orders: Orders of scattering that get planes of their own.
        highest: Scatterings after which a path ends; 1 is single scattering.
        obstacles: Corners [V, 3] in the world and triangles [F, 3] that absorb all light; None: none.
        seed: A whole number of at least 0. Results depend on it alone, on one kind of device.
        progress: Called from time to time.

    Returns:
        The light on the smoke's device.

    Raises:
        ValueError: A setting is out of its range.
        WlmError: The smoke is so dense that paths would hardly end, or the planes don't fit into the memory.
    """
    if not -1 < g < 1:
        raise ValueError(f"g: expected a number within -1 and 1, got {g}")
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
            raise WlmError(f"expected voxels of an optical depth of at most {_DENSEST:g}, found one of {densest:.4g}")
        majorants = path.bounds(medium, densest)
        lamps = path.make_lights([in_voxels(light, volume) for light in lights])
        lamps = wp.array(lamps, dtype=path.PathLight, device=device)
        mesh = None if obstacles is None or not len(obstacles[1]) else _mesh(obstacles, volume, device)
        settings = path.PathSettings()
        settings.albedo, settings.g = wp.vec3(*map(float, colour)), float(g)
        settings.highest, settings.kept, settings.samples = min(highest, HIGHEST), orders, samples
        settings.key = wp.uint64(int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]))
        sky = _sky(environment, device)
        view, parts = camera.view(volume), min(_PARTS, samples)
        sources, kept = len(lights) + 2, orders + 2
        planes = sources * kept
        room = min(_BYTES, free_memory(wp.get_device(device)) // 4)
        at_once = 1 if device == "cpu" else max(1, min(parts, room // (12 * planes * view.height * view.width)))
        _require(planes, sources, view, parts, at_once, device)
        total = torch.zeros((sources, kept, view.height, view.width, 3), device=volume.device)
        means = []
        meter = Meter(progress, "trace", parts)
        for first in range(0, parts, at_once):
            count = min(at_once, parts - first)
            size = (count * planes, view.height, view.width, 3)
            out = torch.zeros(size, device=volume.device)
            arguments = (lamps, sky, 0 if mesh is None else mesh.id, settings, first, parts)
            path.trace(medium, view, majorants, *arguments, to_warp(out, wp.vec3))
            each = out.reshape(count, *total.shape)
            total += each.sum(0)
            means.append(each.sum(2))
            meter.report(first + count)
        means = torch.cat(means)
        noise, total_noise = _noise(means, samples), _noise(means.sum(1), samples)
    names = [f"light {n + 1}" for n in range(len(lights))] + ["environment", "emission"]
    there = [*range(len(lights)), *([len(lights)] * (environment is not None))]
    there += [len(lights) + 1] * (volume.temperature is not None)
    picked = torch.tensor(there, dtype=torch.long, device=volume.device)
    chosen = tuple(names[n] for n in there)
    return Transport(total[picked], chosen, noise[picked], total_noise, tuple(map(float, colour)), camera, samples)


def _require(planes: int, sources: int, view: View, parts: int, at_once: int, device: str) -> None:
    """Checks that what is made of an image fits into the memory before a path is traced."""
    # The parts that are traced, their sum, what is picked of it and added up of that; the means and their spread.
    needed = 12 * view.height * view.width * (planes * (at_once + 3) + 3 * sources * parts)
    free = free_memory(wp.get_device(device))
    if needed > free:
        raise WlmError(
            f"orders: {planes} planes of {view.height} x {view.width} pixels need {needed / 2**30:.1f} GiB on {device}:"
            f" expected at most the {free / 2**30:.1f} GiB that are free: use fewer orders or pixels"
        )


def _noise(means: torch.Tensor, samples: int) -> torch.Tensor:
    """Standard errors [...] of the sum over parts [P, ...]."""
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
        raise ValueError(f"obstacles: expected finite corners [V, 3], got {corners.shape}")
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.min() < 0 or triangles.max() >= len(corners):
        raise ValueError(f"obstacles: expected triangles [F, 3] of {len(corners)} corners, got {triangles.shape}")
    points = (corners - np.asarray(volume.origin)) / volume.voxel
    return wp.Mesh(
        wp.array(points.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(triangles.astype(np.int32).ravel(), dtype=int, device=device),
    )


def _sky(environment: Environment | None, device: str) -> path.Sky:
    sky = path.Sky()
    given = Environment.even((0.0, 0.0, 0.0)) if environment is None else environment
    rows, columns, sky.total = given.chances()
    sky.radiance = wp.array(np.asarray(given.radiance, np.float32), dtype=wp.vec3, device=device)
    sky.rows = wp.array(rows.astype(np.float32), dtype=float, device=device)
    sky.columns = wp.array(columns.astype(np.float32), dtype=float, device=device)
    return sky
