"""Rival approximations of multiple scattering in smoke: octaves of single scattering, a linear filter, and diffusion.

Octaves (Wrenninge et al. 2013, "Oz: the great and volumetric") approximate light that is scattered several times by
single scattering in thinner smoke. The filter approximates it, as scattering blurs light, by a weighted sum of image
planes blurred at several scales.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
import torch.nn.functional as F

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import make_inputs, orders_march
from wlm_kernels.smoke.orders import THINNEST

CLASSIC = ((0.5, 0.5), (0.25, 0.25))
"""Light and extinction towards the light of the second and the third octave, over those of the first."""

FITTED = tuple((seen, shadow) for shadow in (1.0, 0.5, 0.25, 0.1, 0.04) for seen in (1.0, 0.4, 0.15))
"""Extinctions along the camera's rays and on the way to the light, over the smoke's own, of octaves to be fitted."""

SCALES = (1 / 64, 1 / 32, 1 / 16, 1 / 8)
"""Standard deviations of the filter's blurs, in edges of the smoke's box."""

_REACH = 3.0  # standard deviations


def three_octaves(volume: DensityVolume, camera: Camera, lights: Sequence[Light], albedo: float) -> torch.Tensor:
    """Returns a picture with multiple scattering approximated by three octaves of single scattering, [H, W, 3]."""
    march = orders_march(volume)
    picture = light_smoke(volume, camera, lights, march).shade(albedo=(albedo,) * 3)
    for share, shadow in CLASSIC:
        more = light_smoke(volume, camera, lights, march, shadow=shadow).shade(albedo=(albedo,) * 3)
        picture = picture + share * more
    return picture


def octaves(volume: DensityVolume, camera: Camera, lights: Sequence[Light]) -> torch.Tensor:
    """Returns the picture of each of the O octaves of `FITTED` alone, at albedo 1, float32 [O, H, W, 3]."""
    march = orders_march(volume)
    made = []
    for seen, shadow in FITTED:
        thinner = replace(volume, extinction=seen * volume.extinction)
        made.append(light_smoke(thinner, camera, lights, march, shadow=shadow / seen).shade())
    return torch.stack(made)


def diffused(volume: DensityVolume, camera: Camera, lights: Sequence[Light], albedo: float) -> torch.Tensor:
    """Returns a picture by single scattering plus diffusion, which our learned model mixes, float32 [H, W, 3]."""
    with stream(device_name(volume.device)):
        lit, inputs = make_inputs(volume, camera, lights, [albedo], orders_march(volume))
        return lit.compose(inputs.by_diffusion(albedo)[..., None].expand(-1, -1, -1, 3))


def filter_planes(volume: DensityVolume, camera: Camera, lights: Sequence[Light]) -> torch.Tensor:
    """Returns P image planes for each of L lights of irradiance 4 pi, float32 [L, P, H, W], for a weighted sum.

    The planes are the smoke lit by the light, by the opposite light and from all around, opacity, squared opacity and
    optical depth; each also blurred at several scales, and all of these also multiplied by opacity.

    Args:
        volume: The smoke.
        camera: Orthographic camera.
        lights: At least one directional light.
    """
    march = orders_march(volume)
    lit = light_smoke(volume, camera, lights, march)
    six = light_smoke(volume, camera, [Light(tuple(map(float, axis))) for axis in camera.axes], march)
    around = 0.5 * (six.planes + six.opposite).mean(0)
    opacity, depth = 1.0 - lit.transparency, -torch.log(lit.transparency.clamp(min=THINNEST))
    shared = torch.stack([around, opacity, opacity**2, depth])
    planes = torch.cat([lit.planes[:, None], lit.opposite[:, None], shared.expand(len(lights), -1, -1, -1)], 1)
    edge = volume.voxel * max(volume.shape) / camera.pitch
    every = torch.cat([planes, *(_blurred(planes, scale * edge) for scale in SCALES)], 1)
    return torch.cat([every, opacity * every], 1)


def _blurred(planes: torch.Tensor, sigma: float) -> torch.Tensor:
    """Blurs planes [L, P, H, W] by a Gaussian of standard deviation `sigma` in pixels, with black outside."""
    reach = max(1, round(_REACH * sigma))
    away = torch.arange(-reach, reach + 1, device=planes.device) / max(sigma, 1e-3)
    weights = torch.exp(-0.5 * away**2)
    weights /= weights.sum()
    flat = planes.flatten(0, 1)[:, None]
    flat = F.conv2d(flat, weights[None, None, None, :], padding=(0, reach))
    return F.conv2d(flat, weights[None, None, :, None], padding=(reach, 0)).reshape(planes.shape)
