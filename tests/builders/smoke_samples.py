"""A small pool of samples for tests: a plume of several densities, rising, seen from some sides."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import torch
from builders.smoke_plumes import plume

from wlm.fluid.volume import DensityVolume
from wlm.smoke.baking import bake
from wlm.smoke.camera import Camera
from wlm.smoke.planes import Pool, encode_lightmaps, render_guide
from wlm.smoke.scene import CameraSettings, make_camera
from wlm_kernels.smoke.settings import March

STEP = 3.0
"""Of the guiding maps, in voxels."""


def seen(volume: DensityVolume, degrees: float = 0.0, resolution: int = 32) -> Camera:
    """A camera round a volume."""
    settings = CameraSettings(resolution=resolution).turned(degrees)
    return make_camera(settings, volume.origin, volume.voxel * np.array(volume.shape))


def sample(
    volume: DensityVolume, camera: Camera, seed: int = 0, kind: str = "paper"
) -> tuple[torch.Tensor, torch.Tensor]:
    """A guide [C, H, W] of a kind and its lightmaps [8, H, W], encoded."""
    guided = render_guide(volume, camera, kind, March(STEP, seed=seed))
    return guided, encode_lightmaps(bake(volume, camera, step=1.0, estimate=False))


@functools.cache
def small_pool(count: int = 6, first: int = 0, resolution: int = 32, kind: str = "paper") -> Pool:
    """Samples on the CPU, the odd ones hot; whole numbers of ``first`` give others."""
    guides, targets = [], []
    for i in range(first, first + count):
        pair = []
        for frame in (2.0, 2.1):
            volume = replace(plume(frame + 0.15 * (i % 5), hot=i % 2 == 1), extinction=4.0 + 5.0 * (i % 3))
            pair.append(sample(volume, seen(volume, 37.0 * i, resolution), 2 * i, kind))
        guides.append(torch.stack([guided for guided, _ in pair]))
        targets.append(torch.stack([wanted for _, wanted in pair]))
    motion = torch.zeros(count, 2, resolution, resolution)
    motion[:, 1] = -1.0
    return Pool(
        torch.stack(guides).half(), torch.stack(targets).half(), motion.half(), torch.arange(first, first + count)
    )
