"""Six-way lightmaps at the cost of a guiding map: one march in large steps that keeps the lights apart.

The paper marches in steps of 10 voxels for the sum of three lights, and leaves it to a network to recover six lightmaps
from it (section 4.2). The same march can keep the lights apart: those from the sides are marched to along the lines of
a lattice, once for all pixels; those from the front and the back follow from the ray's transparency T alone, exactly,
as (1 - T^2) / 2 and -T ln T. Its errors are those of its steps: along the rays, in T too, of the distance between the
lattice's nodes, where light is interpolated, and of the steps to the lights. Each is a setting of `March`.
"""

import torch

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import DIRECTIONS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.marching import run
from wlm_kernels.smoke import march_coarse
from wlm_kernels.smoke.settings import March

_TRANSPARENCY, _EMISSION = (march_coarse.PLANES.index(name) for name in ("transparency", "emission"))


def march(volume: DensityVolume, camera: Camera, march: March = March()) -> SixWay:
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
    """`march` as one tensor, float32 [9, H, W]: `wlm_kernels.smoke.march_coarse.PLANES`. Cold smoke emits 0."""
    return run(march_coarse.coarse_six_way, volume, camera, (len(march_coarse.PLANES),), march)
