"""Guiding maps: a rough image of smoke, which a network turns into six-way lightmaps (section 4.2); transmittance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import Camera, unit
from wlm_kernels.smoke import march_guide
from wlm_kernels.smoke.settings import March

__all__ = ["Guide", "guide", "transmittance"]


@dataclass(frozen=True, eq=False)
class Guide:
    """A guiding map of H x W pixels (algorithm 1).

    Attributes:
        maps: float32 tensor [3, H, W] on the smoke's device: light, transparency, depth.
        camera: The view.
    """

    maps: torch.Tensor
    camera: Camera

    @property
    def light(self) -> torch.Tensor:
        """[H, W], light scattered to the camera under lights from the front, top and bottom of irradiance 4 pi."""
        return self.maps[0]

    @property
    def transparency(self) -> torch.Tensor:
        """[H, W], in [0, 1]: 1 where there is no smoke."""
        return self.maps[1]

    @property
    def depth(self) -> torch.Tensor:
        """[H, W], distance along the ray to the smoke in the world's unit, 0 where there is none."""
        return self.maps[2]


def guide(volume: DensityVolume, camera: Camera, march: March = March(), *, shared: bool = True) -> Guide:
    """Marches through smoke in large steps (algorithm 1).

    Args:
        volume: The smoke.
        camera: Orthographic or in perspective; inside the smoke it sees what is in front of it, lit from the front by a
            light in its own place.
        march: Without ``spacing`` and ``light_step``: nodes and steps to the lights are those of the rays.
        shared: Whether pixels share marches to the lights, on a lattice with a node each step. Far quicker; the light
            between nodes is then interpolated.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: The march has a spacing or a light_step.
    """
    for name in ("spacing", "light_step"):
        if getattr(march, name) is not None:
            raise ValueError(f"{name}: expected none for the paper's guiding map, got {getattr(march, name)}")
    with stream(device_name(volume.device)):
        maps = torch.empty((3, camera.height, camera.width), dtype=torch.float32, device=volume.device)
        density, _ = volume.arrays()
        march_guide.guide(
            density,
            volume.extinction * volume.voxel,
            camera.view(volume),
            march,
            to_warp(maps),
            shared=shared,
            empty=torch_memory(volume.device),
        )
    return Guide(maps, camera)


def transmittance(
    volume: DensityVolume, points: torch.Tensor, toward: Sequence[float], *, step: float = 0.5
) -> torch.Tensor:
    """The share of light from a direction that reaches points (eq. 3).

    Args:
        volume: The smoke.
        points: float32 [N, 3], in the world, on the smoke's device.
        toward: The direction to the light in the world, of any length but 0.
        step: In voxels.

    Returns:
        float32 [N], in [0, 1].

    Raises:
        ValueError: The points' shape or the step is wrong, or the direction has no length.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected [N, 3], got {tuple(points.shape)}")
    direction, march = unit(toward), March(step=step)
    with stream(device_name(volume.device)):
        origin = torch.tensor(volume.origin, dtype=torch.float32, device=points.device)
        at = ((points - origin) / volume.voxel).contiguous()
        out = torch.empty(len(points), dtype=torch.float32, device=points.device)
        density, _ = volume.arrays()
        march_guide.transmittance(
            density,
            volume.extinction * volume.voxel,
            to_warp(at, wp.vec3),
            direction,
            march.step,
            to_warp(out),
            torch_memory(volume.device),
        )
    return out
