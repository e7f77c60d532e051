"""Guiding maps: a rough look at smoke from the camera, which a network turns into six-way lightmaps (section 4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.camera import Camera
from wlm_kernels.smoke import march as smoke_march

__all__ = ["Guide", "check_march", "check_step", "guide", "transmittance"]


@dataclass(frozen=True, eq=False)
class Guide:
    """What algorithm 1 finds; H x W pixels.

    Attributes:
        maps: float32 tensor [3, H, W] on the smoke's device: light, transparency, depth.
        camera: From where it was looked at.
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


_LEAST_STEP = 0.01  # voxels: a march in shorter steps would hardly end


def check_step(name: str, step: float) -> None:
    """Checks a step, in voxels.

    Raises:
        ValueError: It is out of its range.
    """
    if not _LEAST_STEP <= step < float("inf"):
        raise ValueError(f"{name}: expected at least {_LEAST_STEP} voxels, got {step}")


def check_march(step: float, g: float = 0.0, jitter: float = 0.0) -> None:
    """Checks what marches through smoke have in common.

    Args:
        step: In voxels.
        g: Henyey and Greenstein's mean cosine.
        jitter: Share of a step.

    Raises:
        ValueError: One is out of its range.
    """
    check_step("step", step)
    if not -1 < g < 1:
        raise ValueError(f"g: expected a number within -1 and 1, got {g}")
    if not 0 <= jitter <= 1:
        raise ValueError(f"jitter: expected 0 to 1, got {jitter}")


def guide(
    volume: DensityVolume,
    camera: Camera,
    *,
    step: float = 10.0,
    jitter: float = 1.0,
    seed: int = 0,
    threshold: float = 0.01,
    g: float = 0.0,
    cutoff: float = 1e-4,
    shared: bool = True,
) -> Guide:
    """Marches through smoke in large steps (algorithm 1).

    Args:
        volume: The smoke.
        camera: Orthographic or in perspective; inside the smoke it sees what is in front of it, lit from the front by a
            light in its own place.
        step: h, in voxels.
        jitter: Share of a step by which a pixel's samples are shifted at random, 0 to 1.
        seed: Of the jitter.
        threshold: tau, the optical depth of one voxel from which on smoke has a surface.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        cutoff: A ray ends where less than this is left of its transparency.
        shared: Whether pixels share marches to the lights, on a lattice with a node each step. Far quicker; the light
            between nodes is then interpolated.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: A setting is out of its range.
    """
    check_march(step, g, jitter)
    view, moved = camera.view(volume.origin, volume.voxel, volume.shape)
    with stream(device_name(volume.device)):
        maps = torch.empty((3, camera.height, camera.width), dtype=torch.float32, device=volume.device)
        density, _ = volume.arrays()
        smoke_march.guide(
            density,
            volume.extinction * volume.voxel,
            view,
            to_warp(maps),
            step=step,
            jitter=jitter,
            seed=seed,
            threshold=threshold,
            g=g,
            cutoff=cutoff,
            unit=volume.voxel,
            lead=moved,
            shared=shared,
            empty=torch_memory(volume.device),
        )
    return Guide(maps, camera)


def transmittance(
    volume: DensityVolume, points: torch.Tensor, toward: tuple[float, float, float], *, step: float = 0.5
) -> torch.Tensor:
    """What is left of light that comes to points from a direction (eq. 3).

    Args:
        volume: The smoke.
        points: float32 [N, 3], in the world, on the smoke's device.
        toward: The direction to the light in the world, of any length but 0.
        step: In voxels.

    Returns:
        float32 [N], in [0, 1].

    Raises:
        ValueError: The points' shape is wrong, or the direction has no length.
    """
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"points: expected [N, 3], got {tuple(points.shape)}")
    direction = torch.tensor(toward, dtype=torch.float64)
    length = float(direction.norm())
    if not 1e-12 < length < float("inf"):
        raise ValueError(f"toward: expected a direction of some length, got {tuple(toward)}")
    with stream(device_name(volume.device)):
        origin = torch.tensor(volume.origin, dtype=torch.float32, device=points.device)
        at = ((points - origin) / volume.voxel).contiguous()
        out = torch.empty(len(points), dtype=torch.float32, device=points.device)
        density, _ = volume.arrays()
        smoke_march.transmittance(
            density,
            volume.extinction * volume.voxel,
            to_warp(at, wp.vec3),
            (direction / length).tolist(),
            step,
            to_warp(out),
            torch_memory(volume.device),
        )
    return out
