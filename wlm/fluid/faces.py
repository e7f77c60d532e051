"""Boundary conditions on the six faces of a box of air, in the form for the kernels of `lattice_links`."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wlm_kernels.fluid.advection_places import CLOSED, OPEN, PERIODIC
from wlm_kernels.fluid.lattice_links import BOUNCE, INLET, OUTLET, PRESSURE, SLIP, WIND
from wlm_kernels.fluid.lattice_sets import VelocitySet

FACES = ("-x", "+x", "-y", "+y", "-z", "+z")
"""The faces, by the axis that they close and the end of it."""

# A link along an edge of the domain crosses two faces: the face of lower rank decides, then the order of FACES.
_RANKS = {BOUNCE: 1, INLET: 2, WIND: 2, OUTLET: 3, PRESSURE: 3, SLIP: 4}
_STILL = 0  # a wall at rest


@dataclass(frozen=True, eq=False)
class Face:
    """The boundary condition on a face of A x B cells, along the two axes of the face in the order x, y, z: for each
    cell the kind of boundary, such as `lattice_links.BOUNCE`; the velocity of a wall or an inlet, float64 [A, B, 3],
    cells per step; and its rank: where two faces meet at the edges of the box, the lower decides. `excess` is the
    density minus 1 to which an outlet with a given density relaxes."""

    rank: np.ndarray
    kind: np.ndarray
    velocity: np.ndarray
    excess: float = 0.0


def make_face(
    shape: tuple[int, int, int], name: str, kind: int, velocity=(0.0, 0.0, 0.0), density=None, where=None
) -> Face:
    """Makes the condition of kind `kind`, such as `lattice_links.BOUNCE`, on the face `name` of `FACES` of a box of
    `shape` cells.

    `velocity` is that of a wall or an inlet in cells per step, (3,) or [A, B, 3]; `density`, above 0, that to which an
    outlet relaxes; `where`, bool [A, B], is false where the face is a wall at rest instead.
    """
    if name not in FACES:
        raise ValueError(f"face: expected one of {', '.join(FACES)}, got {name!r}")
    size = tuple(np.delete(shape, FACES.index(name) // 2).tolist())
    velocity = np.asarray(velocity, np.float64)
    if velocity.shape not in ((3,), (*size, 3)):
        raise ValueError(f"velocity: expected shape (3,), or {(*size, 3)} for each cell, got {velocity.shape}")
    if not np.isfinite(velocity).all():
        raise ValueError("velocity: expected finite numbers, got NaN or infinity")
    if density is not None and not (np.isfinite(density) and density > 0.0):
        raise ValueError(f"density: expected an outlet's density, a number above 0, got {density}")
    opened = np.ones(size, bool) if where is None else np.asarray(where, bool)
    if opened.shape != size:
        raise ValueError(f"where: expected a mask of the cells of the face, shape {size}, got shape {opened.shape}")
    velocity = np.where(opened[..., None], velocity, 0.0)
    still = ~opened | ((kind == BOUNCE) & ~velocity.any(-1))
    rank = np.where(still, _STILL, _RANKS[kind])
    return Face(rank, np.where(opened, kind, BOUNCE), velocity, 0.0 if density is None else density - 1.0)


def bounded_axes(faces: Mapping[str, Face]) -> tuple[int, int, int]:
    """Returns 1 for each axis that has faces and 0 for each periodic axis."""
    bounded = []
    for low, high in zip(FACES[::2], FACES[1::2], strict=True):
        if (low in faces) != (high in faces):
            missing = high if low in faces else low
            raise ValueError(f"face {missing!r}: expected a wall, an inlet or an outlet, as the opposite face has one")
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


def inlet_rows(faces: Mapping[str, Face]) -> np.ndarray:
    """Returns int32, for each cell of each face in the order of `FACES`: its number among the inlets' cells, or -1."""
    opened = [(faces[name].kind == INLET).ravel() for name in FACES if name in faces]
    inlet = np.concatenate([np.zeros(0, bool), *opened])
    return np.where(inlet, np.cumsum(inlet) - 1, -1).astype(np.int32)


def face_links(
    shape: tuple[int, int, int], lattice: VelocitySet, faces: Mapping[str, Face]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Lists the links of the faces: the populations that a boundary condition sends into the box.

    Axes with walls at rest at both ends have none. Links are sorted by direction, then by cell. The links of solid
    cells are included; the kernels skip them.

    Returns:
        `cell` int32 [L], `code` uint8 [L] and `term` float32 [L] of `wlm_kernels.fluid.lattice_links.Links`; and
        int32 [L], the cell of a face that decides, numbered through all faces in the order of `FACES`.
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
        decides, before = np.zeros(len(cells), np.int32), 0
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
            decides[wins] = before + at[0] * face.kind.shape[1] + at[1]
            before += face.kind.size
        linked = (rank < 255) & ~walled
        momentum = 6.0 * lattice.w[q] * (velocity @ np.array(lattice.c[q], float))
        term = np.where((kind == BOUNCE) | (kind == INLET), momentum, excess)
        links.append((cells[linked], (q + 32 * kind)[linked], term[linked], decides[linked]))
    types = np.int32, np.uint8, np.float32, np.int32
    return tuple(np.concatenate(c).astype(t) for c, t in zip(zip(*links, strict=True), types, strict=True))
