"""Boundary conditions of the lattice: walls, inlets and outlets.

Read `tests/reference/lattice.py` first: `stream` there has the same conditions in float64 NumPy, link by link.

A link is a fluid cell a and a direction q from which a population arrives from beyond a face of the domain or out of a
solid. (Axes closed by walls at rest have no links: the step of `lattice` handles them.) The element of this population,
as if it came from the periodic image of the cell a - c_q, is read by no other cell. After every step the values of the
links are computed from the populations f* that have just left the cells, and are then written into these elements. This
takes two passes, since the element of one link may be read by another.

- bounce: f_q = f*_opposite + term, half-way bounce-back; the term is 6 w_q c_q . u at a wall of velocity u.
- inlet: the same formula; it adds a mass of u per cell of the face. The term may rise from 0 in the first steps.
- wind: an inlet whose velocity is the same at all of its cells and may change at every step.
- slip: a wall without friction: the mirror image of the population that leaves the neighbouring cell.
- outlet: the equilibrium at the cell's own density and velocity (zero gradient). It is then shifted, by w_q times the
  same factor at all outlets, so that outflow equals inflow: mass is conserved to rounding.
- pressure: the outlet without the shift; its density relaxes towards a given density: the term, plus 1.

Velocities into the domain are set to 0 at an outlet: backflow would feed on itself.

Bodies that move have no links: after a step, with the bodies at their next places, `bounce` finds the populations that
they send back in the cells around them. No link's cell reads these elements, so that it needs one pass. Before, it
fills the cells that a body has just left with the equilibrium at the mean density and velocity of the fluid beside.
"""

import functools
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_bodies import Motion, Window, centre_of, size_of, wall_velocity, window_cell
from wlm_kernels.fluid.lattice_sets import (
    OPPOSITE,
    STORAGES,
    Layout,
    Slab,
    Tables,
    cell_of,
    crosses,
    equilibrium,
    index_of,
    memory_functions,
    opposite,
    wrapped,
)
from wlm_kernels.fluid.lattice_sets import lattice as velocity_set

wp.set_module_options({"enable_backward": False})

BOUNCE, SLIP, OUTLET, PRESSURE, INLET, WIND = range(6)
_BOUNCE, _SLIP, _OUTLET, _INLET, _WIND = (wp.constant(kind) for kind in (BOUNCE, SLIP, OUTLET, INLET, WIND))

BLOCK = 256

# An outlet of fixed density reflects all sound. Relaxed at this rate per crossing of the domain (0.25 to 0.6 in the
# literature, Poinsot and Lele 1992), it transmits most of the sound and still keeps the mean density.
HOLD = wp.constant(0.3)


@wp.struct
class Links:
    """The links of the domain's faces, followed by the links of solids, on a device; arrays have room for L links, of
    which `used`, int [1], are in use, `faces` of them links of faces.

    `cell`, int [L], is the fluid cell a; `code`, uint8 [L], the direction q + 32 times the kind of boundary; `term`,
    float [L], the term of the boundary condition, see the module; `value`, float [L], the population that the boundary
    returns, result of the first pass; `wind`, vec3 [1], the velocity of the wind in cells per step.
    """

    cell: wp.array1d[int]
    code: wp.array1d[wp.uint8]
    term: wp.array1d[float]
    value: wp.array1d[float]
    used: wp.array1d[int]
    wind: wp.array1d[wp.vec3]
    faces: int


@dataclass(frozen=True)
class LinkKernels:
    """Kernels for one lattice and storage type, with one thread per link: `values` computes the value of each link (its
    number of threads is a multiple of `BLOCK`, as that of `bounce`), then `write` writes these into the populations;
    `force` sums the force of the fluid on each body. `bounce` has one thread per cell of a body's window."""

    values: wp.Kernel
    write: wp.Kernel
    force: wp.Kernel
    bounce: wp.Kernel


@wp.func
def _beyond(x: int, n: int, bounded: int) -> bool:
    return bounded != 0 and (x < 0 or x >= n)


@wp.func
def mirrored(t: Tables, n: wp.vec3i, bounded: wp.vec3i, i: int, q: int):
    """Returns the cell and the velocity of the population that a slip wall reflects into population q of cell i."""
    p = cell_of(n, i)
    c = t.c[q]
    x = _beyond(p[0] - c[0], n[0], bounded[0])
    y = _beyond(p[1] - c[1], n[1], bounded[1])
    z = _beyond(p[2] - c[2], n[2], bounded[2])
    along = wp.vec3i(wp.where(x, 0, c[0]), wp.where(y, 0, c[1]), wp.where(z, 0, c[2]))
    turned = wp.vec3i(wp.where(x, -c[0], c[0]), wp.where(y, -c[1], c[1]), wp.where(z, -c[2], c[2]))
    return index_of(n, wrapped(n, p - along)), turned


