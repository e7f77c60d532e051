"""What the kernels of the lattice Boltzmann solver share: sets of velocities, cells, moments, equilibria, storage.

Cells are counted with the last axis fastest, as arrays [X, Y, Z] lie in memory: cell = (x Y + y) Z + z. Velocities
come in pairs, q and its opposite side by side: 0 rests, 1 and 2 are opposite, 3 and 4 are, and so on.

Populations are stored as f - w, the deviation from fluid at rest at density 1: their sum is the deviation of the
density, which float32 would otherwise round at 1e-7 of 1 at every step, and 16 bits could not hold at all.
"""

import functools
import itertools
from dataclasses import dataclass
from typing import Any

import warp as wp

__all__ = [
    "BRICK_CELLS",
    "HALF_SCALE",
    "LATTICES",
    "NARROW",
    "STORAGES",
    "VelocitySet",
    "Tables",
    "brick_shape",
    "lattice",
    "memory_functions",
    "opposite",
    "tables",
]

HALF_SCALE = 32768.0
"""16-bit populations are stored times this: +-2 is the range, 1.9e-9 the smallest that keeps all 11 bits."""

STORAGES = {"float32": (wp.float32, 1.0), "float16": (wp.float16, HALF_SCALE)}

BRICK_CELLS = 512


def brick_shape(shape: tuple[int, int, int]) -> tuple[int, int, int]:
    """Cells of a brick along each axis, always ``BRICK_CELLS`` in all; at least 8 wherever the domain is thick."""
    return (16, 32, 1) if shape[2] == 1 else (8, 8, 8)


@dataclass(frozen=True)
class VelocitySet:
    """A set of velocities.

    Attributes:
        name: "D2Q9", "D3Q19" or "D3Q27".
        axes: 2 or 3; the plane of two axes is x, y.
        c: The velocities, cells a step.
        w: Their weights.
    """

    name: str
    axes: int
    c: tuple[tuple[int, int, int], ...]
    w: tuple[float, ...]


def _make(name: str, axes: int, weights: tuple[float, ...]) -> VelocitySet:
    """A set with all velocities of -1, 0 and 1 that have a weight, which goes by their squared length."""
    signs = itertools.product(*[(-1, 0, 1) if a < axes else (0,) for a in range(3)])
    half = [c for c in signs if c > (0, 0, 0) and sum(map(abs, c)) < len(weights)]
    half.sort(key=lambda c: (sum(map(abs, c)), c))
    c = [(0, 0, 0)]
    for one in half:
        c += [one, tuple(-a for a in one)]
    return VelocitySet(name, axes, tuple(c), tuple(weights[sum(map(abs, one))] for one in c))


LATTICES = {
    "D2Q9": _make("D2Q9", 2, (4 / 9, 1 / 9, 1 / 36)),
    "D3Q19": _make("D3Q19", 3, (1 / 3, 1 / 18, 1 / 36)),
    "D3Q27": _make("D3Q27", 3, (8 / 27, 2 / 27, 1 / 54, 1 / 216)),
}


def lattice(name: str) -> VelocitySet:
    """One of ``LATTICES``.

    Raises:
        ValueError: There is no such lattice.
    """
    if name not in LATTICES:
        raise ValueError(f"lattice: expected one of {', '.join(LATTICES)}, got {name!r}")
    return LATTICES[name]


@wp.struct
class Tables:
    """A set of velocities for kernels that look directions up.

    Attributes:
        c: vec3i [Q].
        w: float [Q].
        index: int [27], the direction of (cx, cy, cz) at 9 (cx + 1) + 3 (cy + 1) + cz + 1.
    """

    c: wp.array1d[wp.vec3i]
    w: wp.array1d[float]
    index: wp.array1d[int]


@functools.cache
def tables(name: str, device: str) -> Tables:
    """The tables of a lattice on a device, made once."""
    found = lattice(name)
    index = [0] * 27
    for q, (x, y, z) in enumerate(found.c):
        index[9 * (x + 1) + 3 * (y + 1) + z + 1] = q
    out = Tables()
    out.c = wp.array(found.c, dtype=wp.vec3i, device=device)
    out.w = wp.array(found.w, dtype=float, device=device)
    out.index = wp.array(index, dtype=int, device=device)
    return out


@wp.func
def opposite(q: int) -> int:
    if q == 0:
        return 0
    return ((q - 1) ^ 1) + 1


