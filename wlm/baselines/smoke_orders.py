"""What light of all orders is compared with: octaves of light scattered once, diffusion on a coarse grid.

Octaves: Wrenninge et al. 2013, "Oz: the great and volumetric"; light scattered more often is light scattered once in
thinner smoke. Diffusion: Stam 1995, "Multiple scattering as a diffusion process", with a diffusion coefficient that is
bounded where smoke is thin by Wilson's sum (Koerner et al. 2014, "Flux-limited diffusion for multiple scattering in
participating media", section 4), as `wlm.smoke.transport.diffusion` solves it.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream
from wlm.smoke.camera import Camera, unit
from wlm.smoke.shading import Light
from wlm.smoke.transport.diffusion import CELLS, CoarseSmoke
from wlm.smoke.transport.features import orders_march
from wlm.smoke.transport.lighting import light_smoke, marching

CLASSIC = ((0.5, 0.5), (0.25, 0.25))
"""Of the second and the third octave the light, and the extinction on the way to it, over the first's."""

FITTED = tuple((seen, shadow) for shadow in (1.0, 0.5, 0.25, 0.1, 0.04) for seen in (1.0, 0.4, 0.15))
"""Extinctions along the camera's rays and on the way to the light, over the smoke's own, of octaves to be fitted."""

_WAY = 64  # places on the way to a light


def three_octaves(volume: DensityVolume, camera: Camera, lights: Sequence[Light], albedo: float) -> torch.Tensor:
    """A picture by three octaves, float32 [H, W, 3]."""
    march = orders_march(volume)
    picture = light_smoke(volume, camera, lights, march).shade(albedo=(albedo,) * 3)
    for share, shadow in CLASSIC:
        more = light_smoke(volume, camera, lights, march, shadow=shadow).shade(albedo=(albedo,) * 3)
        picture = picture + share * more
    return picture


def octaves(volume: DensityVolume, camera: Camera, lights: Sequence[Light]) -> torch.Tensor:
    """Pictures by each of `FITTED` alone, at albedo 1, float32 [O, H, W, 3]."""
    march = orders_march(volume)
    made = []
    for seen, shadow in FITTED:
        thinner = replace(volume, extinction=seen * volume.extinction)
        made.append(light_smoke(thinner, camera, lights, march, shadow=shadow / seen).shade())
    return torch.stack(made)


def diffused(
    volume: DensityVolume, camera: Camera, lights: Sequence[Light], albedo: float, *, cells: int = CELLS
) -> torch.Tensor:
    """A picture by single scattering and diffusion, float32 [H, W, 3].

    Args:
        volume: Cold smoke.
        camera: Any.
        lights: Directional.
        albedo: 0 to 1.
        cells: As `CELLS`.
    """
    march = orders_march(volume)
    with stream(device_name(volume.device)):
        once = light_smoke(volume, camera, lights, march)
        coarse = CoarseSmoke(volume, cells)
        with marching(volume, camera, march) as scene:
            planes = albedo * (once.planes + coarse.seen(scene, _spread(coarse, lights, albedo)))
        return once.compose(planes[..., None].expand(-1, -1, -1, 3))


def fluence(volume: DensityVolume, lights: Sequence[Light], albedo: float, *, cells: int = CELLS) -> torch.Tensor:
    """Light of lights of irradiance 4 pi that was scattered at least once, from all directions, by diffusion.

    Args:
        volume, lights, albedo, cells: As for `diffused`.

    Returns:
        float32 [L, X, Y, Z] on a grid over the smoke's box, of at most so many cells along its edges.
    """
    with stream(device_name(volume.device)):
        return _spread(CoarseSmoke(volume, cells), lights, albedo)


def _spread(coarse: CoarseSmoke, lights: Sequence[Light], albedo: float) -> torch.Tensor:
    source = coarse.extinction * 4.0 * math.pi * _unscattered(coarse.extinction, coarse.edges, lights)
    return coarse.spread(source, [albedo])


def _unscattered(extinction: torch.Tensor, sizes: Sequence[float], lights: Sequence[Light]) -> torch.Tensor:
    """The share of each light that reaches each cell, [L, X, Y, Z]."""
    shape, device = extinction.shape, extinction.device
    axes = [(torch.arange(n, device=device) + 0.5) * size for n, size in zip(shape, sizes, strict=True)]
    centres = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)
    edges = [n * size for n, size in zip(shape, sizes, strict=True)]
    length = math.hypot(*edges) / _WAY
    passed = []
    for light in lights:
        toward = unit(light.toward)
        depth = torch.zeros(shape, device=device)
        for step in range(_WAY):
            at = [centres[..., axis] + (step + 0.5) * length * float(toward[axis]) for axis in range(3)]
            # torch reads x, y, z as the last, the middle and the first axis.
            grid = torch.stack([2.0 * part / edge - 1.0 for part, edge in zip(at, edges, strict=True)][::-1], -1)
            depth += F.grid_sample(extinction[None, None], grid[None], align_corners=False)[0, 0]
        passed.append(torch.exp(-length * depth))
    return torch.stack(passed)
