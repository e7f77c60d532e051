"""Sources of smoke, solids that appear and disappear, and buoyancy, by which smoke moves the air.

Read `test_sources`, `test_turned_sources` and `test_buoyancy_is_of_means` in `tests/kernels/test_advection.py` first:
they compute the same in NumPy.

Fields and domains are those of `advection` and `advection_places`. Special cases:

==============================  ======================================================================
a source in a solid             adds no smoke there
a source outside the domain     adds no smoke
a source that adds less than    adds no smoke: half floats have 11 bits
half floats resolve
cells that a solid covers       their smoke is lost
cells that a solid frees        mean of the nearest cell of each neighbouring fluid coarse cell; 0 if none
==============================  ======================================================================
"""

import functools
from collections.abc import Sequence

import numpy as np
import warp as wp

from wlm_kernels.fluid.advection import Fields, fields_struct
from wlm_kernels.fluid.advection_places import BRICK, CELLS, DENSE, SOLID, Box, Bricks, address_of, is_solid, settle
from wlm_kernels.fluid.lattice_sets import Slab, cell_of, index_of, launch_slab
from wlm_kernels.fluid.mesh_inside import in_mesh

_OPTIONS = {"enable_backward": False}

SHAPES = ("sphere", "box", "cylinder", "mesh")
"""Shapes of a source: of radius 1, of edge 2, along y with radius 1 and height 2, and in a mesh's own unit."""

_SPHERE, _BOX, _CYLINDER = wp.constant(0), wp.constant(1), wp.constant(2)
_LARGEST_HALF = wp.constant(65504.0)
_BRICK = wp.constant(BRICK)
_CELLS = wp.constant(CELLS)
_STORING = 256  # groups of threads that store bricks: a step adds few


