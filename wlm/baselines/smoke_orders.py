"""What light of all orders is compared with: octaves of light scattered once.

Wrenninge et al. 2013, "Oz: the great and volumetric": light scattered more often is light scattered once in thinner
smoke.
"""

from collections.abc import Sequence
from dataclasses import replace

import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.shading import Light
from wlm.smoke.transport.features import orders_march
from wlm.smoke.transport.lighting import light_smoke

CLASSIC = ((0.5, 0.5), (0.25, 0.25))
"""Of the second and the third octave the light, and the extinction on the way to it, over the first's."""

FITTED = tuple((seen, shadow) for shadow in (1.0, 0.5, 0.25, 0.1, 0.04) for seen in (1.0, 0.4, 0.15))
"""Extinctions along the camera's rays and on the way to the light, over the smoke's own, of octaves to be fitted."""


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
