"""Boundary conditions on the six faces of a box of air, in the form for the kernels of `lattice_links`."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wlm_kernels.fluid.advection_places import CLOSED, OPEN, PERIODIC
from wlm_kernels.fluid.lattice_links import BOUNCE, INLET, OUTLET, PRESSURE, SLIP
from wlm_kernels.fluid.lattice_sets import VelocitySet

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""The faces, by the axis that they close and the end of it."""

# A link along an edge of the domain crosses two faces: the face of lower rank decides, then the order of FACES.
_STILL, _MOVING, _INLET, _OUTLET, _SLIP = range(5)


@dataclass(frozen=True, eq=False)
class Face:
    """The boundary condition on a face of A x B cells, along the two axes of the face in the order x, y, z.

    Attributes:
        rank: uint8 [A, B], precedence at the edges of the box, where two faces meet: the lower rank decides.
        kind: uint8 [A, B], kind of boundary of each cell, such as `lattice_links.BOUNCE`.
        velocity: float64 [A, B, 3], velocity of a wall or an inlet, cells per step.
        excess: Density minus 1 to which an outlet with a given density relaxes.
    """

    rank: np.ndarray
    kind: np.ndarray
    velocity: np.ndarray
    excess: float = 0.0


def _size(shape: tuple[int, int, int], face: str) -> tuple[int, int]:
    if face not in FACES:
        raise ValueError(f"face: expected one of {', '.join(FACES)}, got {face!r}")
    axis = FACES.index(face) // 2
    first, second = (size for a, size in enumerate(shape) if a != axis)
    return first, second


def _velocity(size: tuple[int, int], velocity) -> np.ndarray:
    velocity = np.asarray(velocity, np.float64)
    if velocity.shape not in ((3,), (*size, 3)):
        raise ValueError(f"velocity: expected shape (3,) or {(*size, 3)}, got {velocity.shape}")
    if not np.isfinite(velocity).all():
        raise ValueError("velocity: expected finite numbers, got NaN or infinity")
    return np.broadcast_to(velocity, (*size, 3))


def wall(shape: tuple[int, int, int], face: str, velocity=(0.0, 0.0, 0.0), slip: bool = False) -> Face:
    """Makes a no-slip wall that moves tangentially at `velocity` (cells per step), or a wall without friction."""
    size = _size(shape, face)
    velocity = _velocity(size, velocity)
    if slip:
        return Face(np.full(size, _SLIP), np.full(size, SLIP, np.uint8), velocity)
    return Face(np.where(velocity.any(-1), _MOVING, _STILL), np.full(size, BOUNCE, np.uint8), velocity)


def inlet(shape: tuple[int, int, int], face: str, velocity, where=None) -> Face:
    """Makes an inlet (velocity in cells per step) where `where`, bool [A, B], is true, and a wall elsewhere; None: an
    inlet everywhere."""
    size = _size(shape, face)
    opened = np.ones(size, bool) if where is None else np.asarray(where, bool)
    if opened.shape != size:
        raise ValueError(f"where: expected the shape {size} of the face, got {opened.shape}")
    velocity = np.where(opened[..., None], _velocity(size, velocity), 0.0)
    return Face(np.where(opened, _INLET, _STILL), np.where(opened, INLET, BOUNCE).astype(np.uint8), velocity)


def outlet(shape: tuple[int, int, int], face: str, density: float | None = None) -> Face:
    """Makes an outlet that conserves mass or, with `density`, an outlet whose density relaxes to this number."""
    size = _size(shape, face)
    if density is not None and not (np.isfinite(density) and density > 0.0):
        raise ValueError(f"density: expected a positive number, got {density}")
    kind = np.full(size, OUTLET if density is None else PRESSURE, np.uint8)
    return Face(np.full(size, _OUTLET), kind, np.zeros((*size, 3)), 0.0 if density is None else density - 1.0)


def bounded_axes(faces: Mapping[str, Face]) -> tuple[int, int, int]:
    """Returns 1 for each axis that has faces and 0 for each periodic axis.

    Raises:
        ValueError: Only one end of an axis has a face.
    """
    bounded = []
    for low, high in zip(FACES[::2], FACES[1::2], strict=True):
        if (low in faces) != (high in faces):
            missing = high if low in faces else low
            raise ValueError(f"face {missing!r}: expected a wall, an inlet or an outlet, since the other end has one")
        bounded.append(int(low in faces))
    return bounded[0], bounded[1], bounded[2]


def walled_axes(faces: Mapping[str, Face]) -> tuple[bool, bool, bool]:
    """Returns for each axis whether both of its ends are walls at rest, which the step's kernel handles itself."""
    still = [name in faces and bool((faces[name].rank == _STILL).all()) for name in FACES]
    return still[0] and still[1], still[2] and still[3], still[4] and still[5]


def axis_ends(faces: Mapping[str, Face]) -> tuple[tuple[int, int], ...]:
    """Returns what each axis's ends are for smoke: `PERIODIC`, `CLOSED` if the whole face is a wall, or `OPEN`."""
    ends = []
    for name in FACES:
        walled = name in faces and np.isin(faces[name].kind, (BOUNCE, SLIP)).all()
        ends.append(PERIODIC if name not in faces else CLOSED if walled else OPEN)
    return tuple(zip(ends[::2], ends[1::2], strict=True))


def face_links(
    shape: tuple[int, int, int], lattice: VelocitySet, faces: Mapping[str, Face]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lists the links of the faces: the populations that a boundary condition sends into the box.

    Axes with walls at rest at both ends have none. Links are sorted by direction, then by cell. The links of solid
    cells are included; the kernels skip them.

    Returns:
        `cell` int32 [L], `code` uint8 [L] and `term` float32 [L] of `wlm_kernels.fluid.lattice_links.Links`.
    """
    bounded = bounded_axes(faces)
    closed = np.array(walled_axes(faces))
    beside = np.zeros(shape, bool)
    for axis in range(3):
        if bounded[axis] and not closed[axis]:
            np.moveaxis(beside, axis, 0)[[0, -1]] = True
    cells = np.flatnonzero(beside)
    places = np.stack(np.unravel_index(cells, shape), 1)
    links = []
    for q in range(1, len(lattice.c)):
        source = places - np.array(lattice.c[q])
        walled = (((source < 0) | (source >= np.array(shape))) & closed).any(1)
        rank = np.full(len(cells), 255)
        kind, velocity, excess = np.zeros(len(cells), np.uint8), np.zeros((len(cells), 3)), np.zeros(len(cells))
        for number, name in enumerate(FACES):
            axis, high = divmod(number, 2)
            if name not in faces:
                continue
            face = faces[name]
            crossing = source[:, axis] >= shape[axis] if high else source[:, axis] < 0
            first, second = (places[:, a] for a in range(3) if a != axis)
            wins = crossing & (face.rank[first, second] < rank)
            at = first[wins], second[wins]
            rank[wins], kind[wins], velocity[wins] = face.rank[at], face.kind[at], face.velocity[at]
            excess[wins] = face.excess
        linked = (rank < 255) & ~walled
        momentum = 6.0 * lattice.w[q] * (velocity @ np.array(lattice.c[q], float))
        term = np.where((kind == BOUNCE) | (kind == INLET), momentum, excess)
        links.append((cells[linked], (q + 32 * kind)[linked], term[linked]))
    columns = zip(*links, strict=True)
    return tuple(np.concatenate(c).astype(t) for c, t in zip(columns, (np.int32, np.uint8, np.float32), strict=True))
