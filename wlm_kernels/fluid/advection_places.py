"""Where smoke is and where it comes from: the grids, solids and faces that ``advection`` traces through, and the
bricks of 8^3 cells in which there is any.

A fine grid has ``ratio`` cells along each edge of a coarse one. A solid is a matter of coarse cells. Along each axis
the domain is periodic, or each of its two ends is open (clean air comes in) or closed.

Bricks: one is busy if a value in it is above a threshold, and listed if one within ``rings`` of it is busy. What isn't
listed is 0 in every buffer. So what is lost against working everywhere is what lies below the threshold in bricks that
have none but such bricks about them, at most the threshold a cell and step; with 0 nothing is.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_sets import cell_of, index_of

__all__ = [
    "BRICK",
    "BRICK_RUN",
    "CLOSED",
    "FREE",
    "OPEN",
    "PERIODIC",
    "REACH",
    "RUN",
    "SOLID",
    "Box",
    "Bricks",
    "Corner",
    "Patch",
    "make_box",
    "make_bricks",
    "mark_walls",
    "relist",
    "rings_for",
]

wp.set_module_options({"enable_backward": False})

PERIODIC, OPEN, CLOSED = 0, 1, 2
"""What an end of an axis is; one end is periodic if and only if the other is."""

BRICK = 8
"""Cells along an edge of a brick."""

RUN, BRICK_RUN = 16, BRICK
"""Cells along x that one thread does, so that those that share their eight velocities read them once; in bricks fewer,
as these end."""

REACH = 0.25
"""Coarse cells by which a trace's midpoint may lie outside of the eight velocities about its start, and is still read
from them: the next eight are mostly the same, and would double the time."""

FREE, _BESIDE, SOLID = wp.constant(wp.uint8(0)), wp.constant(wp.uint8(1)), wp.constant(wp.uint8(2))
_OPEN = wp.constant(OPEN)
_HALVINGS = wp.constant(6)
_REACH = wp.constant(REACH)
# Groups of threads that share the list of bricks: enough to fill any GPU.
_WORKERS = 8192


@wp.struct
class Box:
    """A domain.

    Attributes:
        n: Fine cells along x, y and z.
        coarse: Coarse cells along x, y and z.
        ratio: Fine cells along an edge of a coarse one.
        share: 1 / ratio.
        periodic: 1 for each periodic axis.
        below, above: What the low and the high end of each axis is.
        bricks: Bricks along x, y and z.
    """

    n: wp.vec3i
    coarse: wp.vec3i
    ratio: int
    share: float
    periodic: wp.vec3i
    below: wp.vec3i
    above: wp.vec3i
    bricks: wp.vec3i


@wp.struct
class Stencil:
    """The eight cells about a place: the lower and the upper of each axis, and how far it is from one to the other."""

    low: wp.vec3i
    high: wp.vec3i
    f: wp.vec3


@wp.struct
class Corner:
    """The eight cells about a place: where the lowest lies in memory, how far from it the next along each axis do, and
    how far the place is from one to the other."""

    base: int
    step: wp.vec3i
    f: wp.vec3


@wp.struct
class Patch:
    """The velocities of a stencil's cells as the polynomial that they make."""

    c: wp.vec3
    x: wp.vec3
    y: wp.vec3
    z: wp.vec3
    xy: wp.vec3
    xz: wp.vec3
    yz: wp.vec3
    xyz: wp.vec3


@wp.func
def _neighbour(i: int, n: int, periodic: int) -> int:
    """A cell within the grid, whatever i is: no float that was turned into it may make a kernel read beyond."""
    if periodic != 0:
        if i < 0:
            i = i + n
        if i >= n:
            i = i - n
    return wp.clamp(i, 0, n - 1)


@wp.func
def stencil(n: wp.vec3i, periodic: wp.vec3i, p: wp.vec3) -> Stencil:
    at = Stencil()
    half = wp.vec3(0.5, 0.5, 0.5)
    corner = wp.vec3(wp.floor(p[0] - half[0]), wp.floor(p[1] - half[1]), wp.floor(p[2] - half[2]))
    at.f = p - half - corner
    x = int(corner[0])
    y = int(corner[1])
    z = int(corner[2])
    at.low = wp.vec3i(
        _neighbour(x, n[0], periodic[0]), _neighbour(y, n[1], periodic[1]), _neighbour(z, n[2], periodic[2])
    )
    at.high = wp.vec3i(
        _neighbour(x + 1, n[0], periodic[0]), _neighbour(y + 1, n[1], periodic[1]), _neighbour(z + 1, n[2], periodic[2])
    )
    return at


