"""Six-way lightmaps at the cost of a guiding map: one march in large steps that shares the ways to the lights.

The paper marches in steps of 10 voxels for the sum of three lights, and leaves it to a network to find six lightmaps in
it (section 4.2). The same march can keep the lights apart: those from the sides are marched to along the lines of a
lattice, once for all pixels; those from the front and the back follow from the ray's transparency T alone, exactly, as
(1 - T^2) / 2 and -T ln T. What it lacks is the error of its steps: of those along the rays, in T too, of the distance
of the lattice's nodes, between which light is interpolated, and of the steps to the lights. Each is a setting.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from wlm.fluid.volume import DensityVolume
from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.baking import SixWay
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.guide import check_march, check_step
from wlm_kernels.smoke import march_coarse

__all__ = ["CoarseSixWay", "coarse_six_way"]

_TRANSPARENCY, _EMISSION = (march_coarse.PLANES.index(name) for name in ("transparency", "emission"))


@dataclass(frozen=True, eq=False)
class CoarseSixWay:
    """What such a march finds; H x W pixels.

    Attributes:
        planes: float32 tensor [9, H, W] on the smoke's device, `wlm_kernels.smoke.march_coarse.PLANES`.
        camera: From where it was looked at.
        hot: Whether the smoke has a temperature; otherwise the emission is 0.
    """

    planes: torch.Tensor
    camera: Camera
    hot: bool

    @property
    def six(self) -> SixWay:
        """The lightmaps, transparency and emission."""
        planes = self.planes
        return SixWay(planes[: len(DIRECTIONS)], planes[_TRANSPARENCY], planes[_EMISSION] if self.hot else None)

    @property
    def depth(self) -> torch.Tensor:
        """[H, W], distance along the ray to the smoke in the world's unit, 0 where there is none."""
        return self.planes[march_coarse.DEPTH]


def coarse_six_way(
    volume: DensityVolume,
    camera: Camera,
    *,
    step: float = 10.0,
    spacing: float | None = None,
    light_step: float | None = None,
    jitter: float = 1.0,
    seed: int = 0,
    threshold: float = 0.01,
    g: float = 0.0,
    cutoff: float = 1e-4,
) -> CoarseSixWay:
    """Marches through smoke in large steps.

    Args:
        volume: The smoke.
        camera: Orthographic.
        step: h, in voxels, the longest along the rays. Below 8 empty space is left out, which changes no result.
        spacing: The largest distance of the lattice's nodes, in voxels; None: as `step`. They are a quarter of a voxel
            apart at least, and more where there would be more than 2^28 of them. Each takes 24 bytes while this runs.
        light_step: The longest along the ways to the lights, in voxels; None: as `spacing`.
        jitter: Share of a step by which a pixel's samples are shifted, 0 to 1. The shifts are a pattern that varies
            little over a few pixels.
        seed: Of the jitter, any whole number; 64 of them differ.
        threshold: tau, the optical depth of one voxel from which on smoke has a surface.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        cutoff: A ray ends where less than this is left of its transparency.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: A setting is out of its range, or the camera is in perspective.
    """
    check_march(step, g, jitter)
    for name, value in (("spacing", spacing), ("light_step", light_step)):
        if value is not None:
            check_step(name, value)
    view, moved = camera.view(volume.origin, volume.voxel, volume.shape)
    with stream(device_name(volume.device)):
        size = (len(march_coarse.PLANES), camera.height, camera.width)
        planes = torch.empty(size, dtype=torch.float32, device=volume.device)
        density, temperature = volume.arrays()
        march_coarse.coarse_six_way(
            density,
            volume.extinction * volume.voxel,
            view,
            to_warp(planes),
            step=step,
            spacing=spacing,
            light_step=light_step,
            jitter=jitter,
            seed=seed,
            threshold=threshold,
            g=g,
            temperature=temperature,
            emission=volume.emission * volume.voxel,
            cutoff=cutoff,
            unit=volume.voxel,
            lead=moved,
            empty=torch_memory(volume.device),
        )
    return CoarseSixWay(planes, camera, volume.temperature is not None)
