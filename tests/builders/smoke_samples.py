"""Small pools and networks for tests: a rising plume at several densities, from several sides; random weights."""

import functools
import os
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from builders.smoke_plumes import plume

from wlm.fluid.volume import DensityVolume
from wlm.formats.artifact import read_artifact
from wlm.smoke.camera import Camera
from wlm.smoke.march.six_way import bake
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.planes import Pool, encode_lightmaps, render_guide
from wlm.smoke.network.settings import NetworkSettings
from wlm.smoke.network.unet import SixWayNetwork
from wlm.smoke.scene import CameraSettings, make_camera
from wlm_kernels.smoke.settings import March

STEP = 3.0
"""Step of the march of the guiding maps, in voxels."""


def view_of(volume: DensityVolume, degrees: float = 0.0, resolution: int = 32) -> Camera:
    """Makes a camera that shows a whole volume, turned about it."""
    settings = CameraSettings(resolution=resolution).turned(degrees)
    return make_camera(settings, volume.origin, volume.voxel * np.array(volume.shape))


def sample(
    volume: DensityVolume, camera: Camera, seed: int = 0, kind: str = "paper"
) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns a guide [C, H, W] of a kind and its lightmaps [8, H, W], encoded."""
    guide = render_guide(volume, camera, kind, March(STEP, seed=seed))
    return guide, encode_lightmaps(bake(volume, camera, step=1.0, estimate=False))


@functools.cache
def small_pool(count: int = 6, first: int = 0, resolution: int = 32, kind: str = "paper") -> Pool:
    """Makes samples on the CPU; samples of odd numbers are hot, and numbers begin at `first`."""
    guides, targets = [], []
    for i in range(first, first + count):
        pair = []
        for frame in (2.0, 2.1):
            volume = replace(plume(frame + 0.15 * (i % 5), hot=i % 2 == 1), extinction=4.0 + 5.0 * (i % 3))
            pair.append(sample(volume, view_of(volume, 37.0 * i, resolution), 2 * i, kind))
        guides.append(torch.stack([guide for guide, _ in pair]))
        targets.append(torch.stack([target for _, target in pair]))
    motion = torch.zeros(count, 2, resolution, resolution)
    motion[:, 1] = -1.0
    numbers = torch.arange(first, first + count)
    return Pool(torch.stack(guides).half(), torch.stack(targets).half(), motion.half(), numbers)


def random_model(spread: float = 0.2, seed: int = 0, **settings: Any) -> SmokeModel:
    """Makes a tiny network whose weights all have an effect."""
    torch.manual_seed(seed)
    network = SixWayNetwork(NetworkSettings(**{"width": 8, "levels": 3} | settings))
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, std=spread)
    return SmokeModel(network, {})


def file_content(path: str | os.PathLike[str]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Returns the content of a network's file except for the seconds of its training."""
    artifact = read_artifact(path)
    settings = {**artifact.settings, "summary": {**artifact.settings["summary"], "seconds": 0}}
    return settings, {name: array.tobytes() for name, array in artifact.tensors.items()}