@wp.func
def stencil_index(at: Stencil, k: int) -> wp.vec3i:
    """The k-th of the eight cells."""
    return wp.vec3i(
        wp.where(k // 4 == 0, at.low[0], at.high[0]),
        wp.where(k // 2 % 2 == 0, at.low[1], at.high[1]),
        wp.where(k % 2 == 0, at.low[2], at.high[2]),
    )


@wp.func
def stencil_weight(at: Stencil, k: int) -> float:
    x = wp.where(k // 4 == 0, 1.0 - at.f[0], at.f[0])
    y = wp.where(k // 2 % 2 == 0, 1.0 - at.f[1], at.f[1])
    z = wp.where(k % 2 == 0, 1.0 - at.f[2], at.f[2])
    return x * y * z


@wp.func
def _edge(i: int, n: int, periodic: int):
    """Of the cells i and i + 1 along an axis the lower, and the step from it to the upper."""
    low = i
    step = int(1)
    # Mostly neither, and then nothing else is to be done.
    if i < 0 or i >= n - 1:
        low = _neighbour(i, n, periodic)
        step = _neighbour(i + 1, n, periodic) - low
    return low, step


@wp.func
def corner(box: Box, p: wp.vec3) -> Corner:
    """The eight fine cells about a place of the domain."""
    at = p - wp.vec3(0.5, 0.5, 0.5)
    least = wp.vec3(wp.floor(at[0]), wp.floor(at[1]), wp.floor(at[2]))
    x, along_x = _edge(int(least[0]), box.n[0], box.periodic[0])
    y, along_y = _edge(int(least[1]), box.n[1], box.periodic[1])
    z, along_z = _edge(int(least[2]), box.n[2], box.periodic[2])
    out = Corner()
    out.base = (x * box.n[1] + y) * box.n[2] + z
    out.step = wp.vec3i(along_x * box.n[1] * box.n[2], along_y * box.n[2], along_z)
    out.f = at - least
    return out


@wp.func_native("return u.data[i];")
def _velocity(u: wp.array1d[wp.vec3], i: int) -> wp.vec3: ...


@wp.func
def fetch(u: wp.array1d[wp.vec3], n: wp.vec3i, at: Stencil) -> Patch:
    row00 = (at.low[0] * n[1] + at.low[1]) * n[2]
    row01 = (at.low[0] * n[1] + at.high[1]) * n[2]
    row10 = (at.high[0] * n[1] + at.low[1]) * n[2]
    row11 = (at.high[0] * n[1] + at.high[1]) * n[2]
    a = _velocity(u, row00 + at.low[2])
    b = _velocity(u, row00 + at.high[2]) - a
    c = _velocity(u, row01 + at.low[2])
    d = _velocity(u, row01 + at.high[2]) - c
    e = _velocity(u, row10 + at.low[2])
    f = _velocity(u, row10 + at.high[2]) - e
    g = _velocity(u, row11 + at.low[2])
    h = _velocity(u, row11 + at.high[2]) - g
    patch = Patch()
    patch.c = a
    patch.z = b
    patch.y = c - a
    patch.yz = d - b
    patch.x = e - a
    patch.xz = f - b
    patch.xy = (g - e) - (c - a)
    patch.xyz = (h - f) - (d - b)
    return patch


@wp.func
def evaluate(patch: Patch, f: wp.vec3) -> wp.vec3:
    near = (patch.yz * f[2] + patch.y) * f[1] + (patch.z * f[2] + patch.c)
    slope = (patch.xyz * f[2] + patch.xy) * f[1] + (patch.xz * f[2] + patch.x)
    return slope * f[0] + near


@wp.func
def _periodic_place(x: float, n: int, periodic: int) -> float:
    if periodic != 0:
        return x - float(n) * wp.floor(x / float(n))
    return wp.clamp(x, 0.0, float(n))


@wp.func
def place(box: Box, x: wp.vec3) -> wp.vec3:
    """The same place in the domain: as periodic, or held at its faces."""
    return wp.vec3(
        _periodic_place(x[0], box.n[0], box.periodic[0]),
        _periodic_place(x[1], box.n[1], box.periodic[1]),
        _periodic_place(x[2], box.n[2], box.periodic[2]),
    )


@wp.func
def within(box: Box, x: wp.vec3) -> bool:
    """Whether a place lies in the domain."""
    low = x[0] >= 0.0 and x[1] >= 0.0 and x[2] >= 0.0
    # Not so where it isn't a number.
    return low and x[0] <= float(box.n[0]) and x[1] <= float(box.n[1]) and x[2] <= float(box.n[2])


@wp.func
def leaves(box: Box, x: wp.vec3) -> bool:
    """Whether a place lies beyond an open face."""
    low = bool(False)
    high = bool(False)
    for a in range(3):
        low = low or (x[a] < 0.0 and box.below[a] == _OPEN)
        high = high or (x[a] > float(box.n[a]) and box.above[a] == _OPEN)
    return low or high


@wp.func
def wall_at(box: Box, walls: wp.array1d[wp.uint8], p: wp.vec3) -> wp.uint8:
    """Of the coarse cell that holds a place of the domain."""
    x = wp.clamp(int(p[0] * box.share), 0, box.coarse[0] - 1)
    y = wp.clamp(int(p[1] * box.share), 0, box.coarse[1] - 1)
    z = wp.clamp(int(p[2] * box.share), 0, box.coarse[2] - 1)
    return walls[(x * box.coarse[1] + y) * box.coarse[2] + z]


@wp.func
def inside(box: Box, walls: wp.array1d[wp.uint8], cell: wp.vec3i) -> bool:
    """Whether a fine cell is solid; never if ``walls`` is empty."""
    if walls.shape[0] == 0:
        return False
    x = cell[0] // box.ratio
    y = cell[1] // box.ratio
    z = cell[2] // box.ratio
    return walls[(x * box.coarse[1] + y) * box.coarse[2] + z] == SOLID


@wp.func
def step_back(box: Box, u: wp.array1d[wp.vec3], patch: Patch, f: wp.vec3, x: wp.vec3, v: wp.vec3, dt: float) -> wp.vec3:
    """Where what is at x was ``dt`` steps ago, by the midpoint; ``v`` is the velocity there, at ``f`` of ``patch``."""
    fine = dt * float(box.ratio)
    half = f - 0.5 * dt * v
    least = wp.min(half[0], wp.min(half[1], half[2]))
    most = wp.max(half[0], wp.max(half[1], half[2]))
    w = wp.vec3()
    if least >= -_REACH and most <= 1.0 + _REACH:
        w = evaluate(patch, half)
    else:
        at = stencil(box.coarse, box.periodic, box.share * place(box, x - 0.5 * fine * v))
        w = evaluate(fetch(u, box.coarse, at), at.f)
    return x - fine * w


@wp.func
def cut(box: Box, walls: wp.array1d[wp.uint8], x: wp.vec3, end: wp.vec3) -> wp.vec3:
    """Of a trace from x, in the fluid, to a solid: a place before its end, where it meets the solid."""
    free = wp.vec3(x)
    solid = wp.vec3(end)
    for _k in range(_HALVINGS):
        middle = 0.5 * (free + solid)
        if wall_at(box, walls, place(box, middle)) == SOLID:
            solid = middle
        else:
            free = middle
    return free


def make_box(coarse: Sequence[int], ratio: int, ends: Sequence[tuple[int, int]]) -> Box:
    """A domain.

    Args:
        coarse: Coarse cells along x, y and z.
        ratio: Fine cells along an edge of a coarse one, at least 1.
        ends: For each axis what its low and its high end is: ``PERIODIC``, ``OPEN`` or ``CLOSED``.

    Raises:
        ValueError: The ratio is below 1, only one end of an axis is periodic, or there are 2^31 fine cells or more.
    """
    if ratio < 1:
        raise ValueError(f"ratio: expected at least 1, got {ratio}")
    if any((low == PERIODIC) != (high == PERIODIC) for low, high in ends):
        raise ValueError(f"ends: expected both ends of an axis periodic or neither, got {ends}")
    fine = [size * ratio for size in coarse]
    if fine[0] * fine[1] * fine[2] >= 2**31:
        raise ValueError(f"coarse: expected fewer than 2^31 fine cells, got {fine}")
    box = Box()
    box.n, box.coarse, box.ratio, box.share = wp.vec3i(*fine), wp.vec3i(*coarse), ratio, 1.0 / ratio
    box.periodic = wp.vec3i(*(int(low == PERIODIC) for low, _ in ends))
    box.below, box.above = wp.vec3i(*(low for low, _ in ends)), wp.vec3i(*(high for _, high in ends))
    box.bricks = wp.vec3i(*(-(-size // BRICK) for size in fine))
    return box


@wp.kernel
def _mark(
    # in:
    box: Box,
    solid: wp.array1d[wp.uint8],
    # out:
    walls: wp.array1d[wp.uint8],
):
    i = wp.tid()
    if solid[i] != wp.uint8(0):
        walls[i] = SOLID
        return
    cell = cell_of(box.coarse, i)
    found = wp.uint8(0)
    for k in range(27):
        x = _neighbour(cell[0] + k // 9 - 1, box.coarse[0], box.periodic[0])
        y = _neighbour(cell[1] + k // 3 % 3 - 1, box.coarse[1], box.periodic[1])
        z = _neighbour(cell[2] + k % 3 - 1, box.coarse[2], box.periodic[2])
        if solid[(x * box.coarse[1] + y) * box.coarse[2] + z] != wp.uint8(0):
            found = _BESIDE
    walls[i] = found


def mark_walls(box: Box, solid: wp.array, walls: wp.array) -> None:
    """Notes for each coarse cell whether it is solid, touches one that is, or neither.

    Args:
        box: The domain.
        solid: uint8 [coarse cells], above 0 where it is.
        walls: uint8 [coarse cells], set.
    """
    wp.launch(_mark, solid.shape[0], inputs=[box, solid], outputs=[walls], device=solid.device)


# Bricks.


@dataclass(frozen=True)
class Bricks:
    """The bricks of a domain, on a device.

    Attributes:
        rings: How many bricks further than a busy one smoke may get in a step.
        workers: Groups of threads that share the list.
        busy: int [B], 1 where there is smoke, as far as known since the last list.
        active: int [B], 1 where listed.
        listed: int [B], the numbers of those, in any order; ``count`` int [1] of them.
        retired: int [B], those that just ceased to be; ``left`` int [1] of them.
    """

    rings: int
    workers: int
    busy: wp.array
    active: wp.array
    listed: wp.array
    count: wp.array
    retired: wp.array
    left: wp.array


def rings_for(cells: float) -> int:
    """Rings of bricks that smoke may enter when a trace goes some fine cells far: a read needs one more."""
    return -(-(int(cells) + 2) // BRICK)


def make_bricks(box: Box, rings: int, device: str) -> Bricks:
    """Bricks over a domain, all of them busy, none of them listed yet."""
    # Across a periodic face lies perhaps a brick that is cut short, and behind it the next.
    rings += int(any(box.periodic[a] and box.n[a] % BRICK for a in range(3)))
    total = box.bricks[0] * box.bricks[1] * box.bricks[2]
    active, listed, retired = (wp.zeros(total, dtype=int, device=device) for _ in range(3))
    count, left = (wp.zeros(1, dtype=int, device=device) for _ in range(2))
    busy = wp.ones(total, dtype=int, device=device)
    # On a CPU one after the other does the whole list.
    workers = min(total, _WORKERS) if wp.get_device(device).is_cuda else 1
    return Bricks(rings, workers, busy, active, listed, count, retired, left)


@wp.kernel
def _list(
    # in:
    box: Box,
    rings: int,
    busy: wp.array1d[int],
    # in, out:
    active: wp.array1d[int],
    # out:
    listed: wp.array1d[int],
    count: wp.array1d[int],
    retired: wp.array1d[int],
    left: wp.array1d[int],
):
    b = wp.tid()
    at = cell_of(box.bricks, b)
    edge = 2 * rings + 1
    needed = int(0)
    for k in range(edge * edge * edge):
        x = at[0] + k // (edge * edge) - rings
        y = at[1] + k // edge % edge - rings
        z = at[2] + k % edge - rings
        if box.periodic[0] != 0:
            x = (x % box.bricks[0] + box.bricks[0]) % box.bricks[0]
        if box.periodic[1] != 0:
            y = (y % box.bricks[1] + box.bricks[1]) % box.bricks[1]
        if box.periodic[2] != 0:
            z = (z % box.bricks[2] + box.bricks[2]) % box.bricks[2]
        within = x >= 0 and x < box.bricks[0] and y >= 0 and y < box.bricks[1] and z >= 0 and z < box.bricks[2]
        if within:
            needed = wp.max(needed, busy[index_of(box.bricks, wp.vec3i(x, y, z))])
    if needed != 0:
        listed[wp.atomic_add(count, 0, 1)] = b
    elif active[b] != 0:
        retired[wp.atomic_add(left, 0, 1)] = b
    active[b] = needed


def relist(box: Box, bricks: Bricks) -> None:
    """Lists the bricks to work on in the next step, and those that no longer are; none is busy then."""
    bricks.count.zero_()
    bricks.left.zero_()
    outputs = [bricks.active, bricks.listed, bricks.count, bricks.retired, bricks.left]
    inputs = [box, bricks.rings, bricks.busy]
    wp.launch(_list, bricks.busy.shape, inputs=inputs, outputs=outputs, device=bricks.busy.device)
    bricks.busy.zero_()
