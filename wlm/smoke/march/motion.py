"""Motion of smoke across the image between two frames, from the velocities of the air, and files of the velocities.

The paper's temporal loss estimates this optical flow from images (neural-six-way-lightmaps, eq. 9).

`velocity_0001.npz` beside frame 1 has `velocity`, float16 [A, B, C, 3] on cells over the smoke's box: the velocity of
the air that carried the smoke to this frame, in world units per frame.
"""

import math
from pathlib import Path

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.formats.atomic import atomic_path
from wlm.formats.npz import read_npz
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

    Raises:
        ValueError: The camera is in perspective, the velocity is not vec3 [A, B, C], or a number is out of its range.
    """
    march = March(step=step, cutoff=_CUTOFF)
    if not math.isfinite(reach):
        raise ValueError(f"reach: expected a finite length, got {reach}")
    if velocity.dtype is not wp.vec3 or velocity.ndim != 3 or 0 in velocity.shape:
        raise ValueError(f"velocity: expected vec3 [A, B, C], got {velocity.dtype.__name__} {velocity.shape}")
    return run(marches.motion, volume, camera, (2,), velocity, reach / volume.voxel, march)


_NAME = "velocity"
_LARGEST = 3 * 320**3  # numbers


def velocity_file(folder: Path, number: int) -> Path:
    """Returns the path of the file with a frame's velocities, which may not exist."""
    return folder / f"{_NAME}_{number:04d}.npz"


def write_velocity(path: Path, velocity: wp.array, reach: float) -> None:
    """Writes the velocities of a frame, vec3 [A, B, C], times `reach`, which converts them to world units per frame.

    Raises:
        WlmError: The file cannot be written, or there are more cells than `read_velocity` accepts.
    """
    if 3 * velocity.size > _LARGEST:
        raise WlmError(f"{path}: expected at most {_LARGEST // 3} cells of air, got {velocity.size}")
    values = (reach * velocity.numpy()).astype(np.float16)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **{_NAME: values})


def read_velocity(path: Path) -> np.ndarray:
    """Reads the velocities of a frame in world units per frame, float32 [A, B, C, 3].

    Raises:
        WlmError: The file is missing, damaged or has other content.
    """
    values = read_npz(path, lambda names: [_NAME], numbers=_LARGEST)[_NAME]
    if values.dtype != np.float16 or values.ndim != 4 or values.shape[3] != 3 or 0 in values.shape:
        raise WlmError(f"{path}: {_NAME}: expected float16 [A, B, C, 3], found {values.dtype} {list(values.shape)}")
    if not np.isfinite(values).all():
        raise WlmError(f"{path}: {_NAME}: expected finite numbers, found NaN or infinity")
    return values.astype(np.float32)
