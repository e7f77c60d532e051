"""What light of all orders is predicted from: planes of marches, blurred at scales of the smoke's box and shifted."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import Camera, unit
from wlm.smoke.shading import Light
from wlm.smoke.transport.lighting import LitSmoke, marching
from wlm.smoke.transport.lights import AnyLight, PointLight
from wlm_kernels.smoke import scales
from wlm_kernels.smoke.settings import March

SCALES = (1 / 64, 1 / 32, 1 / 16, 1 / 8)
"""Standard deviations of blurs, in edges of the smoke's box."""

BASES, SHIFTED = 9, 3
FEATURES = 2 * (BASES + (BASES + SHIFTED) * len(SCALES))

_THINNEST = 1e-4  # transparency below which depths count the same
_STEPS = 130  # through the box, of a march for light of all orders
_NODES = 64  # gaps of its lattice through the box, at least
_SHORTEST = 0.25  # voxels: of a march in shorter steps nothing is left to gain
_AROUND = 64  # steps through the box that light from all around is marched in, at most


@dataclass(frozen=True, eq=False)
class Inputs:
    """What all light of one light is predicted from; H x W pixels.

    Attributes:
        single: float32 tensor [H, W], S, light scattered once.
        features: float32 tensor [FEATURES, H, W].
        opacity: float32 tensor [H, W].
        cosine: Of the angle between the directions to the light and to the camera.
        depth: Logarithm of the smoke's mean optical depth along rays, weighed by opacity; a tensor of one number.
    """

    single: torch.Tensor
    features: torch.Tensor
    opacity: torch.Tensor
    cosine: float
    depth: torch.Tensor


def orders_march(volume: DensityVolume, g: float = 0.0) -> March:
    """The march whose planes the filter takes: in steps of a 130th of the smoke's longest edge, but of no less than a
    quarter of a voxel, and with a lattice whose nodes are as far apart, but at least a voxel or, on small grids, a 64th
    of the edge: more of them take far more time, and bring a tenth of a decibel."""
    edge = max(volume.shape)
    step = max(_SHORTEST, edge / _STEPS)
    return March(step=step, spacing=max(min(1.0, edge / _NODES), step), jitter=0.0, g=g)


def blur(planes: torch.Tensor, sigma: float) -> torch.Tensor:
    """Blurs planes [C, H, W] by a Gaussian of a standard deviation in pixels; outside the image they are 0."""
    height, width = planes.shape[1:]
    with stream(device_name(planes.device)):
        planes = planes.detach().float().contiguous()
        made = scales.make_scales(to_warp(planes), [sigma], torch_memory(planes.device))[0]
        small = wp.to_torch(made.planes).clone()
        if made.factor > 1:
            size = tuple(made.factor * n for n in small.shape[1:])
            small = F.interpolate(small[None], size=size, mode="bilinear", align_corners=False)[0, :, :height, :width]
    return small


def ambient(volume: DensityVolume, camera: Camera, march: March | None = None) -> torch.Tensor:
    """Light from all around, scattered once: the mean under lights along the camera's six axes, [H, W].

    It is smooth: steps are as long as a 64th of the box, if those of the march (None: `orders_march`) are shorter.
    """
    march = orders_march(volume) if march is None else march
    march = replace(march, step=max(march.step, max(volume.shape) / _AROUND))
    with marching(volume, camera, march) as scene:
        planes = torch.empty(len(camera.axes), 2, camera.height, camera.width, device=volume.device)
        for axis, plane in zip(camera.axes, planes, strict=True):
            scene.light(axis, None, plane)
        return planes.mean((0, 1))


def make_inputs(volume: DensityVolume, lit: LitSmoke, around: torch.Tensor) -> list[Inputs]:
    """The filter's inputs for each light; arguments as for `input_maker`."""
    make = input_maker(volume, lit, around)
    return [make(n) for n in range(len(lit.lights))]


def input_maker(volume: DensityVolume, lit: LitSmoke, around: torch.Tensor) -> Callable[[int], Inputs]:
    """Blurs planes, and makes the filter's inputs of them for one light at a time, by number.

    The light has an irradiance of 4 pi; of a point light that at the smoke's centre.

    Args:
        volume: The smoke.
        lit: It under its lights.
        around: Of `ambient`.
    """
    camera, device = lit.camera, lit.planes.device
    edge = volume.voxel * max(volume.shape)
    pitch = camera.pitch
    if camera.perspective:
        away = float(np.linalg.norm(np.asarray(camera.position) - volume.centre))
        pitch *= max(away, 0.5 * edge)
    with stream(device_name(device)):
        ways = [aim(light, volume) for light in lit.lights]
        single, opposite = lit.planes, lit.opposite
        if any(isinstance(light, PointLight) for light in lit.lights):
            single, opposite = _as_directional(volume, lit, ways)
        opacity = 1.0 - lit.transparency
        thickness = -torch.log(lit.transparency.clamp(min=_THINNEST))
        # At least that of a tenth of a pixel's smoke.
        mean = (thickness * opacity).sum() / opacity.sum().clamp(min=0.1)
        depth = mean.clamp(min=1e-3).log()
        arrays = (to_warp(part) for part in (single, opposite, around, lit.transparency))
        bases = scales.make_bases(*arrays, _THINNEST, torch_memory(device))
        blurred = scales.make_scales(bases, [scale * edge / pitch for scale in SCALES], torch_memory(device))

    def make(n: int) -> Inputs:
        across, rise, cosine = camera.axes @ ways[n][0]
        with stream(device_name(device)):
            features = torch.empty(FEATURES, camera.height, camera.width, device=device)
            scales.features(bases, blurred, n, across, rise, to_warp(features))
        return Inputs(single[n], features, opacity, float(cosine), depth)

    return make


def _as_directional(
    volume: DensityVolume, lit: LitSmoke, ways: list[tuple[np.ndarray, float]]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Planes of lights of irradiance 4 pi, and of the opposite ones, with point lights as if they were far off."""
    single = torch.stack([factor * plane for (_, factor), plane in zip(ways, lit.planes, strict=True)])
    opposite = lit.opposite.clone()
    with marching(volume, lit.camera, lit.march) as scene:
        for n, (light, (toward, _)) in enumerate(zip(lit.lights, ways, strict=True)):
            if isinstance(light, PointLight):
                both = torch.empty(2, *single.shape[1:], device=single.device)
                scene.light(-toward, None, both)
                opposite[n] = both[0]
    return single, opposite


def aim(light: AnyLight, volume: DensityVolume) -> tuple[np.ndarray, float]:
    """The direction to a light from the smoke's centre, and what gives its plane the irradiance 4 pi there."""
    if isinstance(light, Light):
        return unit(light.toward), 1.0
    way = np.asarray(light.position, np.float64) - volume.centre
    length = float(np.linalg.norm(way))
    least = 0.5 * volume.voxel * max(volume.shape)
    return way / length if length > 0 else np.array([0.0, 1.0, 0.0]), max(length, least) ** 2
