"""Arrays that need not fit in memory: large ones lie in a file without a name, which is gone with the process."""

import math
import mmap
import os
import tempfile

import numpy as np

from wlm.errors import WlmError

IN_MEMORY = 1 << 30
"""Bytes of an array that are held in memory; a larger one is in a file of the folder for temporary files (TMPDIR)."""

_PIECE = 1 << 24


def room(shape: tuple[int, ...], dtype: type[np.generic] | np.dtype, where: str, beside: int = 0) -> np.ndarray:
    """Makes an array of zeros, in memory or in a file that is mapped.

    The system writes parts of a mapped array to the disk and drops them from memory when that is short. The file has no
    name, so that nothing is left of it however the process ends, and all of its space is taken at once: a disk that
    fills up later would end the process without a word.

    Args:
        shape: Of the array.
        dtype: Of its values.
        where: What it is for, for messages.
        beside: Bytes of other arrays that are needed with it: they count too.

    Returns:
        A plain array of that shape, written and read as any other.

    Raises:
        WlmError: Memory or the disk hasn't that much room.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    try:
        if size + beside <= IN_MEMORY:
            return np.zeros(shape, dtype)
        with tempfile.TemporaryFile() as file:
            _fill(file.fileno(), size)
            return np.frombuffer(mmap.mmap(file.fileno(), size), dtype).reshape(shape)
    except MemoryError as error:
        raise WlmError(f"{where}: {size:,} bytes: {error}") from error
    except OSError as error:
        reason = error.strerror or error
        raise WlmError(f"{where}: {size:,} bytes in {tempfile.gettempdir()} (TMPDIR): {reason}") from error


def _fill(handle: int, size: int) -> None:
    """Takes the space of a file, as zeros."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(handle, 0, size)
        return
    zeros = bytes(_PIECE)
    while size:
        size -= os.write(handle, zeros[: min(size, _PIECE)])
