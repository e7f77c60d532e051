"""Smoke carried by air: fields on a fine grid, moved along the velocities of a coarse one (neural-six-way-lightmaps,
section 5: 100^3 velocities, 400^3 densities).

Two schemes. Semi-Lagrangian: each cell takes what lies where its smoke was a step ago, found by a midpoint
(second-order Runge-Kutta) trace and read trilinearly; unconditionally stable, no new extrema, first order. A midpoint
within ``REACH`` of the eight velocities about the start is read from these, extrapolated.
MacCormack (Selle et al. 2008): the same, then half of what a way there and back loses is given back, and the result is
held between the least and the largest of the eight values that the first trace read; second order where smooth.
Neither conserves mass.

Places are in fine cells, centres at half integers; fields are flat, [X, Y, Z] with z fastest. Velocities are coarse
cells a step at the centres of coarse cells, trilinear between them and constant beyond the outermost. Stated behaviour:

===============================  =====================================================================
a trace that leaves the domain   at an open face: clean air comes in, 0; at a closed one: held at it
a trace that ends in a solid     cut where it first meets it, by bisection: to within 1/64 of its length
a read beside a solid            solid cells don't count, the other weights are scaled up
a cell in a solid                0
MacCormack with an end beside a  semi-Lagrangian there
solid or beyond an open face
a velocity that isn't a number   reads some cell of the grid, never beyond it
more than half floats hold       65504
===============================  =====================================================================

A trace shorter than a coarse cell can't jump a wall. None of it has a gradient.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.advection_places import (
    BRICK,
    BRICK_RUN,
    FREE,
    RUN,
    SOLID,
    Box,
    Bricks,
    Corner,
    Patch,
    corner,
    cut,
    evaluate,
    fetch,
    inside,
    leaves,
    place,
    stencil,
    stencil_index,
    stencil_weight,
    step_back,
    wall_at,
    within,
)
from wlm_kernels.fluid.lattice_sets import cell_of, index_of

__all__ = ["STORAGES", "Fields", "advect", "correct", "field_kernels", "storage_of"]

# Loops over eight cells are for places beside solids: unrolled they would take the registers of all others.
_OPTIONS = {"enable_backward": False, "max_unroll": 4}

# Threads of a block, and blocks that share a multiprocessor: what else takes 110 registers then makes room for more
# threads and spills where it rarely goes: fewer blocks are slower.
_BOUNDS = (256, 4)

STORAGES = {"float32": wp.float32, "float16": wp.float16}

_LARGEST_HALF = wp.constant(65504.0)
_BRICK_RUNS = wp.constant(BRICK * BRICK * BRICK // BRICK_RUN)


@dataclass(frozen=True)
class Fields:
    """What is carried: densities, and temperatures or an array of no cells."""

    density: wp.array
    heat: wp.array


@dataclass(frozen=True)
class FieldKernels:
    """Of one storage, dense or in bricks.

    Attributes:
        advect: Semi-Lagrangian; over runs of ``RUN`` cells along x, or with bricks over workers times a brick's runs.
        correct: MacCormack's second half, likewise.
    """

    advect: wp.Kernel
    correct: wp.Kernel


@functools.cache
def field_kernels(storage: str, in_bricks: bool, solids: bool, hot: bool) -> FieldKernels:
    """Builds (once) the kernels that carry fields; those that know no solids are half the code, and use fewer registers
    where there is no temperature."""
    stored = STORAGES[storage]
    run = BRICK_RUN if in_bricks else RUN

    @wp.func
    def keep_in_range(value: float) -> stored:
        if wp.static(storage == "float16"):
            return stored(wp.min(value, _LARGEST_HALF))
        return stored(value)

    # By Warp's strides, 64 bits wide each, the addresses would be a third of the work.
    @wp.func_native("return field.data[i];")
    def peek(field: wp.array1d[stored], i: int) -> stored: ...

    @wp.func_native("field.data[i] = value;")
    def poke(field: wp.array1d[stored], i: int, value: stored): ...

    @wp.func
    def value_at(field: wp.array1d[stored], i: int) -> float:
        return float(peek(field, i))

    @wp.func
    def mixed(field: wp.array1d[stored], at: Corner) -> float:
        """A field at a place."""
        i00 = at.base
        i01 = at.base + at.step[1]
        i10 = at.base + at.step[0]
        i11 = i10 + at.step[1]
        a = wp.lerp(value_at(field, i00), value_at(field, i00 + at.step[2]), at.f[2])
        b = wp.lerp(value_at(field, i01), value_at(field, i01 + at.step[2]), at.f[2])
        c = wp.lerp(value_at(field, i10), value_at(field, i10 + at.step[2]), at.f[2])
        d = wp.lerp(value_at(field, i11), value_at(field, i11 + at.step[2]), at.f[2])
        return wp.lerp(wp.lerp(a, b, at.f[1]), wp.lerp(c, d, at.f[1]), at.f[0])

    @wp.func
    def mixed_beside(field: wp.array1d[stored], walls: wp.array1d[wp.uint8], box: Box, p: wp.vec3) -> float:
        """The same at a place beside a solid, of which nothing is taken."""
        at = stencil(box.n, box.periodic, p)
        total = float(0.0)
        weight = float(0.0)
        for k in range(8):
            cell = stencil_index(at, k)
            if not inside(box, walls, cell):
                w = stencil_weight(at, k)
                total += w * value_at(field, index_of(box.n, cell))
                weight += w
        # Nothing but solid cells: there is no smoke to be had.
        return total / wp.max(weight, 1.0e-6)

    @wp.func
    def limited(field: wp.array1d[stored], at: Corner, value: float) -> float:
        """A value held between the least and the largest of those that ``mixed`` mixes."""
        i00 = at.base
        i01 = at.base + at.step[1]
        i10 = at.base + at.step[0]
        i11 = i10 + at.step[1]
        a = wp.vec4(value_at(field, i00), value_at(field, i01), value_at(field, i10), value_at(field, i11))
        i00 += at.step[2]
        i01 += at.step[2]
        i10 += at.step[2]
        i11 += at.step[2]
        b = wp.vec4(value_at(field, i00), value_at(field, i01), value_at(field, i10), value_at(field, i11))
        return wp.clamp(value, wp.min(wp.min(a, b)), wp.max(wp.max(a, b)))

    @wp.func
    def end_of(
        box: Box,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        patch: Patch,
        f: wp.vec3,
        x: wp.vec3,
        v: wp.vec3,
        dt: float,
        own: wp.uint8,
    ):
        """Where a trace from x ends in the domain, whether it left it, and whether what lies there has to do with a
        solid; ``own`` is what ``walls`` has where it starts."""
        end = step_back(box, u, patch, f, x, v, dt)
        p = wp.vec3(end)
        left = bool(False)
        near = bool(False)
        if not within(box, end):
            p = place(box, end)
            left = leaves(box, end)
        if wp.static(solids):
            # Half a coarse cell away from one with no solid about it there is none, and none within a read of there.
            reach = 0.5 * float(box.ratio)
            away = end - x
            short = wp.abs(away[0]) <= reach and wp.abs(away[1]) <= reach and wp.abs(away[2]) <= reach
            if own != FREE or not short:
                wall = wall_at(box, walls, p)
                near = wall != FREE
                if wall == SOLID:
                    end = cut(box, walls, x, end)
                    p = place(box, end)
                    left = leaves(box, end)
        return p, left, near

    @wp.func
    def first_of_run(box: Box, listed: wp.array1d[int], i: int, k: int) -> wp.vec3i:
        """The first cell of a run: of the whole domain, or of the k-th listed brick."""
        if wp.static(in_bricks):
            r = i % _BRICK_RUNS
            b = cell_of(box.bricks, listed[k])
            within = cell_of(wp.vec3i(BRICK // BRICK_RUN, BRICK, BRICK), r)
            return wp.vec3i(b[0] * BRICK + within[0] * BRICK_RUN, b[1] * BRICK + within[1], b[2] * BRICK + within[2])
        p = cell_of(box.n, i)
        return wp.vec3i(p[0] * RUN, p[1], p[2])

    @wp.func
    def advect_run(
        box: Box,
        first: wp.vec3i,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        dt: float,
        share: wp.vec2,
        new_density: wp.array1d[stored],
        new_heat: wp.array1d[stored],
    ) -> float:
        """Does a run of cells; gives the largest value among them."""
        most = float(0.0)
        patch = Patch()
        patch_x = float(-2.0)
        own = wp.uint8(0)
        own_x = float(-1.0)
        for x_cell in range(first[0], wp.min(first[0] + wp.static(run), box.n[0])):
            cell = wp.vec3i(x_cell, first[1], first[2])
            i = index_of(box.n, cell)
            amount = float(0.0)
            warmth = float(0.0)
            x = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, float(cell[2]) + 0.5)
            if wp.static(solids):
                coarse_x = wp.floor(box.share * x[0])
                if coarse_x != own_x:
                    own = wall_at(box, walls, x)
                    own_x = coarse_x
            if own != SOLID:
                f = box.share * x - wp.vec3(0.5, 0.5, 0.5)
                least = wp.vec3(wp.floor(f[0]), wp.floor(f[1]), wp.floor(f[2]))
                if least[0] != patch_x:
                    patch = fetch(u, box.coarse, stencil(box.coarse, box.periodic, box.share * x))
                    patch_x = least[0]
                f -= least
                p, left, near = end_of(box, u, walls, patch, f, x, evaluate(patch, f), dt, own)
                if not left:
                    if wp.static(solids):
                        if near:
                            amount = share[0] * mixed_beside(density, walls, box, p)
                            if wp.static(hot):
                                warmth = share[1] * mixed_beside(heat, walls, box, p)
                    if not near:
                        at = corner(box, p)
                        amount = share[0] * mixed(density, at)
                        if wp.static(hot):
                            warmth = share[1] * mixed(heat, at)
            poke(new_density, i, keep_in_range(amount))
            most = wp.max(most, amount)
            if wp.static(hot):
                poke(new_heat, i, keep_in_range(warmth))
                most = wp.max(most, warmth)
        return most

    @wp.func
    def correct_run(
        box: Box,
        first: wp.vec3i,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        density_hat: wp.array1d[stored],
        heat_hat: wp.array1d[stored],
        dt: float,
        share: wp.vec2,
        new_density: wp.array1d[stored],
        new_heat: wp.array1d[stored],
    ) -> float:
        most = float(0.0)
        patch = Patch()
        patch_x = float(-2.0)
        own = wp.uint8(0)
        own_x = float(-1.0)
        for x_cell in range(first[0], wp.min(first[0] + wp.static(run), box.n[0])):
            cell = wp.vec3i(x_cell, first[1], first[2])
            i = index_of(box.n, cell)
            amount = value_at(density_hat, i)
            warmth = float(0.0)
            if wp.static(hot):
                warmth = value_at(heat_hat, i)
            x = wp.vec3(float(cell[0]) + 0.5, float(cell[1]) + 0.5, float(cell[2]) + 0.5)
            if wp.static(solids):
                coarse_x = wp.floor(box.share * x[0])
                if coarse_x != own_x:
                    own = wall_at(box, walls, x)
                    own_x = coarse_x
            if own != SOLID:
                f = box.share * x - wp.vec3(0.5, 0.5, 0.5)
                least = wp.vec3(wp.floor(f[0]), wp.floor(f[1]), wp.floor(f[2]))
                if least[0] != patch_x:
                    patch = fetch(u, box.coarse, stencil(box.coarse, box.periodic, box.share * x))
                    patch_x = least[0]
                f -= least
                v = evaluate(patch, f)
                p, left_p, near_p = end_of(box, u, walls, patch, f, x, v, dt, own)
                q, left_q, near_q = end_of(box, u, walls, patch, f, x, v, -dt, own)
                if not (left_p or left_q or near_p or near_q):
                    origin = corner(box, p)
                    target = corner(box, q)
                    back = mixed(density_hat, target)
                    amount = limited(density, origin, amount + 0.5 * (value_at(density, i) - back))
                    if wp.static(hot):
                        cold = mixed(heat_hat, target)
                        warmth = limited(heat, origin, warmth + 0.5 * (value_at(heat, i) - cold))
            amount *= share[0]
            warmth *= share[1]
            poke(new_density, i, keep_in_range(amount))
            most = wp.max(most, amount)
            if wp.static(hot):
                poke(new_heat, i, keep_in_range(warmth))
                most = wp.max(most, warmth)
        return most

    @wp.kernel(module="unique", module_options=_OPTIONS, launch_bounds=_BOUNDS)
    def advect(
        # in:
        box: Box,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        dt: float,
        share: wp.vec2,
        listed: wp.array1d[int],
        count: wp.array1d[int],
        workers: int,
        threshold: float,
        # out:
        busy: wp.array1d[int],
        new_density: wp.array1d[stored],
        new_heat: wp.array1d[stored],
    ):
        i = wp.tid()
        if wp.static(in_bricks):
            for k in range(i // _BRICK_RUNS, count[0], workers):
                first = first_of_run(box, listed, i, k)
                if first[0] < box.n[0] and first[1] < box.n[1] and first[2] < box.n[2]:
                    most = advect_run(box, first, u, walls, density, heat, dt, share, new_density, new_heat)
                    if most > threshold:
                        busy[listed[k]] = 1
        else:
            first = first_of_run(box, listed, i, 0)
            advect_run(box, first, u, walls, density, heat, dt, share, new_density, new_heat)

    @wp.kernel(module="unique", module_options=_OPTIONS, launch_bounds=_BOUNDS)
    def correct(
        # in:
        box: Box,
        u: wp.array1d[wp.vec3],
        walls: wp.array1d[wp.uint8],
        density: wp.array1d[stored],
        heat: wp.array1d[stored],
        density_hat: wp.array1d[stored],
        heat_hat: wp.array1d[stored],
        dt: float,
        share: wp.vec2,
        listed: wp.array1d[int],
        count: wp.array1d[int],
        workers: int,
        threshold: float,
        # out:
        busy: wp.array1d[int],
        new_density: wp.array1d[stored],
        new_heat: wp.array1d[stored],
    ):
        i = wp.tid()
        if wp.static(in_bricks):
            for k in range(i // _BRICK_RUNS, count[0], workers):
                first = first_of_run(box, listed, i, k)
                if first[0] < box.n[0] and first[1] < box.n[1] and first[2] < box.n[2]:
                    most = correct_run(
                        box, first, u, walls, density, heat, density_hat, heat_hat, dt, share, new_density, new_heat
                    )
                    if most > threshold:
                        busy[listed[k]] = 1
        else:
            first = first_of_run(box, listed, i, 0)
            correct_run(box, first, u, walls, density, heat, density_hat, heat_hat, dt, share, new_density, new_heat)

    return FieldKernels(advect, correct)


def storage_of(fields: Fields) -> str:
    """The name, of ``STORAGES``, of what the fields are stored as."""
    return "float16" if fields.density.dtype is wp.float16 else "float32"


def _launch(name: str, box: Box, first: Sequence, fields: Fields, dt, share, bricks, threshold, out: Fields) -> None:
    solids = first[2].shape[0] > 0
    hot = fields.heat.shape[0] > 0
    kernel = getattr(field_kernels(storage_of(fields), bricks is not None, solids, hot), name)
    device = fields.density.device
    if bricks is None:
        threads = -(-box.n[0] // RUN) * box.n[1] * box.n[2]
        nothing = wp.empty(0, dtype=int, device=device)
        where, busy = [nothing, nothing, 0], nothing
    else:
        threads = bricks.workers * int(_BRICK_RUNS)
        where, busy = [bricks.listed, bricks.count, bricks.workers], bricks.busy
    inputs = [*first, float(dt), wp.vec2(*share), *where, float(threshold)]
    wp.launch(kernel, threads, inputs=inputs, outputs=[busy, out.density, out.heat], device=device)


def advect(
    box: Box,
    velocity: wp.array,
    walls: wp.array,
    fields: Fields,
    out: Fields,
    dt: float,
    share: tuple[float, float] = (1.0, 1.0),
    bricks: Bricks | None = None,
    threshold: float = 0.0,
) -> None:
    """A semi-Lagrangian step, or the first half of a MacCormack step.

    Args:
        box: The domain, see ``advection_places.make_box``.
        velocity: vec3 [coarse cells], cells a step.
        walls: uint8 [coarse cells] as ``advection_places.mark_walls`` makes it, or [0] without solids.
        fields: float or half [cells], both of one type.
        out: Like it, other arrays.
        dt: Steps.
        share: What is left of density and temperature, at most 1; (1, 1) in the first half of a MacCormack step.
        bricks: Where to work, listed already; None for everywhere.
        threshold: With bricks: the value above which a brick is busy.
    """
    first = [box, velocity, walls, fields.density, fields.heat]
    _launch("advect", box, first, fields, dt, share, bricks, threshold, out)


def correct(
    box: Box,
    velocity: wp.array,
    walls: wp.array,
    fields: Fields,
    predicted: Fields,
    out: Fields,
    dt: float,
    share: tuple[float, float] = (1.0, 1.0),
    bricks: Bricks | None = None,
    threshold: float = 0.0,
) -> None:
    """The second half of a MacCormack step: ``predicted`` is what ``advect`` made of ``fields``; ``out`` is a third."""
    first = [box, velocity, walls, fields.density, fields.heat, predicted.density, predicted.heat]
    _launch("correct", box, first, fields, dt, share, bricks, threshold, out)
