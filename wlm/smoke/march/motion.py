"""How smoke moves across the image between two frames, from the solver's own velocities.

The paper's temporal loss estimates this optical flow from images (neural-six-way-lightmaps, eq. 9).
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
from wlm_kernels.smoke import march_motion
from wlm_kernels.smoke.settings import March

_CUTOFF = 1e-3  # of a ray's transparency: smoke behind it hardly counts


def motion(
    volume: DensityVolume, velocity: wp.array, camera: Camera, *, reach: float, step: float = 2.0
) -> torch.Tensor:
    """Projects the air's motion into the image, weighted by the visibility of the smoke that it carries.

    A pixel shows smoke at many depths, each with a motion of its own: this is their mean, and hidden smoke hardly
    counts. Light that moves while smoke doesn't, such as a shadow's edge, isn't in it.

    Args:
        volume: The later frame's smoke.
        velocity: vec3 [A, B, C] on the smoke's device, of the air over the volume's box in cells of any size, as
            `Solver.velocity` has it.
        camera: Orthographic, the same for both frames.
        reach: Lengths of the world that a velocity of 1 goes between the frames: of a solver, a cell's edge times the
            steps of its lattice.
        step: The longest step, in voxels.

    Returns:
        float32 [2, H, W]: pixels to the right and down by which the smoke of a pixel has moved since the earlier frame;
        0 where there is no smoke. So the earlier frame, read at the pixel less this, shows the same smoke.

    Raises:
        ValueError: The camera is in perspective, the velocity isn't vec3 [A, B, C], or a number is out of its range.
    """
    march = March(step=step, cutoff=_CUTOFF)
    if not math.isfinite(reach):
        raise ValueError(f"reach: expected a finite length, got {reach}")
    if velocity.dtype is not wp.vec3 or velocity.ndim != 3 or 0 in velocity.shape:
        raise ValueError(f"velocity: expected vec3 [A, B, C], got {velocity.dtype.__name__} {velocity.shape}")
    return run(march_motion.motion, volume, camera, (2,), velocity, reach / volume.voxel, march)


_NAME = "velocity"
_LARGEST = 3 * 320**3  # numbers


def velocity_file(folder: Path, number: int) -> Path:
    """The file of a frame's velocity."""
    return folder / f"{_NAME}_{number:04d}.npz"


def write_velocity(path: Path, velocity: wp.array, reach: float) -> None:
    """Writes a velocity, atomically.

    Args:
        path: The file.
        velocity: vec3 [A, B, C].
        reach: Lengths of the world a frame that a velocity of 1 is.

    Raises:
        WlmError: It can't be written, or has more cells than `read_velocity` takes.
    """
    if 3 * velocity.size > _LARGEST:
        raise WlmError(f"{path}: expected at most {_LARGEST // 3} cells of air, found {velocity.size}")
    values = (reach * velocity.numpy()).astype(np.float16)
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **{_NAME: values})


def read_velocity(path: Path) -> np.ndarray:
    """Reads a velocity, float32 [A, B, C, 3].

    Raises:
        WlmError: The file is missing, damaged or holds something else.
    """
    values = read_npz(path, lambda names: [_NAME], numbers=_LARGEST)[_NAME]
    if values.dtype != np.float16 or values.ndim != 4 or values.shape[3] != 3 or 0 in values.shape:
        raise WlmError(f"{path}: {_NAME}: expected float16 [A, B, C, 3], found {values.dtype} {list(values.shape)}")
    if not np.isfinite(values).all():
        raise WlmError(f"{path}: {_NAME}: expected finite numbers, found NaN or infinity")
    return values.astype(np.float32)
