"""Marches in large steps: the paper's guiding maps (section 4.2), and six-way lightmaps at the same cost.

The paper marches in steps of 10 voxels for the sum of three lights, and a network recovers six lightmaps from it. The
same march can compute six separate lightmaps. The errors are those of the steps along the rays, of the interpolation
between the nodes of the lattice, and of the steps to the lights, all of which are settings of `March`.
"""

from dataclasses import dataclass, replace

import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.launch import run
from wlm.smoke.scene import Looks
from wlm_kernels.smoke import marches
from wlm_kernels.smoke.settings import March

_SURFACE = March(step=1.0, jitter=0.0)  # march for the depth at which obstacles and their shadows are drawn
_STEPS = 130  # steps through the box of `coarse_march`
_TRANSPARENCY, _EMISSION = (marches.PLANES.index(name) for name in ("transparency", "emission"))


def bake_coarse(volume: DensityVolume, camera: Camera, march: March = March()) -> SixWay:
    """Computes six-way lightmaps by one march in large steps.

    Args:
        volume: The smoke.
        camera: Orthographic.
        march: Settings. Steps below 8 voxels skip empty bricks, which changes no result. Nodes of the light lattice are
            at least a quarter of a voxel apart, and farther where there would be more than 2^28 of them; a node takes
            24 bytes. The jitter is gradient noise with 64 different seeds.

    Returns:
        Lightmaps, transparency, emission of hot smoke, and depth, on the smoke's device.

    Raises:
        ValueError: The camera is in perspective.
    """
    planes = march_planes(volume, camera, march)
    hot = planes[_EMISSION] if volume.temperature is not None else None
    return SixWay(planes[: len(DIRECTIONS)], planes[_TRANSPARENCY], hot, camera, planes[marches.DEPTH])


def coarse_march(volume: DensityVolume, seed: int = 0) -> March:
    """Returns a march in steps of 1/130 of the smoke's longest edge."""
    return March(max(volume.shape) / _STEPS, seed=seed)


def march_planes(volume: DensityVolume, camera: Camera, march: March) -> torch.Tensor:
    """Returns the result of `bake_coarse` as one tensor, float32 [9, H, W], see `wlm_kernels.smoke.marches.PLANES`."""
    return run(marches.coarse_six_way, volume, camera, (len(marches.PLANES),), march)


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
    """Computes a guiding map by a march in large steps (algorithm 1).

    Args:
        volume: The smoke.
        camera: Orthographic or in perspective. If it is inside the smoke, the light from the front starts there.
        march: Settings without `spacing` and `light_step`, which equal the step.
        shared: Whether pixels share marches to the lights, on a lattice with a node per step, which is much faster;
            light is then interpolated between nodes.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: The march has a spacing or a light_step.
    """
    for name in ("spacing", "light_step"):
        if getattr(march, name) is not None:
            raise ValueError(f"{name}: expected none for the paper's guiding map, got {getattr(march, name)}")
    return Guide(run(marches.guide, volume, camera, (3,), march, shared=shared), camera)


def with_surface(six: SixWay, volume: DensityVolume, looks: Looks | None) -> SixWay:
    """Returns lightmaps with the depth of the smoke's surface if a scene has obstacles, else without a depth."""
    obstacles = looks is not None and looks.obstacles
    return replace(six, depth=guide(volume, six.camera, _SURFACE).depth if obstacles else None)
