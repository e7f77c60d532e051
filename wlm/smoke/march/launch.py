"""Launches ray march kernels on a volume of smoke, with results as torch tensors."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
import warp as wp

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
    """Runs a march, a function of `wlm_kernels.smoke`: `launch(medium, view, *arguments, out, **options)`.

    Returns:
        The result that the march writes into `out`, float32 [*planes, H, W] on the smoke's device.
    """
    with stream(device_name(volume.device)):
        size = (*planes, camera.height, camera.width)
        out = torch.empty(size, dtype=torch.float32, device=volume.device)
        launch(medium_of(volume), camera.view(volume), *arguments, to_warp(out), **options)
    return out


def medium_of(volume: DensityVolume) -> Medium:
    """Returns the smoke as the structure that march kernels take; must be called inside `wlm.interop.stream`."""
    density, temperature = volume.arrays()
    factors = (volume.extinction * volume.voxel, temperature, volume.emission * volume.voxel)
    more: dict[str, Any] = {"solid": volume.solid}
    if volume.near is not None:
        more["bricks"] = to_warp(volume.near)
    if volume.places is not None:
        more |= {"places": to_warp(volume.places), "cells": volume.shape}
    return Medium(density, *factors, empty=torch_memory(volume.device), **more)


def in_bricks(volume: DensityVolume) -> DensityVolume:
    """Returns the volume with its bricks that have smoke, for several marches while the smoke stays the same."""
    if volume.near is not None:
        return volume
    with stream(device_name(volume.device)):
        return replace(volume, near=wp.to_torch(medium_of(volume).in_bricks().bricks))
