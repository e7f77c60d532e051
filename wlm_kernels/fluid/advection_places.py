"""Geometry of the advection of smoke: grids, solids, faces of the domain, and bricks of 8^3 cells.

Read `tests/reference/advection.py` first: `Domain` there has the same grids, faces and solids in NumPy.

The fine grid (smoke) has `refinement` cells along each edge of a cell of the coarse grid (air). Solids are whole
coarse cells. Each axis is periodic, or each of its two ends is open (clean air comes in) or closed.

A brick is busy if a value in it exceeds the threshold, and is listed, that is stored and computed in the next step, if
it or a brick at most `rings` bricks away is busy. All other bricks are 0 and take no memory: the arrays of smoke are a
pool of bricks of 8^3 cells, in which the first brick is always empty and stands for those that are not stored. Relative
to a step that computes all cells, the error per cell and step is at most the threshold, outside the listed bricks; at a
threshold of 0 it is 0.
"""

from collections.abc import Sequence

import warp as wp

from wlm_kernels.fluid.lattice_sets import Slab, cell_of, index_of, launch_slab

wp.set_module_options({"enable_backward": False})

PERIODIC, OPEN, CLOSED = 0, 1, 2
"""Kinds of the ends of an axis; either both ends are periodic or neither."""

BRICK, CELLS = 8, 512
"""Cells along an edge of a brick, and in a brick."""

FREE, _BESIDE, SOLID = wp.constant(wp.uint8(0)), wp.constant(wp.uint8(1)), wp.constant(wp.uint8(2))
_OPEN = wp.constant(OPEN)
_HALVINGS = wp.constant(6)
# Groups of threads that share the list of bricks; enough to fill any GPU.
_WORKERS = 8192


@wp.struct
class Box:
    """The domain of the smoke: sizes of its two grids, and the kinds of its faces.

    Attributes:
        n: Fine cells along x, y and z.
        coarse: Coarse cells along x, y and z.
        refinement: Fine cells along an edge of a coarse cell.
        voxel: Edge of a fine cell in coarse cells, 1 / refinement.
        periodic: 1 for each periodic axis, else 0.
        below, above: Kind of the low and of the high end of each axis: `PERIODIC`, `OPEN` or `CLOSED`.
        bricks: Bricks along x, y and z.
    """

    n: wp.vec3i
    coarse: wp.vec3i
    refinement: int
    voxel: float
    periodic: wp.vec3i
    below: wp.vec3i
    above: wp.vec3i
    bricks: wp.vec3i


@wp.struct
class Bricks:
    """The B bricks of a domain, and their places in a pool of P bricks, on a device.

    The brick at place s of the pool has the elements 512 s to 512 s + 511 of a field, [x, y, z] with z fastest.

    Attributes:
        rings: Distance in bricks by which smoke may move beyond a busy brick in a step.
        workers: Groups of threads that share the listed bricks; 0: there is no pool, all cells are stored.
        threshold: Largest value of a brick that counts as empty.
        busy: int [B], 1 where a value above the threshold has been written since the last `store`, else 0; between
            `relist` and `store` plus 2 in bricks that are listed.
        places: int [B], the place of each listed brick in the pool, or 1 in each chosen brick without a pool; 0 for all
            others; [0]: all cells are computed.
        listed: int [B], its first `counts[0]` elements are the indices of the listed bricks, in any order.
        fresh: int [B], its first `counts[1]` elements are the listed bricks that have no place yet.
        counts: int [2].
        free: int [P], a stack; its first `depth` (int [1]) elements are the places of the pool that are not in use.
    """

    rings: int
    workers: int
    threshold: float
    busy: wp.array1d[int]
    places: wp.array1d[int]
    listed: wp.array1d[int]
    fresh: wp.array1d[int]
    counts: wp.array1d[int]
    free: wp.array1d[int]
    depth: wp.array1d[int]


DENSE = Bricks()
"""No bricks: every cell is stored and computed."""


@wp.struct
class Stencil:
    """Memory offsets of the eight cells around a point: index of the lowest cell, step to the next cell along each
    axis, and the fractions between them."""

    base: int
    step: wp.vec3i
    f: wp.vec3


