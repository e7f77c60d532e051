"""Marches in large steps: the paper's guiding maps (section 4.2), and six-way lightmaps at the same cost.

The paper marches in steps of 10 voxels for the sum of three lights, and a network computes six lightmaps from this sum.
The same march can compute the six lightmaps separately. Errors come from the step along the rays, from the step to the
lights, and from interpolation on the lattice that stores optical depths to the lights; `March` sets these three sizes.
"""

from dataclasses import dataclass, replace

import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.launch import run
from wlm.smoke.scene import Looks
from wlm_kernels.smoke import marches
from wlm_kernels.smoke.settings import LEAST_STEP, March

_SURFACE = March(step=1.0, jitter=0.0)  # march for the depth at which obstacles and their shadows are drawn
_STEPS = 130  # steps through the box of `coarse_march`
_TRANSPARENCY, _EMISSION = (marches.PLANES.index(name) for name in ("transparency", "emission"))


def bake_coarse(volume: DensityVolume, camera: Camera, march: March = March()) -> SixWay:
    """Computes six-way lightmaps by one march in large steps.

    Args:
        volume: The smoke.
        camera: Orthographic.
        march: Settings. Nodes of the lattice that stores optical depths to the lights are at least a quarter of a voxel
            apart, and farther apart if there would be more than 2^28 nodes; a node takes 24 bytes. There are 64
            different seeds of the jitter, which is gradient noise.

    Returns:
        Lightmaps, transparency, emission of hot smoke, and depth, on the smoke's device.

    Raises:
        ValueError: The camera is in perspective.
    """
    planes = march_planes(volume, camera, march)
    hot = planes[_EMISSION] if volume.temperature is not None else None
    return SixWay(planes[: len(DIRECTIONS)], planes[_TRANSPARENCY], hot, camera, planes[marches.DEPTH])


def coarse_march(volume: DensityVolume, seed: int = 0) -> March:
    """Returns settings of a march in steps of 1/130 of the smoke's longest edge, with a seed for its jitter."""
    return March(max(max(volume.shape) / _STEPS, LEAST_STEP), seed=seed)


def march_planes(volume: DensityVolume, camera: Camera, march: March) -> torch.Tensor:
    """Returns the result of `bake_coarse` as one tensor, float32 [9, H, W], see `wlm_kernels.smoke.marches.PLANES`."""
    return run(marches.coarse_six_way, volume, camera, (len(marches.PLANES),), march)


@dataclass(frozen=True, eq=False)
class Guide:
    """A guiding map of H x W pixels (algorithm 1): a cheap picture of smoke, from which a network predicts lightmaps.

    Attributes:
        maps: float32 tensor [3, H, W] on the smoke's device: light, transparency, depth.
        camera: Camera of the maps.
    """

    maps: torch.Tensor
    camera: Camera

    @property
    def light(self) -> torch.Tensor:
        """Light scattered to the camera, [H, W], from three lights of irradiance 4 pi: at the front, top and bottom."""
        return self.maps[0]

    @property
    def transparency(self) -> torch.Tensor:
        """Transparency of the smoke, 0 to 1, [H, W]: 1 where there is no smoke."""
        return self.maps[1]

    @property
    def depth(self) -> torch.Tensor:
        """Distance along the ray to the smoke in world units, [H, W]: 0 where there is no smoke."""
        return self.maps[2]


def guide(volume: DensityVolume, camera: Camera, march: March = March(), *, shared: bool = True) -> Guide:
    """Computes a guiding map by a march in large steps (algorithm 1).

    Args:
        volume: The smoke.
        camera: Orthographic or in perspective. If it is inside the smoke, the light from the front starts there.
        march: Settings without `spacing` and `light_step`, which equal the step.
        shared: Whether pixels share the marches to the lights, on a lattice with a node per step, which is much faster;
            light is then interpolated between nodes.

    Returns:
        The maps, on the smoke's device.

    Raises:
        ValueError: The march has a spacing or a light_step.
    """
    for name in ("spacing", "light_step"):
        if getattr(march, name) is not None:
            raise ValueError(f"{name}: expected None, since a guiding map uses the step, got {getattr(march, name)}")
    return Guide(run(marches.guide, volume, camera, (3,), march, shared=shared), camera)


def with_surface(six: SixWay, volume: DensityVolume, looks: Looks | None) -> SixWay:
    """Returns lightmaps with the depth of the smoke's surface if `looks` has obstacles, else without a depth."""
    obstacles = looks is not None and looks.obstacles
    return replace(six, depth=guide(volume, six.camera, _SURFACE).depth if obstacles else None)
