"""Shared parts of the lattice Boltzmann kernels: velocity sets, cells, moments, equilibria, storage.

Read `tests/reference/lattice.py` first: it has the same velocities and equilibria in float64 NumPy.

Cells are numbered with the last axis fastest, as in the memory of arrays [X, Y, Z]: cell = (x Y + y) Z + z. Velocities
are in pairs of opposites: 0 is at rest, 1 and 2 are opposite, 3 and 4 are opposite, and so on.

Populations are stored as f_q - w_q, the deviation from fluid at rest at density 1. Their sum is rho - 1, which float32
would otherwise round to 1e-7 at every step and 16 bits could not represent.
"""

import functools
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

HALF_SCALE = 32768.0
"""Factor of 16-bit populations: their range is +-2, and 1.9e-9 the smallest value with all 11 bits."""

STORAGES = {"float32": (wp.float32, 1.0), "float16": (wp.float16, HALF_SCALE)}

OPPOSITE = (0, *(((q - 1) ^ 1) + 1 for q in range(1, 27)))
"""The number of the opposite of each velocity."""

PAIRS = ((0, 1), (0, 2), (1, 2))
"""The pairs of axes of the off-diagonal components xy, xz and yz."""


@dataclass(frozen=True)
class VelocitySet:
    """A set of Q lattice velocities `c`, cells per step, with their weights `w`, in 2 dimensions (the plane of x and y)
    or 3; its name is "D2Q9", "D3Q19" or "D3Q27"."""

    name: str
    axes: int
    c: tuple[tuple[int, int, int], ...]
    w: tuple[float, ...]


def _make(name: str, axes: int, weights: tuple[float, ...]) -> VelocitySet:
    """Makes the set of all velocities with components -1, 0 and 1 whose squared length is below len(weights). A
    velocity of squared length k has the weight weights[k]."""
    signs = itertools.product(*[(-1, 0, 1) if a < axes else (0,) for a in range(3)])
    half = [c for c in signs if c > (0, 0, 0) and sum(map(abs, c)) < len(weights)]
    half.sort(key=lambda c: (sum(map(abs, c)), c))
    velocities = [(0, 0, 0)]
    for c in half:
        velocities += [c, tuple(-a for a in c)]
    return VelocitySet(name, axes, tuple(velocities), tuple(weights[sum(map(abs, c))] for c in velocities))


LATTICES = {
    "D2Q9": _make("D2Q9", 2, (4 / 9, 1 / 9, 1 / 36)),
    "D3Q19": _make("D3Q19", 3, (1 / 3, 1 / 18, 1 / 36)),
    "D3Q27": _make("D3Q27", 3, (8 / 27, 2 / 27, 1 / 54, 1 / 216)),
}


def lattice(name: str) -> VelocitySet:
    """Returns the velocity set of a name in `LATTICES`, such as "D3Q19"."""
    if name not in LATTICES:
        raise ValueError(f"lattice: expected one of {', '.join(LATTICES)}, got {name!r}")
    return LATTICES[name]


@dataclass(frozen=True)
class Slab:
    """The cells whose index along x is `begin` to `end` - 1, the device that computes them, and the slab's number."""

    device: wp.Device
    begin: int
    end: int
    number: int = 0


def launch_slab(
    kernel: wp.Kernel, n: wp.vec3i, slab: Slab, inputs: list, outputs: list, block_dim: int = 256, group: int = 1
) -> None:
    """Launches a kernel with one thread for each `group` cells of a slab of n cells along x, y and z; the first input,
    here added, is the index of the slab's first cell."""
    plane = n[1] * n[2]
    inputs = [slab.begin * plane, *inputs]
    threads = (slab.end - slab.begin) * plane // group
    wp.launch(kernel, threads, inputs=inputs, outputs=outputs, device=slab.device, block_dim=block_dim)