@wp.func
def _neighbour(i: int, n: int, periodic: int) -> int:
    """Wraps or clamps an index to 0 to n - 1; the result is within the grid even for an index converted from NaN."""
    if periodic != 0:
        if i < 0:
            i = i + n
        if i >= n:
            i = i - n
    return wp.clamp(i, 0, n - 1)


@wp.func
def pair(i: int, n: int, periodic: int):
    """Wraps or clamps the cells i and i + 1 of an axis; returns the first, and the second minus the first."""
    low = i
    step = int(1)
    # Cells away from the ends of the axis need no wrapping.
    if i < 0 or i >= n - 1:
        low = _neighbour(i, n, periodic)
        step = _neighbour(i + 1, n, periodic) - low
    return low, step


@wp.func
def lowest_cell(n: wp.vec3i, periodic: wp.vec3i, p: wp.vec3):
    """Finds the eight cells around a point of a domain of n cells: returns the lowest, the steps to the next along each
    axis, and the fractions between them."""
    at = p - wp.vec3(0.5, 0.5, 0.5)
    least = wp.vec3(wp.floor(at[0]), wp.floor(at[1]), wp.floor(at[2]))
    x, along_x = pair(int(least[0]), n[0], periodic[0])
    y, along_y = pair(int(least[1]), n[1], periodic[1])
    z, along_z = pair(int(least[2]), n[2], periodic[2])
    return wp.vec3i(x, y, z), wp.vec3i(along_x, along_y, along_z), at - least


@wp.func
def stencil(n: wp.vec3i, periodic: wp.vec3i, p: wp.vec3) -> Stencil:
    """Finds the eight cells around a point of a domain of n cells."""
    cell, along, f = lowest_cell(n, periodic, p)
    out = Stencil()
    out.base = index_of(n, cell)
    out.step = wp.vec3i(along[0] * n[1] * n[2], along[1] * n[2], along[2])
    out.f = f
    return out


# Addresses from Warp's 64-bit strides would take twice as long.
@wp.func_native("return places.data[b];")
def place_at(places: wp.array1d[int], b: int) -> int: ...


@wp.func_native("return walls.data[i];")
def _wall(walls: wp.array1d[wp.uint8], i: int) -> wp.uint8: ...


@wp.func
def stored_index(box: Box, bricks: Bricks, cell: wp.vec3i) -> int:
    """Returns the index of a cell in a pool, or of one of the empty brick if the cell is not stored."""
    b = index_of(box.bricks, wp.vec3i(cell[0] >> 3, cell[1] >> 3, cell[2] >> 3))
    return (place_at(bricks.places, b) << 9) + ((cell[0] & 7) << 6) + ((cell[1] & 7) << 3) + (cell[2] & 7)


@wp.func
def address_of(box: Box, bricks: Bricks, cell: wp.vec3i) -> int:
    """Returns the index of a cell in the arrays of the smoke, with bricks or without."""
    if bricks.workers == 0:
        return index_of(box.n, cell)
    return stored_index(box, bricks, cell)