@functools.cache
def link_kernels(
    lattice_name: str, storage: str, balance: bool, wide: bool = True, in_place: bool = False
) -> LinkKernels:
    """Builds (once) the kernels of boundaries and forces; `balance`: outlets conserve mass; see `memory_functions`."""
    memory = memory_functions(lattice_name, storage, (True, True, True), wide, in_place)
    departed, load, store, moments = memory.departed, memory.load, memory.store, memory.moments
    element, arriving, leaving = memory.element, memory.arriving, memory.leaving
    stored = STORAGES[storage][0]
    c, w = velocity_set(lattice_name).c, velocity_set(lattice_name).w
    count, options = len(c), {"enable_backward": False, "max_unroll": 32}

    @wp.func
    def moments_at(f: wp.array2d[stored], at: Layout, i: int):
        return moments(departed(f, at.n, at.walled, i, at.parity))

    @wp.func
    def outflow(t: Tables, at: Layout, f: wp.array2d[stored], i: int, q: int, kind: int, term: float) -> float:
        drho, j, _diagonal, _off = moments_at(f, at, i)
        u = j / (1.0 + drho)
        source = cell_of(at.n, i) - t.c[q]
        hold = float(1.0)
        for a in range(3):
            if at.bounded[a] != 0:
                if source[a] < 0:
                    u[a] = wp.min(u[a], 0.0)
                    hold = wp.min(hold, HOLD / float(at.n[a]))
                if source[a] >= at.n[a]:
                    u[a] = wp.max(u[a], 0.0)
                    hold = wp.min(hold, HOLD / float(at.n[a]))
        if kind != _OUTLET:
            drho += hold * (term - drho)
        return equilibrium(t.w[q], t.c[q], drho, u)

    @wp.func
    def summed(thread: int, sums: wp.array1d[wp.float64], at: int, values: wp.vec2d):
        # All threads of a block take part in its sums; most terms are 0.
        total = wp.tile_extract(wp.tile_sum(wp.tile(values, preserve_type=True)), 0)
        if thread % wp.block_dim() == 0:
            for k in range(2):
                if total[k] != wp.float64(0.0):
                    wp.atomic_add(sums, at + k, total[k])

    @wp.kernel(module="unique", module_options=options)
    def values(
        # in:
        t: Tables,
        at: Layout,
        first: int,
        last: int,
        slab: int,
        solid: wp.array1d[wp.uint8],
        clock: wp.array1d[int],
        rise: float,
        f: wp.array2d[stored],
        # in, out:
        links: Links,
        # out:
        sums: wp.array1d[wp.float64],
    ):
        link = first + wp.tid()
        net = wp.float64(0.0)
        weight = wp.float64(0.0)
        if link < last:
            i = links.cell[link]
            q = int(links.code[link]) & 31
            kind = int(links.code[link]) >> 5
            # Read before the tests, which would wait for the memory.
            out = load(f, leaving(f, at, i, cell_of(at.n, i), opposite(q), -t.c[q]))
            live = link < links.used[0]
            if solid.shape[0] > 0:
                live = live and solid[i] == wp.uint8(0)
            if live:
                v = float(0.0)
                if kind == _BOUNCE:
                    v = out + links.term[link]
                elif kind == _INLET or kind == _WIND:
                    # The larger of the two is the number of steps done; this value is for the next step.
                    risen = wp.min(1.0, float(wp.max(clock[0], clock[1]) + 1) * rise)
                    term = links.term[link]
                    if kind == _WIND:
                        along = wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))
                        term = 6.0 * t.w[q] * wp.dot(along, links.wind[0])
                    v = out + risen * risen * (3.0 - 2.0 * risen) * term
                elif kind == _SLIP:
                    k, c = mirrored(t, at.n, at.bounded, i, q)
                    # A solid at the mirrored cell bounces the population back.
                    turned = t.index[9 * (c[0] + 1) + 3 * (c[1] + 1) + c[2] + 1]
                    v = load(f, leaving(f, at, k, cell_of(at.n, k), turned, c))
                    if solid.shape[0] > 0:
                        if solid[k] != wp.uint8(0):
                            v = out
                else:
                    v = outflow(t, at, f, i, q, kind, links.term[link])
                links.value[link] = v
                net = wp.float64(v - out)
                if kind == _OUTLET:
                    weight = wp.float64(t.w[q])
        if wp.static(balance):
            summed(wp.tid(), sums, 2 * slab, wp.vec2d(net, weight))

    @wp.kernel(module="unique", module_options=options)
    def write(
        # in:
        t: Tables,
        at: Layout,
        first: int,
        links: Links,
        sums: wp.array1d[wp.float64],
        # out:
        f: wp.array2d[stored],
    ):
        link = first + wp.tid()
        if link >= links.used[0]:
            return
        i = links.cell[link]
        q = int(links.code[link]) & 31
        v = links.value[link]
        if wp.static(balance):
            if int(links.code[link]) >> 5 == _OUTLET:
                net = wp.float64(0.0)
                weight = wp.float64(0.0)
                for k in range(sums.shape[0] // 2):
                    net += sums[2 * k]
                    weight += sums[2 * k + 1]
                if weight > wp.float64(0.0):
                    v -= t.w[q] * float(net / weight)
        store(f, arriving(f, at, i, cell_of(at.n, i), q, t.c[q]), v)

    @wp.kernel(module="unique", module_options=options)
    def force(
        # in:
        t: Tables,
        at: Layout,
        links: Links,
        solid: wp.array1d[wp.uint8],
        f: wp.array2d[stored],
        # out:
        total: wp.array1d[wp.vec3d],
    ):
        link = wp.tid()
        if link >= links.used[0]:
            return
        i = links.cell[link]
        q = int(links.code[link]) & 31
        c = t.c[q]
        p = cell_of(at.n, i)
        k = index_of(at.n, wrapped(at.n, p - c))
        if int(links.code[link]) >> 5 == _SLIP:
            # Where a slip wall cuts a body, the mirror image of this link is a link of the body.
            k, c = mirrored(t, at.n, at.bounded, i, q)
        elif crosses(at.n, at.bounded, p - c):
            return
        if solid[k] == wp.uint8(0) or solid[i] != wp.uint8(0):
            return
        # The element stores the population that came back; the one that went in is that minus the term.
        exchanged = wp.float64(links.term[link] - 2.0 * load(f, arriving(f, at, i, p, q, t.c[q])))
        along = wp.vec3d(wp.float64(c[0]), wp.float64(c[1]), wp.float64(c[2]))
        wp.atomic_add(total, int(solid[k]), exchanged * along)

    @wp.func
    def fill(
        t: Tables,
        at: Layout,
        stamp: wp.uint8,
        solid: wp.array1d[wp.uint8],
        fresh: wp.array1d[wp.uint8],
        i: int,
        f: wp.array2d[stored],
    ):
        p = cell_of(at.n, i)
        total = wp.vec4()
        weight = float(0.0)
        for q in range(1, wp.static(count)):
            beside = p + wp.static(wp.vec3i(*c[q]))
            k = index_of(at.n, wrapped(at.n, beside))
            if not crosses(at.n, at.bounded, beside) and solid[k] == wp.uint8(0) and fresh[k] != stamp:
                drho, j, _diagonal, _off = moments_at(f, at, k)
                inverse = 1.0 / (1.0 + drho)
                total += wp.static(w[q]) * wp.vec4(drho, inverse * j[0], inverse * j[1], inverse * j[2])
                weight += wp.static(w[q])
        if weight > 0.0:
            total = total / weight
        u = wp.vec3(total[1], total[2], total[3])
        for q in range(t.w.shape[0]):
            store(f, leaving(f, at, i, p, q, t.c[q]), equilibrium(t.w[q], t.c[q], total[0], u))

    @wp.kernel(module="unique", module_options=options)
    def bounce(
        # in:
        t: Tables,
        at: Layout,
        window: Window,
        motion: Motion,
        stamp: wp.uint8,
        solid: wp.array1d[wp.uint8],
        fresh: wp.array1d[wp.uint8],
        # in, out:
        f: wp.array2d[stored],
        # out:
        sums: wp.array1d[wp.float64],
    ):
        net = wp.float64(0.0)
        place = window_cell(window, motion.centre[window.body], wp.tid())
        # A window may extend beyond the domain, on a periodic axis by one cell on the other side.
        live = wp.tid() < window.cells[0] * window.cells[1] * window.cells[2]
        for a in range(3):
            live = live and place[a] >= -1 and place[a] <= at.n[a]
        if live and not crosses(at.n, at.bounded, place):
            p = wrapped(at.n, place)
            i = index_of(at.n, p)
            if solid[i] == wp.uint8(0):
                if fresh[i] == stamp:
                    fill(t, at, stamp, solid, fresh, i, f)
                for q in range(1, wp.static(count)):
                    source = p - wp.static(wp.vec3i(*c[q]))
                    k = index_of(at.n, wrapped(at.n, source))
                    if not crosses(at.n, at.bounded, source) and int(solid[k]) == window.body:
                        way = wp.static(wp.vec3(*map(float, c[q])))
                        u = wall_velocity(motion, window.body, centre_of(place) - 0.5 * way)
                        term = wp.static(6.0 * w[q]) * wp.dot(way, u)
                        # What leaves towards the body and what arrives from it are in these two elements.
                        here = element(f, wp.static(OPPOSITE[q]), i)
                        there = element(f, q, k)
                        turned = wp.static(in_place) and at.parity != 0
                        left = wp.where(turned, there, here)
                        store(f, wp.where(turned, here, there), load(f, left) + term)
                        net += wp.float64(term)
        if wp.static(balance):
            summed(wp.tid(), sums, 0, wp.vec2d(net, wp.float64(0.0)))

    return LinkKernels(values, write, force, bounce)


@wp.kernel
def _find(
    # in:
    t: Tables,
    n: wp.vec3i,
    bounded: wp.vec3i,
    solid: wp.array1d[wp.uint8],
    motion: Motion,
    every: bool,
    # in, out:
    links: Links,
    # out:
    count: wp.array1d[int],
):
    i = wp.tid()
    if solid[i] != wp.uint8(0) and (every or motion.moving[int(solid[i])] == wp.uint8(0)):
        return
    p = cell_of(n, i)
    for q in range(1, t.w.shape[0]):
        source = p - t.c[q]
        if not crosses(n, bounded, source):
            k = int(solid[index_of(n, wrapped(n, source))])
            if k > 0 and (every or motion.moving[k] == wp.uint8(0)):
                at = links.faces + wp.atomic_add(count, 0, 1)
                if at < links.cell.shape[0]:
                    links.cell[at] = i
                    links.code[at] = wp.uint8(q)
                    c = wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))
                    u = wall_velocity(motion, k, centre_of(p) - 0.5 * c)
                    links.term[at] = 6.0 * t.w[q] * wp.dot(c, u)


