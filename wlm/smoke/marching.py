"""Marches over a volume, on its device and in torch's memory."""

from collections.abc import Callable
from typing import Any

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import Camera
from wlm_kernels.smoke.march import Medium


def run(
    launch: Callable[..., None],
    volume: DensityVolume,
    camera: Camera,
    planes: tuple[int, ...],
    *arguments: Any,
    **options: Any,
) -> torch.Tensor:
    """Runs a march.

    Args:
        launch: `launch(medium, view, *arguments, out, **options)`, of `wlm_kernels.smoke`.
        volume: The smoke.
        camera: The view.
        planes: Sizes of the result before those of the image.
        arguments, options: Passed on; lengths in voxels.

    Returns:
        float32 [*planes, H, W] on the smoke's device.
    """
    with stream(device_name(volume.device)):
        size = (*planes, camera.height, camera.width)
        out = torch.empty(size, dtype=torch.float32, device=volume.device)
        launch(medium_of(volume), camera.view(volume), *arguments, to_warp(out), **options)
    return out


def medium_of(volume: DensityVolume) -> Medium:
    """The smoke as marches take it, inside `wlm.interop.stream`."""
    density, temperature = volume.arrays()
    factors = (volume.extinction * volume.voxel, temperature, volume.emission * volume.voxel)
    return Medium(density, *factors, empty=torch_memory(volume.device))
