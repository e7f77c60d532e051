"""Motion of smoke across the image between two frames, from the velocities of the air.

The paper's temporal loss estimates this optical flow from images (neural-six-way-lightmaps, eq. 9).
"""

import math

import torch
import warp as wp

from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.march.launch import run
from wlm_kernels.smoke import marches
from wlm_kernels.smoke.settings import March

_CUTOFF = 1e-3  # transparency of a ray at which it ends


def motion(
    volume: DensityVolume, velocity: wp.array, camera: Camera, *, reach: float, step: float = 2.0
) -> torch.Tensor:
    """Computes how far the smoke in each pixel has moved across the image since the earlier frame.

    A pixel shows smoke at many depths with different motions: the result is their mean, in which hidden smoke has
    little weight. Motion of light without motion of smoke, such as that of a shadow's edge, is not included.

    Args:
        volume: The later frame's smoke.
        velocity: vec3 [A, B, C] on the smoke's device, velocity of the air over the volume's box in cells of any size,
            as `Solver.velocity`.
        camera: Orthographic, the same for both frames.
        reach: Distance in world units that a velocity of 1 moves between the frames: for a solver, the edge of a cell
            times the number of air steps.
        step: Longest step of the march in voxels.

    Returns:
        float32 [2, H, W]: pixels to the right and down by which the smoke of a pixel has moved since the earlier frame;
        0 where there is no smoke. The earlier frame, read at the pixel minus this motion, shows the same smoke.
    """
    march = March(step=step, cutoff=_CUTOFF)
    if not math.isfinite(reach):
        raise ValueError(f"reach: expected a finite length, got {reach}")
    if velocity.dtype is not wp.vec3 or velocity.ndim != 3 or 0 in velocity.shape:
        raise ValueError(f"velocity: expected vec3 [A, B, C], got {velocity.dtype.__name__} {velocity.shape}")
    return run(marches.motion, volume, camera, (2,), velocity, reach / volume.voxel, march)
