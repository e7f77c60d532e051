"""The air's velocity beside the frames of a simulation: what tells how smoke moves from one frame to the next.

`velocity_0001.npz` has `velocity`, float16 [A, B, C, 3] on cells over the smoke's box: lengths of the world a frame, of
the air that carried the smoke to that frame.
"""

from pathlib import Path

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.npz import read_npz

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