@wp.func
def cell_of(n: wp.vec3i, i: int) -> wp.vec3i:
    """Where cell i lies."""
    # Two divisions, not four: a remainder would be a division of its own. Those of signed numbers take twice as long.
    row = int(wp.uint32(i) // wp.uint32(n[2]))
    x = int(wp.uint32(row) // wp.uint32(n[1]))
    return wp.vec3i(x, row - x * n[1], i - row * n[2])


@wp.func
def index_of(n: wp.vec3i, p: wp.vec3i) -> int:
    return (p[0] * n[1] + p[1]) * n[2] + p[2]


@wp.func
def wrapped(n: wp.vec3i, p: wp.vec3i) -> wp.vec3i:
    """A place at most one cell outside, seen as periodic."""
    return wp.vec3i((p[0] + n[0]) % n[0], (p[1] + n[1]) % n[1], (p[2] + n[2]) % n[2])


@wp.func
def crosses(n: wp.vec3i, bounded: wp.vec3i, p: wp.vec3i) -> bool:
    """Whether a place lies beyond a face of an axis that isn't periodic."""
    x = bounded[0] != 0 and (p[0] < 0 or p[0] >= n[0])
    y = bounded[1] != 0 and (p[1] < 0 or p[1] >= n[1])
    z = bounded[2] != 0 and (p[2] < 0 or p[2] >= n[2])
    return x or y or z


@wp.func
def owned(n: wp.vec3i, bounded: wp.vec3i, walled: wp.vec3i, p: wp.vec3i) -> bool:
    """Whether what leaves a cell for p is kept in the cell's own place; else that is a link's."""
    return crosses(n, walled, p) or not crosses(n, bounded, p)


@wp.func
def brick_of(n: wp.vec3i, brick: wp.vec3i, p: wp.vec3i) -> int:
    """The number of the brick that a cell lies in."""
    rows = (n[1] + brick[1] - 1) // brick[1]
    columns = (n[2] + brick[2] - 1) // brick[2]
    return (p[0] // brick[0] * rows + p[1] // brick[1]) * columns + p[2] // brick[2]


@wp.func
def cell_in_brick(n: wp.vec3i, brick: wp.vec3i, b: int, k: int) -> wp.vec3i:
    """The k-th cell of brick b; it may lie outside the domain."""
    rows = (n[1] + brick[1] - 1) // brick[1]
    columns = (n[2] + brick[2] - 1) // brick[2]
    row = b // columns
    within = cell_of(brick, k)
    return wp.vec3i(
        row // rows * brick[0] + within[0], row % rows * brick[1] + within[1], b % columns * brick[2] + within[2]
    )


@wp.func
def equilibrium(w: float, c: wp.vec3i, drho: float, u: wp.vec3) -> float:
    """The second-order equilibrium of one direction, less its weight; ``drho`` is the density less 1."""
    cu = wp.dot(wp.vec3(float(c[0]), float(c[1]), float(c[2])), u)
    return w * (drho + (1.0 + drho) * (3.0 * cu + 4.5 * cu * cu - 1.5 * wp.dot(u, u)))


NARROW = 2**31 - 1
"""The largest number of populations, of all cells and directions together, that 32 bits count."""


@dataclass(frozen=True)
class MemoryFunctions:
    """``wp.func``s on populations in memory, of one lattice and storage.

    Attributes:
        vec: vec of Q floats.
        gather: (f, n, p) -> vec, what arrives at cell p, as stored: each direction from the cell that it comes from, or
            out of the cell itself from a wall at rest that closes a whole axis.
        moments: vec as stored -> drho, momentum, the diagonal and the off-diagonal (xy, xz, yz) of sum c c (f - w).
        put: (f, q, i, value), writes one number as stored.
        load: (f, q, i) -> float, one number.
        store: (f, q, i, value), the same way back.
    """

    vec: Any
    gather: Any
    moments: Any
    put: Any
    load: Any
    store: Any


@functools.cache
def memory_functions(
    lattice_name: str, storage: str, walls: tuple[bool, bool, bool], wide: bool = True
) -> MemoryFunctions:
    """Builds (once) the functions of a lattice and a storage.

    Args:
        lattice_name: One of ``LATTICES``.
        storage: One of ``STORAGES``; "as stored" is times its scale.
        walls: The axes that walls at rest close.
        wide: Whether places are counted in 64 bits, which costs a sixth of a step's instructions; without, there may
            be ``NARROW`` populations.

    Raises:
        ValueError: There is no such lattice or storage.
    """
    found = lattice(lattice_name)
    if storage not in STORAGES:
        raise ValueError(f"storage: expected one of {', '.join(STORAGES)}, got {storage!r}")
    c, count = found.c, len(found.c)
    stored, scale = STORAGES[storage]
    vec = wp.types.vector(count, float)
    place_type = wp.int64 if wide else wp.int32

    # Through the pointer: by Warp's strides, 64 bits wide each, the addresses would be half the work of a step.

    @wp.func_native("return f.data[k];")
    def peek(f: wp.array2d[stored], k: place_type) -> stored: ...

    @wp.func_native("f.data[k] = value;")
    def poke(f: wp.array2d[stored], k: place_type, value: stored): ...

    @wp.func
    def place_of(f: wp.array2d[stored], q: int, i: int) -> place_type:
        return place_type(q) * place_type(f.shape[1]) + place_type(i)

    @wp.func
    def load(f: wp.array2d[stored], q: int, i: int) -> float:
        return float(peek(f, place_of(f, q, i))) * wp.static(1.0 / scale)

    @wp.func
    def put(f: wp.array2d[stored], q: int, i: int, value: float):
        poke(f, place_of(f, q, i), f.dtype(value))

    @wp.func
    def store(f: wp.array2d[stored], q: int, i: int, value: float):
        put(f, q, i, value * wp.static(scale))

    @wp.func
    def gather(f: wp.array2d[stored], n: wp.vec3i, p: wp.vec3i) -> vec:
        x = wp.vec3i(wp.where(p[0] == 0, n[0], p[0]) - 1, p[0], wp.where(p[0] == n[0] - 1, 0, p[0] + 1))
        y = wp.vec3i(wp.where(p[1] == 0, n[1], p[1]) - 1, p[1], wp.where(p[1] == n[1] - 1, 0, p[1] + 1))
        z = wp.vec3i(wp.where(p[2] == 0, n[2], p[2]) - 1, p[2], wp.where(p[2] == n[2] - 1, 0, p[2] + 1))
        i = index_of(n, p)
        # Warp's hash of a function leaves out what ``wp.static`` makes of a loop's variable: without these constants
        # of its own, a gather with other walls would be taken for this one, and loaded in its place.
        closed = wp.vec3i(wp.static(int(walls[0])), wp.static(int(walls[1])), wp.static(int(walls[2])))
        low = wp.cw_mul(
            closed, wp.vec3i(wp.where(p[0] == 0, 1, 0), wp.where(p[1] == 0, 1, 0), wp.where(p[2] == 0, 1, 0))
        )
        top = n - wp.vec3i(1, 1, 1) - p
        high = wp.cw_mul(
            closed, wp.vec3i(wp.where(top[0] == 0, 1, 0), wp.where(top[1] == 0, 1, 0), wp.where(top[2] == 0, 1, 0))
        )
        g = vec()
        for q in range(wp.static(count)):
            row = x[wp.static(1 - c[q][0])] * n[1] + y[wp.static(1 - c[q][1])]
            k = place_of(f, q, row * n[2] + z[wp.static(1 - c[q][2])])
            if wp.static(any(walls[a] and c[q][a] != 0 for a in range(3))):
                # Half-way bounce-back costs no branch: only another place to read from.
                back = bool(False)
                for a in range(3):
                    if wp.static(walls[a] and c[q][a] > 0):
                        back = back or low[a] != 0
                    if wp.static(walls[a] and c[q][a] < 0):
                        back = back or high[a] != 0
                k = wp.where(back, place_of(f, wp.static(((q - 1) ^ 1) + 1), i), k)
            g[q] = float(peek(f, k))
        return g

    @wp.func
    def moments(g: vec):
        drho = float(g[0])
        jx = float(0.0)
        jy = float(0.0)
        jz = float(0.0)
        xx = float(0.0)
        yy = float(0.0)
        zz = float(0.0)
        xy = float(0.0)
        xz = float(0.0)
        yz = float(0.0)
        for q in range(1, wp.static(count)):
            drho += g[q]
            if wp.static(c[q][0] != 0):
                jx += wp.static(float(c[q][0])) * g[q]
                xx += g[q]
            if wp.static(c[q][1] != 0):
                jy += wp.static(float(c[q][1])) * g[q]
                yy += g[q]
            if wp.static(c[q][2] != 0):
                jz += wp.static(float(c[q][2])) * g[q]
                zz += g[q]
            if wp.static(c[q][0] * c[q][1] != 0):
                xy += wp.static(float(c[q][0] * c[q][1])) * g[q]
            if wp.static(c[q][0] * c[q][2] != 0):
                xz += wp.static(float(c[q][0] * c[q][2])) * g[q]
            if wp.static(c[q][1] * c[q][2] != 0):
                yz += wp.static(float(c[q][1] * c[q][2])) * g[q]
        unit = wp.static(1.0 / scale)
        return unit * drho, unit * wp.vec3(jx, jy, jz), unit * wp.vec3(xx, yy, zz), unit * wp.vec3(xy, xz, yz)

    return MemoryFunctions(vec, gather, moments, put, load, store)