def find_links(
    tables: Tables, n: wp.vec3i, bounded: wp.vec3i, solid: wp.array, motion: Motion, every: bool, links: Links
) -> wp.array:
    """Lists the links of solid cells, in any order, after the links of faces; `links.used` is not changed.

    Bodies that move are left out, as if they were fluid, unless `every` is true. `n` are the cells along x, y and z, N
    in all; `bounded` is 1 for each axis that is not periodic; `solid`, uint8 [N], has the number of the body of each
    cell, 0 for fluid.

    Returns the number of the solids' links, int [1], which may exceed the room in the arrays: the other links are then
    missing.
    """
    count = wp.zeros(1, dtype=int, device=solid.device)
    inputs = [tables, n, bounded, solid, motion, every, links]
    wp.launch(_find, solid.shape[0], inputs=inputs, outputs=[count], device=solid.device)
    return count


def bounce(
    kernels: LinkKernels,
    tables: Tables,
    at: Layout,
    window: Window,
    motion: Motion,
    stamp: int,
    solid: wp.array,
    fresh: wp.array,
    f: wp.array,
    sums: wp.array,
) -> None:
    """Sends populations back from a moving body, after a step and before `apply`; arguments as there and for
    `lattice_bodies.mark`."""
    threads = -(-size_of(window) // BLOCK) * BLOCK
    inputs = [tables, at, window, motion, wp.uint8(stamp), solid, fresh, f]
    wp.launch(kernels.bounce, threads, inputs=inputs, outputs=[sums], block_dim=BLOCK, device=f.device)


def apply(
    kernels: LinkKernels,
    tables: Tables,
    slab: Slab,
    first: int,
    last: int,
    at: Layout,
    links: Links,
    solid: wp.array,
    clock: wp.array,
    rise: float,
    f: wp.array,
    sums: wp.array,
    *,
    writing: bool,
) -> None:
    """Applies the boundary conditions after a step, one pass over the links of a slab.

    Args:
        kernels: Kernels for the lattice and storage type of `f`.
        tables: The velocity set, with Q velocities, on the slab's device.
        slab: The slab, one of P; only its device and its number matter.
        first, last: Its links are those from `first` to `last` - 1.
        at: The domain of N cells, and the layout of `f`.
        links: The links; `value` is modified.
        solid: uint8 [N], number of the body of each cell, or [0] if no cell is solid.
        clock: int [2], see `lattice.step_kernel`.
        rise: Inlets reach their full velocity after 1 / rise steps.
        f: [Q, N], the populations that have just left the cells, modified.
        sums: float64 [2 P], 0 before the first pass; receives the net mass that the links of each slab add before the
            outlets' shift, and the sum of the weights w_q of its outlet links.
        writing: Whether this is the second pass, which begins after the first of all slabs.
    """
    size, device = last - first, slab.device
    if size <= 0:
        return
    if writing:
        wp.launch(kernels.write, size, inputs=[tables, at, first, links, sums], outputs=[f], device=device)
        return
    threads = -(-size // BLOCK) * BLOCK
    inputs = [tables, at, first, last, slab.number, solid, clock, rise, f, links]
    wp.launch(kernels.values, threads, inputs=inputs, outputs=[sums], block_dim=BLOCK, device=device)