@wp.func
def side_of(k: int) -> wp.vec3i:
    """Returns for each axis whether the cell k of eight around a point is the lower one, 0, or the upper one, 1."""
    return wp.vec3i(k // 4, k // 2 % 2, k % 2)


@wp.func
def share_of(side: wp.vec3i, f: wp.vec3) -> float:
    """Returns the trilinear weight of one of eight cells around a point."""
    weight = float(1.0)
    for a in range(3):
        weight *= wp.where(side[a] == 0, 1.0 - f[a], f[a])
    return weight


@wp.func
def corner(at: Stencil, k: int):
    """Returns the index of the cell k of eight around a point, and its trilinear weight."""
    side = side_of(k)
    return at.base + wp.dot(side, at.step), share_of(side, at.f)


@wp.func_native("return vectors.data[i];")
def vector_at(vectors: wp.array1d[wp.vec3], i: int) -> wp.vec3: ...


@wp.func
def interpolate_vectors(vectors: wp.array1d[wp.vec3], at: Stencil) -> wp.vec3:
    total = wp.vec3()
    for k in range(8):
        i, weight = corner(at, k)
        total += weight * vector_at(vectors, i)
    return total


@wp.func
def _wrap_or_clamp(x: float, n: int, periodic: int) -> float:
    if periodic != 0:
        return x - float(n) * wp.floor(x / float(n))
    return wp.clamp(x, 0.0, float(n))


@wp.func
def into_domain(box: Box, x: wp.vec3) -> wp.vec3:
    """Wraps a point along periodic axes, and clamps it to the domain's faces along the other axes."""
    return wp.vec3(
        _wrap_or_clamp(x[0], box.n[0], box.periodic[0]),
        _wrap_or_clamp(x[1], box.n[1], box.periodic[1]),
        _wrap_or_clamp(x[2], box.n[2], box.periodic[2]),
    )


@wp.func
def in_domain(box: Box, x: wp.vec3) -> bool:
    """Tests whether a point is in the domain; false for NaN."""
    low = x[0] >= 0.0 and x[1] >= 0.0 and x[2] >= 0.0
    return low and x[0] <= float(box.n[0]) and x[1] <= float(box.n[1]) and x[2] <= float(box.n[2])


@wp.func
def beyond_open_face(box: Box, x: wp.vec3) -> bool:
    low = bool(False)
    high = bool(False)
    for a in range(3):
        low = low or (x[a] < 0.0 and box.below[a] == _OPEN)
        high = high or (x[a] > float(box.n[a]) and box.above[a] == _OPEN)
    return low or high


@wp.func
def wall_at(box: Box, walls: wp.array1d[wp.uint8], p: wp.vec3) -> wp.uint8:
    """Returns the mark of `mark_walls` (free, beside a solid, or solid) of the coarse cell that contains a point."""
    x = wp.clamp(int(p[0] * box.voxel), 0, box.coarse[0] - 1)
    y = wp.clamp(int(p[1] * box.voxel), 0, box.coarse[1] - 1)
    z = wp.clamp(int(p[2] * box.voxel), 0, box.coarse[2] - 1)
    return _wall(walls, (x * box.coarse[1] + y) * box.coarse[2] + z)


@wp.func
def is_solid(box: Box, walls: wp.array1d[wp.uint8], cell: wp.vec3i) -> bool:
    """Tests whether a fine cell is solid; false if `walls` is empty."""
    if walls.shape[0] == 0:
        return False
    # Divisions of integers would take several times as long.
    x = int((float(cell[0]) + 0.5) * box.voxel)
    y = int((float(cell[1]) + 0.5) * box.voxel)
    z = int((float(cell[2]) + 0.5) * box.voxel)
    return _wall(walls, (x * box.coarse[1] + y) * box.coarse[2] + z) == SOLID


@wp.func
def midpoint(box: Box, u: wp.array1d[wp.vec3], i: int, dt: float) -> wp.vec3:
    """Returns the midpoint of the trace from the centre of coarse cell i back in time, before it is clamped."""
    p = cell_of(box.coarse, i)
    r = float(box.refinement)
    return r * (wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5) - 0.5 * dt * u[i])


@wp.func
def clip_at_solid(box: Box, walls: wp.array1d[wp.uint8], x: wp.vec3, end: wp.vec3) -> wp.vec3:
    """Finds where the line from x to an end in a solid enters the solid, by bisection to 1/64 of the line's length."""
    free = wp.vec3(x)
    solid = wp.vec3(end)
    for _k in range(_HALVINGS):
        middle = 0.5 * (free + solid)
        if wall_at(box, walls, into_domain(box, middle)) == SOLID:
            solid = middle
        else:
            free = middle
    return free


