"""Arrays that may exceed the memory: large ones are mapped from an unnamed file, which vanishes with the process."""

import math
import mmap
import os
import tempfile

import numpy as np

from wlm.errors import WlmError

IN_MEMORY = 1 << 30
"""Largest array in memory, in bytes; a larger one is mapped from a file in the temporary folder (TMPDIR)."""

_PIECE = 1 << 24


def room(shape: tuple[int, ...], dtype: type[np.generic] | np.dtype, where: str, beside: int = 0) -> np.ndarray:
    """Makes an array of zeros, in memory or mapped from a file; `where` is its purpose for messages, and `beside` are
    bytes of other arrays, which count towards the limit of memory, `IN_MEMORY`.

    The system moves parts of a mapped array to the disk when memory is short. The file has no name, so that nothing
    remains however the process ends. All of its space is allocated at once, since a disk that fills up later would end
    the process without a message.
    """
    size = math.prod(shape) * np.dtype(dtype).itemsize
    try:
        if size + beside <= IN_MEMORY:
            return np.zeros(shape, dtype)
        with tempfile.TemporaryFile() as file:
            _fill(file.fileno(), size)
            return np.frombuffer(mmap.mmap(file.fileno(), size), dtype).reshape(shape)
    except MemoryError as error:
        raise WlmError(f"{where}: needs {size:,} bytes of memory: {error}") from error
    except OSError as error:
        reason = error.strerror or error
        raise WlmError(f"{where}: needs {size:,} bytes in {tempfile.gettempdir()} (TMPDIR): {reason}") from error


def _fill(handle: int, size: int) -> None:
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(handle, 0, size)
        return
    zeros = bytes(_PIECE)
    while size:
        size -= os.write(handle, zeros[: min(size, _PIECE)])