@wp.struct
class Tables:
    """A velocity set in arrays, for kernels that index its Q velocities `c` and weights `w`; `index`, int [27], has the
    number q of the velocity (x, y, z) at 9 (x + 1) + 3 (y + 1) + z + 1."""

    c: wp.array1d[wp.vec3i]
    w: wp.array1d[float]
    index: wp.array1d[int]


@functools.cache
def tables(name: str, device: str) -> Tables:
    """Copies (once) the velocity set of a lattice to a device."""
    velocities = lattice(name)
    index = [0] * 27
    for q, (x, y, z) in enumerate(velocities.c):
        index[9 * (x + 1) + 3 * (y + 1) + z + 1] = q
    out = Tables()
    out.c = wp.array(velocities.c, dtype=wp.vec3i, device=device)
    out.w = wp.array(velocities.w, dtype=float, device=device)
    out.index = wp.array(index, dtype=int, device=device)
    return out


@wp.func
def opposite(q: int) -> int:
    if q == 0:
        return 0
    return ((q - 1) ^ 1) + 1


@wp.func
def cell_of(n: wp.vec3i, i: int) -> wp.vec3i:
    """Returns the coordinates of the cell with index i in a domain of n cells along x, y and z."""
    # Two divisions instead of four: a remainder is a division too. Signed divisions take twice as long.
    row = int(wp.uint32(i) // wp.uint32(n[2]))
    x = int(wp.uint32(row) // wp.uint32(n[1]))
    return wp.vec3i(x, row - x * n[1], i - row * n[2])


@wp.func
def index_of(n: wp.vec3i, p: wp.vec3i) -> int:
    return (p[0] * n[1] + p[1]) * n[2] + p[2]


@wp.func
def _around(x: int, n: int) -> int:
    return wp.where(x < 0, x + n, wp.where(x >= n, x - n, x))


@wp.func
def _ways(p: int, last: int, n: int, step: int) -> wp.vec3i:
    """Returns the ways in memory from cell p to the cell before it, to itself and to the cell after cell `last`, on a
    periodic axis of n cells that are `step` apart."""
    return wp.vec3i(wp.where(p == 0, n - 1, -1) * step, 0, wp.where(last == n - 1, -p, last + 1 - p) * step)


@wp.func
def wrapped(n: wp.vec3i, p: wp.vec3i) -> wp.vec3i:
    """Returns the periodic image within the domain of a cell that is at most one cell outside."""
    return wp.vec3i(_around(p[0], n[0]), _around(p[1], n[1]), _around(p[2], n[2]))


@wp.func
def crosses(n: wp.vec3i, bounded: wp.vec3i, p: wp.vec3i) -> bool:
    """Tests whether a cell is beyond a face of an axis that is not periodic."""
    x = bounded[0] != 0 and (p[0] < 0 or p[0] >= n[0])
    y = bounded[1] != 0 and (p[1] < 0 or p[1] >= n[1])
    z = bounded[2] != 0 and (p[2] < 0 or p[2] >= n[2])
    return x or y or z


@wp.func
def equilibrium(w: float, c: wp.vec3i, drho: float, u: wp.vec3) -> float:
    """Computes f_eq - w: the second-order equilibrium population of a velocity c, minus the velocity's weight w.

    f_eq = w rho (1 + 3 c.u + 9/2 (c.u)^2 - 3/2 u.u), where rho = 1 + `drho` is the density and u the fluid's velocity.
    """
    cu = wp.dot(wp.vec3(float(c[0]), float(c[1]), float(c[2])), u)
    return w * (drho + (1.0 + drho) * (3.0 * cu + 4.5 * cu * cu - 1.5 * wp.dot(u, u)))


@wp.struct
class Layout:
    """A domain, and where its populations are in memory, see `MemoryFunctions`: `n`, cells along x, y and z; `bounded`,
    1 for each axis that is not periodic; `walled`, 1 for each axis that walls at rest close at both ends; `parity`."""

    n: wp.vec3i
    bounded: wp.vec3i
    walled: wp.vec3i
    parity: int


def make_layout(shape: Sequence[int], bounded: Sequence[int], walls: Sequence[bool], parity: int) -> Layout:
    """Makes the layout of a domain of `shape` cells; for the others see `Layout`."""
    layout = Layout()
    layout.n, layout.bounded, layout.parity = wp.vec3i(*shape), wp.vec3i(*bounded), parity
    layout.walled = wp.vec3i(*map(int, walls))
    return layout


@wp.func
def owned(at: Layout, p: wp.vec3i) -> bool:
    """Tests whether a population that leaves a cell towards cell p is stored; else a face's boundary writes there."""
    return crosses(at.n, at.walled, p) or not crosses(at.n, at.bounded, p)


NARROW = 2**31 - 1
"""Largest number of populations, cells times directions, that 32 bits can index."""


@dataclass(frozen=True)
class MemoryFunctions:
    """`wp.func`s that read and write populations in memory, for one lattice of Q velocities and one storage type.

    Between two steps, an array of populations, [Q, N], has parity 0 or, only if steps work in place, 1. With parity 0,
    element (q, k) is the population q that has left cell k. With parity 1, it is the population of the opposite
    direction that arrives at cell k next. At a wall at rest that closes a whole axis, the population q that leaves cell
    k is the one that arrives there, so that its element is (q, k) with both parities.

    The elements from which a cell reads what arrives are thus, with the other parity, those of what leaves the same
    cell in the opposite directions. So a step writes where it has read, and needs one array (the AA pattern: Bailey et
    al., "Accelerating lattice Boltzmann fluid flow simulations using graphics processors", 2009). Two are faster.

    For a group of two cells, i and i + 1, where i and Z are even, vecs have the populations of cell i, then those of
    cell i + 1. Numbers of 16 bits that are side by side in memory are read and written at once.

    Attributes:
        vec: vec of Q floats for each cell of the group.
        gather: (f, n, walled, i, parity) -> scaled vec, the populations that arrive at cell i.
        departed: (f, n, walled, i, parity) -> scaled vec, the populations that have left cell i.
        scatter: (f, n, walled, i, parity of f after it, scaled vec), writes the populations that leave cell i.
        moments: scaled vec -> rho - 1, momentum, the diagonal and the off-diagonal (xy, xz, yz) of sum_q c c (f - w).
        element: (f, q, i) -> element (q, i).
        arriving: (f, layout, i, p, q, c_q) -> element of the population q that arrives at cell i, which is at p.
        leaving: (f, layout, i, p, q, c_q) -> element of the population q that has left cell i.
        load: (f, element) -> float, reads a number and removes the scale.
        store: (f, element, value), scales and writes a number.
    """

    vec: Any
    gather: Any
    departed: Any
    scatter: Any
    moments: Any
    element: Any
    arriving: Any
    leaving: Any
    load: Any
    store: Any


@functools.cache
def memory_functions(
    lattice_name: str,
    storage: str,
    walls: tuple[bool, bool, bool],
    wide: bool = True,
    in_place: bool = False,
    group: int = 1,
) -> MemoryFunctions:
    """Builds (once) the functions for a lattice of `LATTICES` and a storage type of `STORAGES`, by whose scale numbers
    are multiplied, with walls at rest that close some axes; `group`, 1 or in 16 bits 2, is the number of cells at once.

    `wide` indexes populations in 64 bits, which adds a sixth to a step's instructions; otherwise there may be at most
    `NARROW` of them. Without `in_place`, every array has parity 0, whatever the parity that a function is given.
    """
    c = lattice(lattice_name).c
    count = len(c)
    stored, scale = STORAGES[storage]
    vec, cell_vec = wp.types.vector(group * count, float), wp.types.vector(count, float)
    index_type = wp.int64 if wide else wp.int32
    elements = wp.types.vector(group * count, index_type)

    # Elements are read through the pointer: addresses from Warp's 64-bit strides would take half the time of a step.

    @wp.func_native("return f.data[k];")
    def peek(f: wp.array2d[stored], k: index_type) -> stored: ...

    @wp.func_native("f.data[k] = value;")
    def poke(f: wp.array2d[stored], k: index_type, value: stored): ...

    @wp.func_native("return *(const unsigned int*)(f.data + k);")
    def peek_two(f: wp.array2d[stored], k: index_type) -> wp.uint32: ...

    @wp.func_native("wp::half h; h.u = (unsigned short)pair; return wp::half_to_float(h);")
    def half_of(pair: wp.uint32) -> float: ...

    @wp.func_native(
        "*(unsigned int*)(f.data + k) = wp::float_to_half(a).u | (unsigned int)wp::float_to_half(b).u << 16;"
    )
    def poke_two(f: wp.array2d[stored], k: index_type, a: float, b: float): ...

    @wp.func
    def element(f: wp.array2d[stored], q: int, i: int) -> index_type:
        return index_type(q) * index_type(f.shape[1]) + index_type(i)

    @wp.func
    def load(f: wp.array2d[stored], k: index_type) -> float:
        return float(peek(f, k)) * wp.static(1.0 / scale)

    @wp.func
    def store(f: wp.array2d[stored], k: index_type, value: float):
        poke(f, k, f.dtype(value * wp.static(scale)))

    @wp.func
    def arriving(f: wp.array2d[stored], at: Layout, i: int, p: wp.vec3i, q: int, c_q: wp.vec3i) -> index_type:
        if wp.static(in_place):
            if at.parity != 0:
                return element(f, opposite(q), i)
        if crosses(at.n, at.walled, p - c_q):
            return element(f, opposite(q), i)
        return element(f, q, index_of(at.n, wrapped(at.n, p - c_q)))

    @wp.func
    def leaving(f: wp.array2d[stored], at: Layout, i: int, p: wp.vec3i, q: int, c_q: wp.vec3i) -> index_type:
        if wp.static(in_place):
            if at.parity != 0 and not crosses(at.n, at.walled, p + c_q):
                return element(f, opposite(q), index_of(at.n, wrapped(at.n, p + c_q)))
        return element(f, q, i)

    @wp.func
    def sources(f: wp.array2d[stored], n: wp.vec3i, walled: wp.vec3i, i: int) -> elements:
        """Returns the elements of the populations that arrive at a group of cells in an array of parity 0."""
        p = cell_of(n, i)
        last = p[2] + wp.static(group - 1)
        x = _ways(p[0], p[0], n[0], n[1] * n[2])
        y = _ways(p[1], p[1], n[1], n[2])
        z = _ways(p[2], last, n[2], 1)
        # Warp's hash of a function excludes `wp.static` expressions of loop variables: without these constants a gather
        # with other walls would have the same hash, and would be loaded instead.
        closed = wp.vec3i(wp.static(int(walls[0])), wp.static(int(walls[1])), wp.static(int(walls[2])))
        low = wp.vec3i()
        high = wp.vec3i()
        for a in range(3):
            low[a] = wp.where(p[a] == 0, closed[a] * walled[a], 0)
            high[a] = wp.where(wp.where(a == 2, last, p[a]) == n[a] - 1, closed[a] * walled[a], 0)
        out = elements()
        for q in range(wp.static(count)):
            row = element(f, q, i + x[wp.static(1 - c[q][0])] + y[wp.static(1 - c[q][1])])
            for m in range(wp.static(group)):
                k = row + index_type(wp.static(m - c[q][2]))
                if wp.static(not 0 <= m - c[q][2] < group):
                    k = row + index_type(z[wp.static(1 - c[q][2])])
                if wp.static(any(walls[a] and c[q][a] != 0 for a in range(3))):
                    # Half-way bounce-back needs no branch: it reads another element.
                    back = bool(False)
                    for a in range(3):
                        if wp.static(walls[a] and c[q][a] > 0 and (a < 2 or m == 0)):
                            back = back or low[a] != 0
                        if wp.static(walls[a] and c[q][a] < 0 and (a < 2 or m == group - 1)):
                            back = back or high[a] != 0
                    k = wp.where(back, element(f, wp.static(OPPOSITE[q]), i + m), k)
                out[m * wp.static(count) + q] = k
        return out

    # In the next two, `turned` exchanges opposite directions. All numbers of a group that stay at its cells are side by
    # side, so that the elements k are not used; else only those that do not move along z are.

    @wp.func
    def read(f: wp.array2d[stored], i: int, k: elements, turned: bool, stay: bool) -> vec:
        g = vec()
        for q in range(wp.static(count)):
            at = wp.where(turned, wp.static(OPPOSITE[q]), q)
            if wp.static(group == 2) and (stay or wp.static(c[q][2] == 0)):
                pair = peek_two(f, wp.where(stay, element(f, at, i), k[at]))
                g[q] = half_of(pair)
                g[wp.static(count) + q] = half_of(pair >> wp.uint32(16))
            else:
                for m in range(wp.static(group)):
                    here = m * wp.static(count)
                    g[here + q] = float(peek(f, wp.where(stay, element(f, at, i + m), k[here + at])))
        return g

    @wp.func
    def write(f: wp.array2d[stored], i: int, k: elements, turned: bool, stay: bool, g: vec):
        for q in range(wp.static(count)):
            at = wp.where(turned, wp.static(OPPOSITE[q]), q)
            if wp.static(group == 2) and (stay or wp.static(c[q][2] == 0)):
                poke_two(f, wp.where(stay, element(f, at, i), k[at]), g[q], g[wp.static(count) + q])
            else:
                for m in range(wp.static(group)):
                    here = m * wp.static(count)
                    poke(f, wp.where(stay, element(f, at, i + m), k[here + at]), f.dtype(g[here + q]))

    @wp.func
    def gather(f: wp.array2d[stored], n: wp.vec3i, walled: wp.vec3i, i: int, parity: int) -> vec:
        if wp.static(in_place):
            if parity != 0:
                return read(f, i, elements(), True, True)
        return read(f, i, sources(f, n, walled, i), False, False)

    @wp.func
    def departed(f: wp.array2d[stored], n: wp.vec3i, walled: wp.vec3i, i: int, parity: int) -> vec:
        if wp.static(in_place):
            if parity != 0:
                return read(f, i, sources(f, n, walled, i), True, False)
        return read(f, i, elements(), False, True)

    @wp.func
    def scatter(f: wp.array2d[stored], n: wp.vec3i, walled: wp.vec3i, i: int, parity: int, left: vec):
        if wp.static(in_place):
            if parity != 0:
                write(f, i, sources(f, n, walled, i), True, False, left)
                return
        write(f, i, elements(), False, True, left)

    @wp.func
    def moments(g: cell_vec):
        drho = float(g[0])
        momentum = wp.vec3()
        diagonal = wp.vec3()
        off = wp.vec3()
        for q in range(1, wp.static(count)):
            drho += g[q]
            for a in range(3):
                if wp.static(c[q][a] != 0):
                    momentum[a] += wp.static(float(c[q][a])) * g[q]
                    diagonal[a] += g[q]
                if wp.static(c[q][PAIRS[a][0]] * c[q][PAIRS[a][1]] != 0):
                    off[a] += wp.static(float(c[q][PAIRS[a][0]] * c[q][PAIRS[a][1]])) * g[q]
        unit = wp.static(1.0 / scale)
        return unit * drho, unit * momentum, unit * diagonal, unit * off

    return MemoryFunctions(vec, gather, departed, scatter, moments, element, arriving, leaving, load, store)
