"""What light of all orders is compared with: octaves of light scattered once, diffusion on a coarse grid.

Octaves: Wrenninge et al. 2013, "Oz: the great and volumetric"; light scattered more often is light scattered once in
thinner smoke. Diffusion: Stam 1995, "Multiple scattering as a diffusion process", with a diffusion coefficient that is
bounded where smoke is thin by Wilson's sum (Koerner et al. 2014, "Flux-limited diffusion for multiple scattering in
participating media", section 4).
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
from wlm.smoke.transport.features import orders_march
from wlm.smoke.transport.lighting import light_smoke, marching

CLASSIC = ((0.5, 0.5), (0.25, 0.25))
"""Of the second and the third octave the light, and the extinction on the way to it, over the first's."""

FITTED = tuple((seen, shadow) for shadow in (1.0, 0.5, 0.25, 0.1, 0.04) for seen in (1.0, 0.4, 0.15))
"""Extinctions along the camera's rays and on the way to the light, over the smoke's own, of octaves to be fitted."""

CELLS = 32
"""Of the grid of diffusion, along the longest edge."""

_ROUNDS, _STEPS = 4, 16  # of the flux limiter, and of conjugate gradients in each
_WAY = 64  # places on the way to a light
_TINY = 1e-12


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
        spread = fluence(volume, lights, albedo, cells=cells)
        planes = torch.empty_like(once.planes)
        # What the diffused light is scattered into the camera: the light that smoke glows with.
        glow = albedo * volume.extinction / (4.0 * math.pi)
        for n in range(len(lights)):
            fine = F.interpolate(spread[None, None, n], volume.shape, mode="trilinear", align_corners=False)[0, 0]
            shining = replace(volume, temperature=fine.mul_(volume.density), emission=glow)
            with marching(shining, camera, march) as scene:
                planes[n] = albedo * once.planes[n] + scene.seen()[1]
        return once.compose(planes[..., None].expand(-1, -1, -1, 3))


def fluence(volume: DensityVolume, lights: Sequence[Light], albedo: float, *, cells: int = CELLS) -> torch.Tensor:
    """Light of lights of irradiance 4 pi that was scattered at least once, from all directions, by diffusion.

    Args:
        volume, lights, albedo, cells: As for `diffused`.

    Returns:
        float32 [L, X, Y, Z] on a grid over the smoke's box, of at most so many cells along its edges.
    """
    edges = [n * volume.voxel for n in volume.shape]
    shape = [max(1, round(cells * edge / max(edges))) for edge in edges]
    sizes = [edge / n for edge, n in zip(edges, shape, strict=True)]
    density = F.adaptive_avg_pool3d(volume.density.float()[None, None], shape)[0, 0]
    extinction = volume.extinction * density
    source = albedo * extinction * 4.0 * math.pi * _unscattered(extinction, sizes, lights)
    return _diffuse(extinction, (1.0 - albedo) * extinction, source, sizes)


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


def _diffuse(
    extinction: torch.Tensor, lost: torch.Tensor, source: torch.Tensor, sizes: Sequence[float]
) -> torch.Tensor:
    """Solves -div(D grad f) + lost f = source for f, [L, X, Y, Z], by conjugate gradients; no light comes from outside.

    D = 1 / (3 extinction + |grad f| / f), so that no more light flows than there is; it is of the f before.
    """
    found = torch.zeros_like(source)
    for _ in range(_ROUNDS):
        reach = 1.0 / (3.0 * extinction + _steepness(found, sizes)).clamp(
            min=1.0 / (sum(sizes) * max(source.shape[1:]))
        )
        faces, centre = _couplings(reach, lost, sizes)
        found = _conjugate(faces, centre, source, found)
    return found.clamp(min=0.0)


def _steepness(found: torch.Tensor, sizes: Sequence[float]) -> torch.Tensor:
    """|grad f| / f by central differences, of a grid that goes on alike outside; at most what a grid can tell."""
    found = found.clamp(min=0.0)
    padded = F.pad(found[None], (1,) * 6, mode="replicate")[0]
    square = torch.zeros_like(found)
    for axis, size in enumerate(sizes, 1):
        count = padded.shape[axis]
        inside = [slice(None) if other in (0, axis) else slice(1, -1) for other in range(4)]
        inner = padded[tuple(inside)]
        steps = inner.narrow(axis, 2, count - 2) - inner.narrow(axis, 0, count - 2)
        square += (steps / (2.0 * size)).square()
    return (square.sqrt() / found.clamp(min=_TINY)).clamp(max=2.0 / min(sizes))


def _couplings(
    reach: torch.Tensor, lost: torch.Tensor, sizes: Sequence[float]
) -> tuple[list[torch.Tensor], torch.Tensor]:
    """Of each axis what couples neighbours, [L, ...] with one less along it; all that a cell loses, [L, X, Y, Z]."""
    centre = lost.expand_as(reach).clone()
    faces = []
    for axis, size in enumerate(sizes, 1):
        count = reach.shape[axis]
        one, other = reach.narrow(axis, 0, count - 1), reach.narrow(axis, 1, count - 1)
        between = 2.0 * one * other / (one + other) / size**2
        centre.narrow(axis, 0, count - 1).add_(between)
        centre.narrow(axis, 1, count - 1).add_(between)
        faces.append(between)
        # Half of the fluence at the border leaves (Marshak's condition).
        for border in (0, count - 1):
            centre.narrow(axis, border, 1).add_(1.0 / (size * (2.0 + 0.5 * size / reach.narrow(axis, border, 1))))
    return faces, centre


def _conjugate(
    faces: Sequence[torch.Tensor], centre: torch.Tensor, source: torch.Tensor, start: torch.Tensor
) -> torch.Tensor:
    """Some steps of conjugate gradients, divided by the diagonal; of each light by itself, without a wait."""

    def applied(f: torch.Tensor) -> torch.Tensor:
        out = centre * f
        for axis, between in enumerate(faces, 1):
            count = f.shape[axis]
            out.narrow(axis, 0, count - 1).sub_(between * f.narrow(axis, 1, count - 1))
            out.narrow(axis, 1, count - 1).sub_(between * f.narrow(axis, 0, count - 1))
        return out

    def dot(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        return (a * b).sum((1, 2, 3), keepdim=True)

    found, left = start, source - applied(start)
    way = left / centre
    power = dot(left, way)
    for _ in range(_STEPS):
        pushed = applied(way)
        length = power / dot(way, pushed).clamp(min=_TINY**2)
        found, left = found + length * way, left - length * pushed
        straight = left / centre
        now = dot(left, straight)
        way, power = straight + now / power.clamp(min=_TINY**2) * way, now
    return found
