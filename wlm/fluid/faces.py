"""Boundary conditions on the six faces of a lattice's domain, and their links (``wlm_kernels.fluid.lattice_links``)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wlm_kernels.fluid.lattice_links import BOUNCE, INLET, OUTLET, PRESSURE, SLIP
from wlm_kernels.fluid.lattice_sets import VelocitySet

__all__ = ["FACES", "Face", "bounded_axes", "face_links", "inlet", "outlet", "wall", "walled_axes"]

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""The faces, by the axis that they close and the end of it."""

# Where a link crosses two faces, along an edge of the domain, the least of these decides, then the order of FACES.
_STILL, _MOVING, _INLET, _OUTLET, _SLIP = range(5)


@dataclass(frozen=True, eq=False)
class Face:
    """One face; its cells in the order of the two axes that are left.

    Attributes:
        rank: uint8 [A, B], what decides along edges.
        kind: uint8 [A, B], kinds of ``lattice_links``.
        velocity: float64 [A, B, 3], of a wall or an inlet, cells a step.
        excess: Density less 1 of an outlet that holds it.
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
    given = np.asarray(velocity, np.float64)
    if given.shape not in ((3,), (*size, 3)):
        raise ValueError(f"velocity: expected shape (3,) or {(*size, 3)}, got {given.shape}")
    if not np.isfinite(given).all():
        raise ValueError("velocity: expected finite numbers")
    return np.broadcast_to(given, (*size, 3))


def wall(shape: tuple[int, int, int], face: str, velocity=(0.0, 0.0, 0.0), slip: bool = False) -> Face:
    """A wall; one that slips has no velocity."""
    size = _size(shape, face)
    given = _velocity(size, velocity)
    if slip:
        return Face(np.full(size, _SLIP), np.full(size, SLIP, np.uint8), given)
    return Face(np.where(given.any(-1), _MOVING, _STILL), np.full(size, BOUNCE, np.uint8), given)


def inlet(shape: tuple[int, int, int], face: str, velocity, where=None) -> Face:
    """An inlet where ``where`` (bool [A, B], None: all) is true, a wall elsewhere."""
    size = _size(shape, face)
    opened = np.ones(size, bool) if where is None else np.asarray(where, bool)
    if opened.shape != size:
        raise ValueError(f"where: expected shape {size}, got {opened.shape}")
    given = np.where(opened[..., None], _velocity(size, velocity), 0.0)
    return Face(np.where(opened, _INLET, _STILL), np.where(opened, INLET, BOUNCE).astype(np.uint8), given)


def outlet(shape: tuple[int, int, int], face: str, density: float | None = None) -> Face:
    """An outlet that conserves mass, or one that holds a density."""
    size = _size(shape, face)
    if density is not None and not (np.isfinite(density) and density > 0.0):
        raise ValueError(f"density: expected a positive number, got {density}")
    kind = np.full(size, OUTLET if density is None else PRESSURE, np.uint8)
    return Face(np.full(size, _OUTLET), kind, np.zeros((*size, 3)), 0.0 if density is None else density - 1.0)


def bounded_axes(faces: Mapping[str, Face]) -> tuple[int, int, int]:
    """1 for each axis that has faces, 0 for a periodic one.

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
    """Whether each axis is closed by walls at rest: the kernels see to those, without links."""
    still = [name in faces and bool((faces[name].rank == _STILL).all()) for name in FACES]
    return still[0] and still[1], still[2] and still[3], still[4] and still[5]


def face_links(
    shape: tuple[int, int, int], lattice: VelocitySet, faces: Mapping[str, Face]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The links of all faces but those of walled axes, direction by direction, each in the order of the cells.

    Solid cells have theirs too: the kernels pass over them.

    Returns:
        Cells int32 [L], codes uint8 [L] and terms float32 [L].
    """
    bounded = bounded_axes(faces)
    closed = np.array(walled_axes(faces))
    beside = np.zeros(shape, bool)
    for axis in range(3):
        if bounded[axis] and not closed[axis]:
            np.moveaxis(beside, axis, 0)[[0, -1]] = True
    cells = np.flatnonzero(beside)
    places = np.stack(np.unravel_index(cells, shape), 1)
    found = []
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
        held = (rank < 255) & ~walled
        moved = 6.0 * lattice.w[q] * (velocity @ np.array(lattice.c[q], float))
        term = np.where((kind == BOUNCE) | (kind == INLET), moved, excess)
        found.append((cells[held], (q + 32 * kind)[held], term[held]))
    columns = zip(*found, strict=True)
    return tuple(np.concatenate(c).astype(t) for c, t in zip(columns, (np.int32, np.uint8, np.float32), strict=True))
