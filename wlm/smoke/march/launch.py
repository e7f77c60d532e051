"""Launches ray march kernels on a volume of smoke, with results as torch tensors, also as CUDA graphs."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Generic, TypeVar

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import StepGraph, device_name, stream, to_warp, torch_memory
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
    bricks: dict[str, Any] = {}
    if volume.places is not None:
        # A sample reads up to half a voxel beyond its brick.
        near = torch.nn.functional.max_pool3d((volume.places > 0).float()[None, None], 3, 1, 1)[0, 0]
        bricks = {"bricks": to_warp(near.byte()), "places": to_warp(volume.places), "cells": volume.shape}
    return Medium(density, *factors, empty=torch_memory(volume.device), **bricks)


_Made = TypeVar("_Made")


class VolumeGraph(Generic[_Made]):
    """A function of a smoke volume that a GPU replays as a CUDA graph; on the CPU the function is called each time.

    The function reads a copy of the smoke, since a graph has fixed addresses and a solver alternates between two
    buffers. Each call overwrites the result of the previous call.
    """

    def __init__(self, work: Callable[[DensityVolume], _Made], device: str, warmup: int = 2) -> None:
        """Prepares `work`, which must not wait for the GPU; it is called `warmup` times before it is captured."""
        self._work = work
        self._device = device
        self._volume: DensityVolume | None = None
        self._made: _Made | None = None
        self._step = StepGraph(self._make, device, warmup=warmup)

    def __call__(self, volume: DensityVolume) -> _Made:
        """Returns the function's result for a volume."""
        with stream(self._device):
            if self._volume is None:
                heat = None if volume.temperature is None else torch.empty_like(volume.temperature)
                self._volume = replace(volume, density=torch.empty_like(volume.density), temperature=heat)
            if _kind(volume) != _kind(self._volume):
                raise ValueError(
                    "volume: expected shape, type, temperature, voxel, origin, extinction and emission of the first "
                    f"call, {_kind(self._volume)}, got {_kind(volume)}"
                )
            self._volume.density.copy_(volume.density)
            if volume.temperature is not None:
                self._volume.temperature.copy_(volume.temperature)
        self._step()
        return self._made

    def _make(self) -> None:
        self._made = self._work(self._volume)


def _kind(volume: DensityVolume) -> tuple:
    place = (volume.voxel, tuple(volume.origin), volume.extinction, volume.emission)
    return (volume.shape, volume.density.dtype, volume.temperature is not None, *place)
