"""Six-way lightmaps at the cost of a guiding map: one march in large steps that shares the ways to the lights.

The paper marches in steps of 10 voxels for the sum of three lights, and leaves it to a network to find six lightmaps in
it (section 4.2). The same march can keep the lights apart: those from the sides take a lattice of nodes, as for the
guiding map, those from the front and the back follow from the transparency alone, exactly. What it lacks is the error
of its step.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from wlm.interop import device_name, stream, to_warp, torch_memory
from wlm.smoke.axes import DIRECTIONS, Camera
from wlm.smoke.guide import check_march
from wlm.smoke.reference import SixWay
from wlm.smoke.volume import DensityVolume
from wlm_kernels import marching_coarse

__all__ = ["CoarseSixWay", "coarse_six_way"]

_TRANSPARENCY, _EMISSION = (marching_coarse.PLANES.index(name) for name in ("transparency", "emission"))


@dataclass(frozen=True, eq=False)
class CoarseSixWay:
    """What such a march finds; H x W pixels.

    Attributes:
        planes: float32 tensor [9, H, W] on the smoke's device, `wlm_kernels.marching_coarse.PLANES`.
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
        return self.planes[marching_coarse.DEPTH]


def coarse_six_way(
    volume: DensityVolume,
    camera: Camera,
    *,
    step: float = 10.0,
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
        step: h, in voxels.
        jitter: Share of a step by which a pixel's samples are shifted at random, 0 to 1.
        seed: Of the jitter.
        threshold: tau, the optical depth of one voxel from which on smoke has a surface.
        g: Henyey and Greenstein's mean cosine, within -1 and 1.
        cutoff: A ray ends where less than this is left of its transparency.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: A setting is out of its range, or the camera is in perspective.
    """
    check_march(step, g, jitter)
    view, moved = camera.view(volume.origin, volume.voxel, volume.shape)
    with stream(device_name(volume.device)):
        size = (len(marching_coarse.PLANES), camera.height, camera.width)
        planes = torch.empty(size, dtype=torch.float32, device=volume.device)
        density, temperature = volume.arrays()
        marching_coarse.coarse_six_way(
            density,
            volume.extinction * volume.voxel,
            view,
            to_warp(planes),
            step=step,
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