def make_box(coarse: Sequence[int], refinement: int, ends: Sequence[tuple[int, int]]) -> Box:
    """Makes a domain of coarse cells along x, y and z, each with `refinement` fine cells along an edge; `ends` has for
    each axis the kind of its low and its high end: `PERIODIC`, `OPEN` or `CLOSED`."""
    if refinement < 1:
        raise ValueError(f"refinement: expected at least 1, got {refinement}")
    if any((low == PERIODIC) != (high == PERIODIC) for low, high in ends):
        raise ValueError(f"ends: expected both ends of an axis to be periodic (0), or neither, got {ends}")
    fine = [size * refinement for size in coarse]
    if fine[0] * fine[1] * fine[2] >= 2**31:
        raise ValueError(f"coarse: expected fewer than 2^31 fine cells (coarse cells times refinement), got {fine}")
    box = Box()
    box.n, box.coarse, box.refinement, box.voxel = wp.vec3i(*fine), wp.vec3i(*coarse), refinement, 1.0 / refinement
    box.periodic = wp.vec3i(*(int(low == PERIODIC) for low, _ in ends))
    box.below, box.above = wp.vec3i(*(low for low, _ in ends)), wp.vec3i(*(high for _, high in ends))
    box.bricks = wp.vec3i(*(-(-size // BRICK) for size in fine))
    return box


@wp.func
def _is_used(box: Box, bricks: Bricks, p: wp.vec3i) -> bool:
    """Tests whether a chosen brick may be less than a coarse cell from the centre of a coarse cell."""
    used = bool(bricks.places.shape[0] == 0)
    low = wp.vec3i()
    high = wp.vec3i()
    for a in range(3):
        least = box.refinement * p[a] - box.refinement // 2 - 1
        most = box.refinement * (p[a] + 1) + box.refinement // 2
        used = used or (box.periodic[a] != 0 and (least < 0 or most >= box.n[a]))
        low[a] = wp.max(least, 0) // BRICK
        high[a] = wp.min(most, box.n[a] - 1) // BRICK + 1
    if not used:
        for x in range(low[0], high[0]):
            for y in range(low[1], high[1]):
                for z in range(low[2], high[2]):
                    used = used or place_at(bricks.places, index_of(box.bricks, wp.vec3i(x, y, z))) != 0
    return used


@wp.kernel
def _trace(
    # in:
    first: int,
    box: Box,
    u: wp.array1d[wp.vec3],
    dt: float,
    bricks: Bricks,
    # out:
    traces: wp.array1d[wp.vec3],
):
    i = first + wp.tid()
    # Where no smoke is, any way is right that does not lead to some.
    duration = wp.where(_is_used(box, bricks, cell_of(box.coarse, i)), dt, 0.0)
    for at in range(i, traces.shape[0], u.shape[0]):
        way = wp.vec3()
        if duration != 0.0:
            middle = into_domain(box, midpoint(box, u, i, duration))
            around = stencil(box.coarse, box.periodic, box.voxel * middle)
            way = -duration * float(box.refinement) * interpolate_vectors(u, around)
        traces[at] = way
        duration = -duration


def trace(
    box: Box, velocity: wp.array, dt: float, traces: wp.array, bricks: Bricks = DENSE, slab: Slab | None = None
) -> None:
    """Computes the ways of smoke from and to the centres of coarse cells, by the midpoint rule.

    Args:
        box: The domain, of N coarse cells.
        velocity: Velocity of the air, vec3 [N], coarse cells per lattice step.
        dt: Duration in lattice steps.
        traces: vec3 [N] or [2 N], written: the ways from the centres to their departure points, in fine cells; then
            those to the points where smoke goes from the centres in the same time.
        bricks: The bricks that the step computes; elsewhere the ways are 0. Default all cells.
        slab: The coarse cells to compute; default all.
    """
    slab = slab or Slab(traces.device, 0, box.coarse[0])
    launch_slab(_trace, box.coarse, slab, [box, velocity, float(dt), bricks], [traces])


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
    mark = wp.uint8(0)
    for k in range(27):
        x = _neighbour(cell[0] + k // 9 - 1, box.coarse[0], box.periodic[0])
        y = _neighbour(cell[1] + k // 3 % 3 - 1, box.coarse[1], box.periodic[1])
        z = _neighbour(cell[2] + k % 3 - 1, box.coarse[2], box.periodic[2])
        if solid[(x * box.coarse[1] + y) * box.coarse[2] + z] != wp.uint8(0):
            mark = _BESIDE
    walls[i] = mark


def mark_walls(box: Box, solid: wp.array, walls: wp.array) -> None:
    """Marks each coarse cell in `walls`, uint8 [coarse cells], as free (0), beside a solid (1), or solid (2), by
    `solid`, uint8 [coarse cells], above 0 where a cell is solid."""
    wp.launch(_mark, solid.shape[0], inputs=[box, solid], outputs=[walls], device=solid.device)


def rings_for(cells: float) -> int:
    """Returns the distance in bricks that smoke can cover while it moves by `cells` fine cells, including the cell
    beyond that interpolation reads."""
    return -(-(int(cells) + 2) // BRICK)


def make_bricks(box: Box, rings: int, threshold: float, device: str) -> Bricks:
    """Makes the bricks of a domain, none of them busy or listed, and a pool of the empty brick alone; for `rings` and
    `threshold` see `Bricks`."""
    total = box.bricks[0] * box.bricks[1] * box.bricks[2]
    bricks = Bricks()
    # The brick across a periodic face may be cut short, so that smoke reaches the one behind it.
    bricks.rings = rings + int(any(box.periodic[a] and box.n[a] % BRICK for a in range(3)))
    # A CPU runs workers sequentially.
    bricks.workers = min(total, _WORKERS) if wp.get_device(device).is_cuda else 1
    bricks.threshold = threshold
    bricks.busy, bricks.places, bricks.listed, bricks.fresh = (wp.zeros(total, int, device) for _ in range(4))
    bricks.counts, bricks.free, bricks.depth = (wp.zeros(size, int, device) for size in (2, 1, 1))
    return bricks


@wp.kernel
def _spread(
    # in:
    box: Box,
    # in, out:
    bricks: Bricks,
):
    b = wp.tid()
    if bricks.busy[b] % 2 == 0:
        return
    at = cell_of(box.bricks, b)
    # Nested loops need no division.
    for dx in range(-bricks.rings, bricks.rings + 1):
        for dy in range(-bricks.rings, bricks.rings + 1):
            for dz in range(-bricks.rings, bricks.rings + 1):
                near = at + wp.vec3i(dx, dy, dz)
                exists = bool(True)
                for a in range(3):
                    if box.periodic[a] != 0:
                        near[a] = (near[a] % box.bricks[a] + box.bricks[a]) % box.bricks[a]
                    exists = exists and near[a] >= 0 and near[a] < box.bricks[a]
                if exists:
                    # Threads only ever add 2, so that they need not wait for each other.
                    i = index_of(box.bricks, near)
                    bricks.busy[i] = bricks.busy[i] | 2


@wp.kernel
def _list(
    # in, out:
    bricks: Bricks,
):
    b = wp.tid()
    place = bricks.places[b]
    if bricks.busy[b] != 0:
        bricks.listed[wp.atomic_add(bricks.counts, 0, 1)] = b
        if place == 0:
            bricks.fresh[wp.atomic_add(bricks.counts, 1, 1)] = b
    elif place != 0:
        bricks.free[wp.atomic_add(bricks.depth, 0, 1)] = place
        bricks.places[b] = 0


def relist(box: Box, bricks: Bricks) -> None:
    """Lists the bricks to compute in the next step, and frees the places of the others. `store` must follow, with at
    least `counts[0]` places beside the empty brick in the pool."""
    bricks.counts.zero_()
    wp.launch(_spread, bricks.busy.shape, inputs=[box, bricks], device=bricks.busy.device)
    wp.launch(_list, bricks.busy.shape, inputs=[bricks], device=bricks.busy.device)


@wp.kernel
def _choose(
    # in, out:
    bricks: Bricks,
):
    b = wp.tid()
    bricks.places[b] = wp.min(bricks.busy[b], 1)
    bricks.busy[b] = 0


def choose(box: Box, bricks: Bricks) -> None:
    """Chooses busy bricks, and those that smoke in them may reach, for the next step, where no pool stores the smoke:
    their `places` are 1 and those of others 0. Then no brick is busy."""
    wp.launch(_spread, bricks.busy.shape, inputs=[box, bricks], device=bricks.busy.device)
    wp.launch(_choose, bricks.busy.shape, inputs=[bricks], device=bricks.busy.device)


@wp.kernel
def _settle(
    # in:
    clear: bool,
    # in, out:
    bricks: Bricks,
):
    b = wp.tid()
    busy = bricks.busy[b]
    if busy != 0:
        bricks.busy[b] = wp.where(clear, 0, busy % 2)
    if b == 0:
        # The places of fresh bricks were at the top of the stack.
        bricks.depth[0] -= bricks.counts[1]
        bricks.counts[1] = 0


def settle(bricks: Bricks, clear: bool) -> None:
    """Ends the storing of fresh bricks; with `clear` no brick is busy any longer."""
    wp.launch(_settle, bricks.busy.shape, inputs=[clear, bricks], device=bricks.busy.device)
