"""Smoke, cameras and lights drawn at random, with all light that reaches the camera: what a mix learns from."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.learn.synthetic import make_billows, make_plume
from wlm.smoke.shading import Light
from wlm.smoke.transport.tracing import trace

ALBEDOS = (0.5, 0.8, 0.9, 0.95, 1.0)
"""Albedos that light is known at; between them it is a smooth function of the albedo."""

_ORDERS = 40
_THIN, _THICK = 5.0, 60.0  # extinction over the box's edge
_SIZES = (40, 48, 56, 64)
_THINNEST, _THICKEST = 2.0, 100.0
_ALL_SIZES = (24, 32, 48, 64, 96)
_PIXELS = (32, 48, 64, 96)
_SMALL, _HAZY = 0.4, 0.4  # chances of smoke that fills a part of its box, and of smoke in other smoke


@dataclass(frozen=True, eq=False)
class Sample:
    """One volume from one side under some lights.

    Attributes:
        volume: The smoke.
        camera: Orthographic.
        lights: Directional, of irradiance 4 pi.
        light: float32 tensor [L, A, H, W], light of all orders of each light, at each of `ALBEDOS`; with noise.
    """

    volume: DensityVolume
    camera: Camera
    lights: tuple[Light, ...]
    light: torch.Tensor


def draw_view(
    seed: int, number: int, *, pixels: int = 64, lights: int = 6, cells: int | None = None
) -> tuple[DensityVolume, Camera, tuple]:
    """Draws smoke, a camera and lights; each is of the seed and the number alone.

    Args:
        seed, number: At least 0.
        pixels: H and W.
        lights: How many.
        cells: Voxels along an edge; None: drawn, 40 to 64.
    """
    random = np.random.default_rng([seed, number])
    extinction = float(np.exp(random.uniform(np.log(_THIN), np.log(_THICK))))
    drawn = int(random.choice(_SIZES))
    n = drawn if cells is None else cells
    volume = make_plume(n, seed=int(random.integers(2**31)), hot=False, extinction=extinction)
    volume = replace(volume, density=volume.density ** float(random.uniform(0.5, 2.0)))
    return _seen(volume, random, pixels, lights)


def draw_lesson(seed: int, number: int, *, lights: int = 4) -> tuple[DensityVolume, Camera, tuple]:
    """Draws a view to learn from, of smoke of more kinds than `draw_view`'s, thinner and thicker, in cells coarse and
    fine: plumes and billows, dense ones in haze, small ones in a large box; arguments as there."""
    random = np.random.default_rng([seed, number])
    extinction = float(np.exp(random.uniform(np.log(_THINNEST), np.log(_THICKEST))))
    n, pixels = int(random.choice(_ALL_SIZES)), int(random.choice(_PIXELS))
    fills = int(n * random.uniform(0.3, 0.8)) if random.random() < _SMALL else n
    density = _any_smoke(random, fills)
    if random.random() < _HAZY:
        density = density + float(np.exp(random.uniform(np.log(0.02), 0.0))) * _any_smoke(random, fills)
    density = density ** float(np.exp(random.uniform(np.log(0.5), np.log(4.0))))
    before = random.integers(0, n - fills + 1, 3)
    sides = [int(part) for first in before[::-1] for part in (first, n - fills - first)]
    density = torch.nn.functional.pad(density, sides)
    volume = DensityVolume(density, extinction * n / fills, 1.0 / n)
    return _seen(volume, random, pixels, lights)


def _any_smoke(random: np.random.Generator, n: int) -> torch.Tensor:
    """Density [n, n, n] of a random kind."""
    seed = int(random.integers(2**31))
    made = make_billows(n, seed=seed) if random.random() < 0.5 else make_plume(n, seed=seed, hot=False)
    return made.density


def _seen(
    volume: DensityVolume, random: np.random.Generator, pixels: int, lights: int
) -> tuple[DensityVolume, Camera, tuple]:
    """The smoke turned, from a random side under random lights."""
    density = volume.density.permute(tuple(int(i) for i in random.permutation(3)))
    density = density.flip([axis for axis in range(3) if random.random() < 0.5]).contiguous()
    volume = replace(volume, density=density)
    ways = random.normal(size=(lights + 1, 3))
    camera = Camera.around(volume, toward=ways[0], pixels=pixels)
    return volume, camera, tuple(Light(tuple(map(float, way))) for way in ways[1:])


def make_sample(
    seed: int, number: int, *, samples: int = 64, pixels: int = 64, lights: int = 6, device: str = "cpu"
) -> Sample:
    """Draws a view and traces it.

    Args:
        seed, number, pixels, lights: As for `draw_view`.
        samples: Paths a pixel.
        device: "cpu" or "cuda:N".
    """
    return traced(draw_view(seed, number, pixels=pixels, lights=lights), samples=samples, seed=number, device=device)


def traced(view: tuple[DensityVolume, Camera, tuple], *, samples: int, seed: int, device: str = "cpu") -> Sample:
    """A view of `draw_view` with its light; arguments as for `make_sample`."""
    volume, camera, lamps = view
    volume = replace(volume, density=volume.density.to(device))
    grey = trace(volume, camera, lamps, samples=samples, orders=_ORDERS, seed=seed).planes[..., 0]
    powers = torch.tensor(ALBEDOS, device=grey.device)[:, None] ** torch.arange(_ORDERS + 2, device=grey.device)
    light = torch.einsum("ak,lkhw->lahw", powers, grey)
    return Sample(volume, camera, lamps, light)
