"""Six-way lightmaps at the cost of a guiding map: one march in large steps that keeps the lights apart.

The paper marches in steps of 10 voxels for the sum of three lights, and leaves it to a network to recover six lightmaps
from it (section 4.2). The same march can keep the lights apart: those from the sides are marched to along the lines of
a lattice, once for all pixels; those from the front and the back follow from the ray's transparency T alone, exactly,
as (1 - T^2) / 2 and -T ln T. Its errors are those of its steps: along the rays, in T too, of the distance between the
lattice's nodes, where light is interpolated, and of the steps to the lights. Each is a setting of `March`.
"""

from dataclasses import dataclass

import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.launch import run
from wlm_kernels.smoke import march_coarse, march_guide
from wlm_kernels.smoke.settings import March

_TRANSPARENCY, _EMISSION = (march_coarse.PLANES.index(name) for name in ("transparency", "emission"))


def bake_coarse(volume: DensityVolume, camera: Camera, march: March = March()) -> SixWay:
    """Marches through smoke in large steps.

    Args:
        volume: The smoke.
        camera: Orthographic.
        march: With steps below 8 voxels empty space is left out, which changes no result. Nodes are a quarter of a
            voxel apart at least, and more where there would be more than 2^28 of them; each takes 24 bytes while this
            runs. The jitter is a pattern that varies little over a few pixels, of which 64 seeds differ.

    Returns:
        Lightmaps, transparency, emission of hot smoke, and depth, on the smoke's device.

    Raises:
        ValueError: The camera is in perspective.
    """
    planes = march_planes(volume, camera, march)
    hot = planes[_EMISSION] if volume.temperature is not None else None
    return SixWay(planes[: len(DIRECTIONS)], planes[_TRANSPARENCY], hot, camera, planes[march_coarse.DEPTH])


def march_planes(volume: DensityVolume, camera: Camera, march: March) -> torch.Tensor:
    """`bake_coarse` as one tensor, float32 [9, H, W]: `wlm_kernels.smoke.march_coarse.PLANES`. Cold smoke emits 0."""
    return run(march_coarse.coarse_six_way, volume, camera, (len(march_coarse.PLANES),), march)


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
        march: Without `spacing` and `light_step`: nodes and steps to the lights are those of the rays.
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
    return Guide(run(march_guide.guide, volume, camera, (3,), march, shared=shared), camera)