@wp.func
def _mark_busy(box: Box, p: wp.vec3i, value: float, bricks: Bricks):
    if bricks.workers > 0 and value > bricks.threshold:
        bricks.busy[index_of(box.bricks, wp.vec3i(p[0] // _BRICK, p[1] // _BRICK, p[2] // _BRICK))] = 1


@wp.struct
class Region:
    """The region of a source: a shape, whose index in `SHAPES` is `shape`, in a frame with its origin at `centre`, in
    which lengths are multiplied by `size`, which is then turned by `turn`. Its extents along the axes of the domain are
    at most `half` on each side of the centre. All lengths are in fine cells.

    `mesh` is a mesh's `id`, with `shell` around its surface, in its unit, in which points inside are within `reach` of
    it. `noise` has amount, size and phase, and `seed` their pattern's number.
    """

    shape: int
    centre: wp.vec3
    size: wp.vec3
    half: wp.vec3
    turn: wp.quat
    mesh: wp.uint64
    shell: float
    reach: float
    noise: wp.vec3
    seed: int


@wp.func
def _local(region: Region, p: wp.vec3i) -> wp.vec3:
    x = wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)
    return wp.quat_rotate_inv(region.turn, x - region.centre)


@wp.func
def within(box: Box, walls: wp.array1d[wp.uint8], region: Region, p: wp.vec3i) -> bool:
    """Tests whether a source emits smoke in a fine cell: its centre is in the region, and it is not solid."""
    if is_solid(box, walls, p):
        return False
    x = wp.cw_div(_local(region, p), region.size)
    away = wp.abs(x)
    if region.shape == _SPHERE:
        return wp.dot(x, x) <= 1.0
    if region.shape == _BOX:
        return away[0] <= 1.0 and away[1] <= 1.0 and away[2] <= 1.0
    if region.shape == _CYLINDER:
        return x[0] * x[0] + x[2] * x[2] <= 1.0 and away[1] <= 1.0
    return in_mesh(region.mesh, x, region.reach, region.shell)


@wp.func
def strength(region: Region, p: wp.vec3i) -> float:
    """Returns the factor of a source's values in a fine cell: 1, or 1 plus Perlin noise in the source's frame and in
    time, of at most `noise[0]`, but at least 0."""
    if region.noise[0] == 0.0:
        return 1.0
    x = _local(region, p) / region.noise[1]
    # Perlin noise in four dimensions seldom leaves -1/2 to 1/2.
    value = 2.0 * wp.noise(wp.rand_init(region.seed), wp.vec4(x[0], x[1], x[2], region.noise[2]))
    return wp.max(1.0 + region.noise[0] * wp.clamp(value, -1.0, 1.0), 0.0)


@functools.cache
def source_kernels(stored: type) -> dict[str, wp.Kernel]:
    """Builds (once) the kernels for smoke stored as `wp.float32` or `wp.float16`, by their names: "source" has a thread
    for each fine cell of a box, "cover" some for each coarse cell, "lift" one for each of a slab, "store" for each cell
    of a brick and group."""
    fields_type = fields_struct(stored)

    @wp.func
    def in_range(value: float) -> float:
        if wp.static(stored is wp.float16):
            return wp.min(value, _LARGEST_HALF)
        return value

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def source(
        # in:
        box: Box,
        walls: wp.array1d[wp.uint8],
        region: Region,
        value: wp.vec2,
        kept: float,
        only_mark: bool,
        low: wp.vec3i,
        cells: wp.vec3i,
        bricks: Bricks,
        # in, out:
        fields: fields_type,
    ):
        p = low + cell_of(cells, wp.tid())
        # The bricks stay stored, however little smoke the source adds.
        _mark_busy(box, p, wp.inf, bricks)
        if only_mark or not within(box, walls, region, p):
            return
        i = address_of(box, bricks, p)
        share = strength(region, p)
        smoke = in_range(wp.max(kept * float(fields.density[i]) + share * value[0], 0.0))
        fields.density[i] = stored(smoke)
        if fields.temperature.shape[0] > 0:
            heat = in_range(wp.max(kept * float(fields.temperature[i]) + share * value[1], 0.0))
            fields.temperature[i] = stored(heat)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def cover(
        # in:
        box: Box,
        before: wp.array1d[wp.uint8],
        after: wp.array1d[wp.uint8],
        bricks: Bricks,
        lanes: int,
        # in, out:
        fields: fields_type,
    ):
        i, lane = wp.tid()
        was_solid = before[i] == SOLID
        if was_solid == (after[i] == SOLID):
            return
        coarse = cell_of(box.coarse, i)
        r = box.refinement
        for k in range(lane, r * r * r, lanes):
            inner = cell_of(wp.vec3i(r, r, r), k)
            p = wp.vec3i(coarse[0] * r + inner[0], coarse[1] * r + inner[1], coarse[2] * r + inner[2])
            smoke = float(0.0)
            heat = float(0.0)
            count = float(0.0)
            if was_solid:
                for j in range(27):
                    step = wp.vec3i(j // 9 - 1, j // 3 % 3 - 1, j % 3 - 1)
                    beside = coarse + step
                    # The nearest fine cell of this neighbour.
                    q = wp.vec3i()
                    valid = bool(True)
                    for a in range(3):
                        q[a] = wp.clamp(p[a], beside[a] * r, beside[a] * r + r - 1)
                        if box.periodic[a] != 0:
                            beside[a] = (beside[a] + box.coarse[a]) % box.coarse[a]
                            q[a] = (q[a] + box.n[a]) % box.n[a]
                        valid = valid and beside[a] >= 0 and beside[a] < box.coarse[a]
                    if valid:
                        c = index_of(box.coarse, beside)
                        if before[c] != SOLID and after[c] != SOLID:
                            at = address_of(box, bricks, q)
                            smoke += float(fields.density[at])
                            if fields.temperature.shape[0] > 0:
                                heat += float(fields.temperature[at])
                            count += 1.0
            weight = 1.0 / wp.max(count, 1.0)
            at = address_of(box, bricks, p)
            if bricks.workers > 0 and at < _CELLS:
                # Its brick is not stored: what is around is below the threshold.
                continue
            fields.density[at] = stored(weight * smoke)
            _mark_busy(box, p, weight * smoke, bricks)
            if fields.temperature.shape[0] > 0:
                fields.temperature[at] = stored(weight * heat)
                _mark_busy(box, p, weight * heat, bricks)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def lift(
        # in:
        begin: int,
        box: Box,
        walls: wp.array1d[wp.uint8],
        fields: fields_type,
        by_density: wp.vec3,
        by_temperature: wp.vec3,
        bricks: Bricks,
        # out:
        force: wp.array1d[wp.vec3],
    ):
        i = begin + wp.tid()
        coarse = cell_of(box.coarse, i)
        r = box.refinement
        first = r * coarse
        needed = int(1)
        if bricks.workers > 0:
            last = wp.vec3i(first[0] + r - 1, first[1] + r - 1, first[2] + r - 1)
            needed = int(0)
            for x in range(first[0] // _BRICK, last[0] // _BRICK + 1):
                for y in range(first[1] // _BRICK, last[1] // _BRICK + 1):
                    for z in range(first[2] // _BRICK, last[2] // _BRICK + 1):
                        needed = wp.max(needed, bricks.places[index_of(box.bricks, wp.vec3i(x, y, z))])
        smoke = float(0.0)
        heat = float(0.0)
        if needed != 0 and not is_solid(box, walls, first):
            for x in range(r):
                for y in range(r):
                    for z in range(r):
                        at = address_of(box, bricks, first + wp.vec3i(x, y, z))
                        smoke += float(fields.density[at])
                        if fields.temperature.shape[0] > 0:
                            heat += float(fields.temperature[at])
        volume = box.voxel * box.voxel * box.voxel
        force[i] = (volume * smoke) * by_density + (volume * heat) * by_temperature

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def store(
        # in:
        groups: int,
        # in, out:
        bricks: Bricks,
        # out:
        fields: fields_type,
    ):
        i = wp.tid()
        cell = i % _CELLS
        for k in range(i // _CELLS, bricks.counts[1], groups):
            place = bricks.free[bricks.depth[0] - 1 - k]
            if cell == 0:
                bricks.places[bricks.fresh[k]] = place
            fields.density[place * _CELLS + cell] = stored(0.0)
            if fields.temperature.shape[0] > 0:
                fields.temperature[place * _CELLS + cell] = stored(0.0)

    return {"source": source, "cover": cover, "lift": lift, "store": store}


def _launch(name: str, size: int | tuple[int, int], inputs: list, output, fields: Fields) -> None:
    kernel = source_kernels(fields.density.dtype)[name]
    wp.launch(kernel, size, inputs=inputs, outputs=[output], device=fields.density.device)


def make_region(
    shape: str | wp.Mesh,
    centre: Sequence[float],
    size: Sequence[float],
    *,
    extent: Sequence[float] = (1.0, 1.0, 1.0),
    turn: Sequence[float] = (0.0, 0.0, 0.0, 1.0),
    shell: float = 0.0,
    noise: tuple[float, float, float] = (0.0, 1.0, 0.0),
    seed: int = 0,
) -> Region:
    """Makes the region of a source, see `Region`. Of a mesh, made with `support_winding_number=True`, `extent` are the
    largest distances along its axes from its origin, in its unit; its shell is in fine cells."""
    region = Region()
    if isinstance(shape, wp.Mesh):
        region.shape, region.mesh, region.shell = SHAPES.index("mesh"), shape.id, shell / min(size)
        extent = np.asarray(extent) + region.shell
        region.reach = 4.0 * float(extent.sum())
    else:
        region.shape = SHAPES.index(shape)
    axes = np.array(wp.quat_to_matrix(wp.quat(*turn))).reshape(3, 3)
    region.centre, region.size, region.half = (
        wp.vec3(*centre),
        wp.vec3(*size),
        wp.vec3(*np.abs(axes) @ np.multiply(size, extent)),
    )
    region.turn, region.noise, region.seed = wp.quat(*turn), wp.vec3(*noise), seed
    return region


def cells_of(box: Box, region: Region) -> tuple[wp.vec3i, wp.vec3i, int]:
    """Returns the lowest fine cell of the box around a source, the cells of this box along each axis, and in all."""
    low = [max(0, int(c - h)) for c, h in zip(region.centre, region.half, strict=True)]
    high = [min(n, int(max(c + h + 1.0, 0.0))) for c, h, n in zip(region.centre, region.half, box.n, strict=True)]
    cells = [max(0, b - a) for a, b in zip(low, high, strict=True)]
    return wp.vec3i(*low), wp.vec3i(*cells), cells[0] * cells[1] * cells[2]


def add_source(
    box: Box,
    walls: wp.array,
    region: Region,
    value: tuple[float, float],
    fields: Fields,
    *,
    fixed: bool,
    bricks: Bricks = DENSE,
    only_mark: bool = False,
) -> None:
    """Adds or sets smoke in the cells whose centres are in a region; density and temperature stay at least 0.

    Args:
        box: The domain.
        walls: The marks of solid cells, as for `advection.advect`.
        region: The region, from `make_region`.
        value: Density and temperature to add or to set, before noise.
        fields: The smoke, modified.
        fixed: Whether the values are set instead of added.
        bricks: Those of the source's box, all of which must be stored, are marked as busy.
        only_mark: Whether bricks are marked and nothing else is done.
    """
    low, cells, total = cells_of(box, region)
    if total > 0:
        inputs = [box, walls, region, wp.vec2(*value), 0.0 if fixed else 1.0, only_mark, low, cells, bricks]
        _launch("source", total, inputs, fields.arrays, fields)


def change_solids(box: Box, before: wp.array, after: wp.array, fields: Fields, bricks: Bricks = DENSE) -> None:
    """Empties the cells that become solid, and fills the cells that become fluid from their neighbours.

    `before` and `after` are marks of solid cells, uint8 [coarse cells], from `advection_places.mark_walls`. Bricks that
    receive smoke, which must be stored, are marked as busy.
    """
    # On a GPU one thread would take long for all fine cells of a coarse one.
    lanes = box.refinement**2 if before.device.is_cuda else 1
    _launch("cover", (before.shape[0], lanes), [box, before, after, bricks, lanes], fields.arrays, fields)


def buoyancy(
    box: Box,
    walls: wp.array,
    fields: Fields,
    by_density: Sequence[float],
    by_temperature: Sequence[float],
    force: wp.array,
    bricks: Bricks = DENSE,
    slab: Slab | None = None,
) -> None:
    """Computes the acceleration of the air by smoke, linear in the mean density and temperature of a coarse cell.

    Args:
        box: The domain.
        walls: The marks of solid cells, as for `advection.advect`.
        fields: The smoke.
        by_density, by_temperature: (3,), acceleration at density 1 and at temperature 1, coarse cells per step squared.
        force: vec3 [coarse cells], the acceleration, written; 0 in solids.
        bricks: Cells outside the listed bricks count as empty.
        slab: The coarse cells to compute; default all.
    """
    inputs = [box, walls, fields.arrays, wp.vec3(*by_density), wp.vec3(*by_temperature), bricks]
    slab = slab or Slab(force.device, 0, box.coarse[0])
    launch_slab(source_kernels(fields.density.dtype)["lift"], box.coarse, slab, inputs, [force])


def store(bricks: Bricks, fields: Fields, clear: bool = True) -> None:
    """Gives the bricks that `advection_places.relist` added to its list their places in the pool, and empties them in
    the smoke before the step; other buffers of the step may hold anything there. With `clear` no brick is busy then."""
    groups = min(bricks.workers, _STORING)
    for each in (fields, fields.burning) if fields.fuel is not None else (fields,):
        _launch("store", groups * CELLS, [groups, bricks], each.arrays, each)
    settle(bricks, clear)
