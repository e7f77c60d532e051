"""What changes smoke but the air: sources, solids that come and go; and what smoke does to air, buoyancy.

Fields and domains are those of ``advection`` and ``advection_places``. Stated behaviour:

==============================  ======================================================================
a source in a solid             gives nothing there
a source outside the domain     gives nothing
a source that adds less than    nothing is added: half floats have 11 bits
half floats can tell
cells that a solid covers       their smoke is lost
cells that a solid frees        the mean of the nearest cells in the fluid coarse cells around; 0 if none
==============================  ======================================================================
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.advection import STORAGES, Fields, storage_of
from wlm_kernels.fluid.advection_places import BRICK, Box, Bricks, inside
from wlm_kernels.fluid.lattice_sets import cell_of, index_of

__all__ = ["BOX", "SPHERE", "add_source", "buoyancy", "change_solids", "rest", "source_kernels"]

_OPTIONS = {"enable_backward": False}

SPHERE, BOX = 0, 1
"""Shapes of a source."""

_SPHERE = wp.constant(SPHERE)
_LARGEST_HALF = wp.constant(65504.0)
_BRICK = wp.constant(BRICK)
_BRICK_CELLS = wp.constant(BRICK**3)
_SOLID = wp.constant(wp.uint8(2))


@dataclass(frozen=True)
class SourceKernels:
    """Of one storage.

    Attributes:
        source: Over the cells of a box about a source.
        cover: Empties what becomes solid and fills what ceases to be, over coarse cells.
        lift: Over coarse cells.
        rest: Empties retired bricks, over workers times a brick's cells.
    """

    source: wp.Kernel
    cover: wp.Kernel
    lift: wp.Kernel
    rest: wp.Kernel


@wp.func
def _brick_of(box: Box, p: wp.vec3i) -> int:
    return index_of(box.bricks, wp.vec3i(p[0] // _BRICK, p[1] // _BRICK, p[2] // _BRICK))


@wp.func
def _mark_busy(box: Box, p: wp.vec3i, value: float, threshold: float, busy: wp.array1d[int]):
    if busy.shape[0] > 0 and value > threshold:
        busy[_brick_of(box, p)] = 1


@functools.cache
def source_kernels(storage: str) -> SourceKernels:
    """Builds (once) the kernels of a storage."""
    stored = STORAGES[storage]

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def source(
        # in:
        box: Box,
        walls: wp.array1d[wp.uint8],
        kind: int,
        centre: wp.vec3,
        half: wp.vec3,
        value: wp.vec2,
        grow: float,
        low: wp.vec3i,
        size: wp.vec3i,
        threshold: float,
        # in, out:
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        busy: wp.array1d[int],
    ):
        p = low + cell_of(size, wp.tid())
        if inside(box, walls, p):
            return
        x = wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)
        away = wp.abs(wp.cw_div(x - centre, half))
        within = away[0] <= 1.0 and away[1] <= 1.0 and away[2] <= 1.0
        if kind == _SPHERE:
            within = wp.dot(away, away) <= 1.0
        if not within:
            return
        i = index_of(box.n, p)
        amount = wp.max(grow * float(density[i]) + value[0], 0.0)
        if wp.static(storage == "float16"):
            amount = wp.min(amount, _LARGEST_HALF)
        density[i] = stored(amount)
        _mark_busy(box, p, amount, threshold, busy)
        if heat.shape[0] > 0:
            warmth = wp.max(grow * float(heat[i]) + value[1], 0.0)
            if wp.static(storage == "float16"):
                warmth = wp.min(warmth, _LARGEST_HALF)
            heat[i] = stored(warmth)
            _mark_busy(box, p, warmth, threshold, busy)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def cover(
        # in:
        box: Box,
        before: wp.array1d[wp.uint8],
        after: wp.array1d[wp.uint8],
        threshold: float,
        # in, out:
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        busy: wp.array1d[int],
    ):
        i = wp.tid()
        was = before[i] == _SOLID
        if was == (after[i] == _SOLID):
            return
        coarse = cell_of(box.coarse, i)
        r = box.ratio
        for k in range(r * r * r):
            within = cell_of(wp.vec3i(r, r, r), k)
            p = wp.vec3i(coarse[0] * r + within[0], coarse[1] * r + within[1], coarse[2] * r + within[2])
            amount = float(0.0)
            warmth = float(0.0)
            found = float(0.0)
            if was:
                for j in range(27):
                    step = wp.vec3i(j // 9 - 1, j // 3 % 3 - 1, j % 3 - 1)
                    beside = coarse + step
                    # The cell of the neighbour that lies nearest.
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
                        if before[c] != _SOLID and after[c] != _SOLID:
                            at = index_of(box.n, q)
                            amount += float(density[at])
                            if heat.shape[0] > 0:
                                warmth += float(heat[at])
                            found += 1.0
            share = 1.0 / wp.max(found, 1.0)
            at = index_of(box.n, p)
            density[at] = stored(share * amount)
            _mark_busy(box, p, share * amount, threshold, busy)
            if heat.shape[0] > 0:
                heat[at] = stored(share * warmth)
                _mark_busy(box, p, share * warmth, threshold, busy)

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def lift(
        # in:
        box: Box,
        walls: wp.array1d[wp.uint8],
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        fall: wp.vec3,
        rise: wp.vec3,
        active: wp.array1d[int],
        # out:
        force: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        coarse = cell_of(box.coarse, i)
        r = box.ratio
        first = r * coarse
        needed = int(1)
        if active.shape[0] > 0:
            last = wp.vec3i(first[0] + r - 1, first[1] + r - 1, first[2] + r - 1)
            needed = int(0)
            for x in range(first[0] // _BRICK, last[0] // _BRICK + 1):
                for y in range(first[1] // _BRICK, last[1] // _BRICK + 1):
                    for z in range(first[2] // _BRICK, last[2] // _BRICK + 1):
                        needed = wp.max(needed, active[index_of(box.bricks, wp.vec3i(x, y, z))])
        amount = float(0.0)
        warmth = float(0.0)
        if needed != 0 and not inside(box, walls, first):
            for x in range(r):
                for y in range(r):
                    row = ((first[0] + x) * box.n[1] + first[1] + y) * box.n[2] + first[2]
                    for z in range(r):
                        amount += float(density[row + z])
                        if heat.shape[0] > 0:
                            warmth += float(heat[row + z])
        share = box.share * box.share * box.share
        force[i] = (share * amount) * fall + (share * warmth) * rise

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def rest(
        # in:
        box: Box,
        retired: wp.array1d[int],
        left: wp.array1d[int],
        workers: int,
        # out:
        field: wp.array1d[stored],
    ):
        i = wp.tid()
        for k in range(i // _BRICK_CELLS, left[0], workers):
            b = cell_of(box.bricks, retired[k])
            within = cell_of(wp.vec3i(_BRICK, _BRICK, _BRICK), i % _BRICK_CELLS)
            p = _BRICK * b + within
            if p[0] < box.n[0] and p[1] < box.n[1] and p[2] < box.n[2]:
                field[index_of(box.n, p)] = stored(0.0)

    return SourceKernels(source, cover, lift, rest)


def _busy_of(fields: Fields, bricks: Bricks | None) -> wp.array:
    return wp.empty(0, dtype=int, device=fields.density.device) if bricks is None else bricks.busy


def add_source(
    box: Box,
    walls: wp.array,
    kind: int,
    centre: Sequence[float],
    half: Sequence[float],
    value: tuple[float, float],
    fields: Fields,
    *,
    fixed: bool,
    bricks: Bricks | None = None,
    threshold: float = 0.0,
) -> None:
    """Adds to the cells whose centres lie in a box or an ellipsoid, or sets them; below 0 they don't get.

    Args:
        box: The domain.
        walls: As for ``advection.advect``.
        kind: ``SPHERE`` or ``BOX``.
        centre: In fine cells.
        half: Radii or half edges, fine cells, above 0.
        value: Density and temperature to add or to set.
        fields: Changed.
        fixed: Whether they are set.
        bricks: Where smoke comes in, its bricks are marked as busy.
        threshold: The value above which they are.
    """
    low = [max(0, int(c - h)) for c, h in zip(centre, half, strict=True)]
    high = [min(n, int(max(c + h + 1.0, 0.0))) for c, h, n in zip(centre, half, box.n, strict=True)]
    size = [max(0, b - a) for a, b in zip(low, high, strict=True)]
    cells = size[0] * size[1] * size[2]
    if cells == 0:
        return
    what = [kind, wp.vec3(*centre), wp.vec3(*half), wp.vec2(*value), 0.0 if fixed else 1.0]
    inputs = [box, walls, *what, wp.vec3i(*low), wp.vec3i(*size), float(threshold)]
    outputs = [fields.density, fields.heat, _busy_of(fields, bricks)]
    kernel = source_kernels(storage_of(fields)).source
    wp.launch(kernel, cells, inputs=inputs, outputs=outputs, device=fields.density.device)


def change_solids(
    box: Box, before: wp.array, after: wp.array, fields: Fields, bricks: Bricks | None = None, threshold: float = 0.0
) -> None:
    """Empties the cells that become solid and fills those that no longer are.

    Args:
        box: The domain.
        before, after: uint8 [coarse cells], from ``advection_places.mark_walls``.
        fields: Changed.
        bricks, threshold: As for ``add_source``.
    """
    outputs = [fields.density, fields.heat, _busy_of(fields, bricks)]
    kernel = source_kernels(storage_of(fields)).cover
    inputs = [box, before, after, float(threshold)]
    wp.launch(kernel, before.shape[0], inputs=inputs, outputs=outputs, device=before.device)


def buoyancy(
    box: Box,
    walls: wp.array,
    fields: Fields,
    fall: Sequence[float],
    rise: Sequence[float],
    force: wp.array,
    bricks: Bricks | None = None,
) -> None:
    """The acceleration of each coarse cell's air, of the means of its fine cells: density fall + temperature rise.

    Args:
        box: The domain.
        walls: As for ``advection.advect``.
        fields: The smoke.
        fall, rise: (3,), of density 1 and of temperature 1, coarse cells a step, a step.
        force: vec3 [coarse cells], set; 0 in solids.
        bricks: Those last listed, and busy since; None: all.
    """
    active = wp.empty(0, dtype=int, device=force.device) if bricks is None else bricks.active
    inputs = [box, walls, fields.density, fields.heat, wp.vec3(*fall), wp.vec3(*rise), active]
    kernel = source_kernels(storage_of(fields)).lift
    wp.launch(kernel, force.shape[0], inputs=inputs, outputs=[force], device=force.device)


def rest(box: Box, bricks: Bricks, field: wp.array) -> None:
    """Empties the bricks that ``advection_places.relist`` retired; to be done in every buffer."""
    storage = "float16" if field.dtype is wp.float16 else "float32"
    inputs = [box, bricks.retired, bricks.left, bricks.workers]
    threads = bricks.workers * int(_BRICK_CELLS)
    kernel = source_kernels(storage).rest
    wp.launch(kernel, threads, inputs=inputs, outputs=[field], device=field.device)
