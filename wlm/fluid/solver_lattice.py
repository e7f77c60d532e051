"""What the solver has to know of its lattice and its device."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.faces import FACES
from wlm.fluid.lattice import Lattice
from wlm.interop import free_memory
from wlm_kernels.fluid.advection_places import CLOSED, OPEN, PERIODIC
from wlm_kernels.fluid.lattice_links import BOUNCE, SLIP

__all__ = ["adding", "ends", "has_bricks", "require_memory"]


def has_bricks(lattice: Lattice) -> bool:
    """Whether only a part of the air is worked on."""
    return lattice.bricks


def ends(lattice: Lattice) -> tuple[tuple[int, int], ...]:
    """For each axis what its two ends are to smoke; a face that isn't all wall is open."""
    found = []
    for name in FACES:
        face = lattice.faces.get(name)
        walled = face is not None and np.isin(face.kind, (BOUNCE, SLIP)).all()
        found.append(PERIODIC if face is None else CLOSED if walled else OPEN)
    return tuple(zip(found[::2], found[1::2], strict=True))


def require_memory(shape: tuple[int, int, int], cell_bytes: int, device: wp.Device) -> None:
    """Checks that the grids of smoke can be allocated, and their cells counted.

    Raises:
        WlmError: They can't.
    """
    x, y, z = shape
    if x * y * z >= 2**31:
        raise WlmError(f"smoke: {x} x {y} x {z} cells: expected fewer than 2^31: use a lower refinement")
    needed = cell_bytes * x * y * z
    free = free_memory(device)
    if needed > free:
        raise WlmError(
            f"smoke: {x} x {y} x {z} cells need {needed / 2**30:.1f} GiB on {device}: expected at most the"
            f" {free / 2**30:.1f} GiB that are free: use a lower refinement, storage='float16' or the scheme"
            " 'semi-lagrangian'"
        )


@contextmanager
def adding(what: Callable[[], str]) -> Iterator[None]:
    """Adds something to the line of an error."""
    try:
        yield
    except WlmError as error:
        raise WlmError(f"{error}{what()}") from error
