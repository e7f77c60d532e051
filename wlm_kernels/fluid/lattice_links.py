"""What comes back from walls, and in through inlets and outlets, on a lattice.

A link is a fluid cell a and a direction q in which something comes to it from beyond a face of the domain or out of a
solid. (Axes that walls at rest close have none: ``lattice`` sees to those.) The place that a pulls it from, population
q of the cell at a - c_q seen as periodic, is read by a alone. So after every step the links' values are computed from
what has just left the cells, and then put into those places: two passes, since the place of one link may hold what
another reads.

- bounce: f_q = f*_opposite + term, half-way bounce-back; the term 6 w (c . u) carries a wall's velocity at density 1.
- inlet: the same, so that it lets in just u of mass a cell; its term may rise from 0 in the first steps.
- slip: the mirror image of what leaves the neighbour, a wall without friction.
- outlet: the equilibrium of the cell's own density and velocity, no gradient; what it takes is then shifted, alike at
  all outlets, so that as much leaves through them as comes in elsewhere: mass is conserved to rounding.
- pressure: the same, with the density drawn towards a given one, whose deviation from 1 is the term.

Flow that would come in through an outlet is stopped at it: it would feed on itself.

    cell  int [L]        a
    code  uint8 [L]      q + 32 kind
    term  float [L]      see above
    value float [L]      between the passes
"""

import functools
from dataclasses import dataclass

import warp as wp

from wlm_kernels.fluid.lattice_sets import (
    STORAGES,
    Tables,
    brick_of,
    cell_of,
    crosses,
    equilibrium,
    index_of,
    memory_functions,
    opposite,
    wrapped,
)

__all__ = ["BLOCK", "BOUNCE", "INLET", "OUTLET", "PRESSURE", "SLIP", "LinkKernels", "apply", "link_kernels", "pin"]

wp.set_module_options({"enable_backward": False})

BOUNCE, SLIP, OUTLET, PRESSURE, INLET = range(5)
_BOUNCE, _SLIP, _OUTLET, _INLET = (wp.constant(kind) for kind in (BOUNCE, SLIP, OUTLET, INLET))

BLOCK = 256

# A density that is held at once throws all sound back. Drawn to its value at this rate over the crossing of the
# domain (0.25 to 0.6 in the literature, Poinsot and Lele 1992), it lets most of it out and still keeps its mean.
_HOLD = wp.constant(0.3)


@dataclass(frozen=True)
class LinkKernels:
    """Of one lattice and storage.

    Attributes:
        values: First pass, over the links, rounded up to ``BLOCK``.
        places: Second pass, over the links.
        force: What the fluid does to each body, over the links.
    """

    values: wp.Kernel
    places: wp.Kernel
    force: wp.Kernel


@wp.func
def _beyond(x: int, n: int, bounded: int) -> bool:
    return bounded != 0 and (x < 0 or x >= n)


@functools.cache
def link_kernels(lattice_name: str, storage: str, balance: bool) -> LinkKernels:
    """Builds (once) the kernels of a lattice and a storage; ``balance``: whether there is an outlet."""
    memory = memory_functions(lattice_name, storage, (False, False, False))
    load, store = memory.load, memory.store
    stored = STORAGES[storage][0]
    options = {"enable_backward": False}

    @wp.func
    def mirrored(t: Tables, n: wp.vec3i, bounded: wp.vec3i, i: int, q: int):
        """Whose image sends to cell i in direction q, where a wall slips, and in which direction it does itself."""
        p = cell_of(n, i)
        c = t.c[q]
        x = _beyond(p[0] - c[0], n[0], bounded[0])
        y = _beyond(p[1] - c[1], n[1], bounded[1])
        z = _beyond(p[2] - c[2], n[2], bounded[2])
        along = wp.vec3i(wp.where(x, 0, c[0]), wp.where(y, 0, c[1]), wp.where(z, 0, c[2]))
        turned = wp.vec3i(wp.where(x, -c[0], c[0]), wp.where(y, -c[1], c[1]), wp.where(z, -c[2], c[2]))
        return index_of(n, wrapped(n, p - along)), turned

    @wp.func
    def let_out(
        t: Tables, n: wp.vec3i, bounded: wp.vec3i, f: wp.array2d[stored], i: int, q: int, kind: int, term: float
    ) -> float:
        """What an outlet sends to cell i in direction q."""
        drho = float(0.0)
        j = wp.vec3()
        for k in range(t.w.shape[0]):
            g = load(f, k, i)
            drho += g
            j += g * wp.vec3(float(t.c[k][0]), float(t.c[k][1]), float(t.c[k][2]))
        u = j / (1.0 + drho)
        source = cell_of(n, i) - t.c[q]
        hold = float(1.0)
        for a in range(3):
            if bounded[a] != 0:
                if source[a] < 0:
                    u[a] = wp.min(u[a], 0.0)
                    hold = wp.min(hold, _HOLD / float(n[a]))
                if source[a] >= n[a]:
                    u[a] = wp.max(u[a], 0.0)
                    hold = wp.min(hold, _HOLD / float(n[a]))
        if kind != _OUTLET:
            drho += hold * (term - drho)
        return equilibrium(t.w[q], t.c[q], drho, u)

    @wp.kernel(module="unique", module_options=options)
    def values(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        first: int,
        last: wp.array1d[int],
        solid: wp.array1d[wp.uint8],
        cell: wp.array1d[int],
        code: wp.array1d[wp.uint8],
        term: wp.array1d[float],
        clock: wp.array1d[int],
        rise: float,
        f: wp.array2d[stored],
        # out:
        value: wp.array1d[float],
        sums: wp.array1d[wp.float64],
    ):
        at = first + wp.tid()
        net = wp.float64(0.0)
        weight = wp.float64(0.0)
        live = at < last[0]
        if live:
            i = cell[at]
            q = int(code[at]) & 31
            kind = int(code[at]) >> 5
            if solid.shape[0] > 0:
                live = solid[i] == wp.uint8(0)
            if live:
                out = load(f, opposite(q), i)
                v = float(0.0)
                if kind == _BOUNCE:
                    v = out + term[at]
                elif kind == _INLET:
                    # Of the two numbers the larger counts the steps done; this is for the next.
                    gone = wp.min(1.0, float(wp.max(clock[0], clock[1]) + 1) * rise)
                    v = out + gone * gone * (3.0 - 2.0 * gone) * term[at]
                elif kind == _SLIP:
                    k, c = mirrored(t, n, bounded, i, q)
                    # The image of a solid bounces back.
                    v = load(f, t.index[9 * (c[0] + 1) + 3 * (c[1] + 1) + c[2] + 1], k)
                    if solid.shape[0] > 0:
                        if solid[k] != wp.uint8(0):
                            v = out
                else:
                    v = let_out(t, n, bounded, f, i, q, kind, term[at])
                value[at] = v
                net = wp.float64(v - out)
                if kind == _OUTLET:
                    weight = wp.float64(t.w[q])
        if wp.static(balance):
            # Every thread of the block takes part in the sums, and of most blocks they are 0.
            block_net = wp.tile_extract(wp.tile_sum(wp.tile(net)), 0)
            block_weight = wp.tile_extract(wp.tile_sum(wp.tile(weight)), 0)
            if wp.tid() % wp.block_dim() == 0:
                if block_net != wp.float64(0.0):
                    wp.atomic_add(sums, 0, block_net)
                if block_weight != wp.float64(0.0):
                    wp.atomic_add(sums, 1, block_weight)

    @wp.kernel(module="unique", module_options=options)
    def places(
        # in:
        t: Tables,
        n: wp.vec3i,
        first: int,
        last: wp.array1d[int],
        cell: wp.array1d[int],
        code: wp.array1d[wp.uint8],
        value: wp.array1d[float],
        sums: wp.array1d[wp.float64],
        # out:
        f: wp.array2d[stored],
    ):
        at = first + wp.tid()
        if at >= last[0]:
            return
        i = cell[at]
        q = int(code[at]) & 31
        v = value[at]
        if wp.static(balance):
            if int(code[at]) >> 5 == _OUTLET and sums[1] > wp.float64(0.0):
                v -= t.w[q] * float(sums[0] / sums[1])
        store(f, q, index_of(n, wrapped(n, cell_of(n, i) - t.c[q])), v)

    @wp.kernel(module="unique", module_options=options)
    def force(
        # in:
        t: Tables,
        n: wp.vec3i,
        bounded: wp.vec3i,
        last: wp.array1d[int],
        solid: wp.array1d[wp.uint8],
        cell: wp.array1d[int],
        code: wp.array1d[wp.uint8],
        term: wp.array1d[float],
        f: wp.array2d[stored],
        # out:
        total: wp.array1d[wp.vec3d],
    ):
        at = wp.tid()
        if at >= last[0]:
            return
        i = cell[at]
        q = int(code[at]) & 31
        c = t.c[q]
        place = index_of(n, wrapped(n, cell_of(n, i) - c))
        k = int(place)
        if int(code[at]) >> 5 == _SLIP:
            # Where such a wall cuts a body, the image of this link is one of the body's.
            k, c = mirrored(t, n, bounded, i, q)
        elif crosses(n, bounded, cell_of(n, i) - c):
            return
        if solid[k] == wp.uint8(0) or solid[i] != wp.uint8(0):
            return
        # The place holds what came back; what went in is that less the term, and both push the same way.
        exchanged = wp.float64(term[at] - 2.0 * load(f, q, place))
        along = wp.vec3d(wp.float64(c[0]), wp.float64(c[1]), wp.float64(c[2]))
        wp.atomic_add(total, int(solid[k]), exchanged * along)

    return LinkKernels(values, places, force)


@wp.kernel
def _pin(
    # in:
    n: wp.vec3i,
    brick: wp.vec3i,
    last: wp.array1d[int],
    cell: wp.array1d[int],
    code: wp.array1d[wp.uint8],
    term: wp.array1d[float],
    # out:
    pinned: wp.array1d[int],
):
    at = wp.tid()
    if at < last[0]:
        if term[at] != 0.0 or int(code[at]) >> 5 == _OUTLET:
            pinned[brick_of(n, brick, cell_of(n, cell[at]))] = 1


def apply(
    kernels: LinkKernels,
    tables,
    n,
    bounded,
    first: int,
    links,
    solid,
    clock,
    rise: float,
    f,
    sums,
) -> None:
    """Both passes over the links from place ``first`` on.

    Args:
        kernels: Of the lattice and storage of ``f``.
        tables: ``lattice_sets.Tables``.
        n: Cells along x, y and z.
        bounded: vec3i, 1 for each axis that isn't periodic.
        first: 0, or the first link of a solid.
        links: Has ``cell``, ``code``, ``term`` and ``value`` [L] and ``last`` int [1], how many are in use.
        solid: uint8 [N], or [0] if no cell is solid.
        clock: int [2], see ``lattice.step_kernel``.
        rise: Inlets are at their full velocity after 1 / rise steps.
        f: [Q, N], what has just left the cells.
        sums: float64 [2], what all links take in without the shift and the weight of the outlets; 0 before.
    """
    size, device = links.cell.shape[0] - first, f.device
    if size <= 0:
        return
    inputs = [tables, n, bounded, first, links.last, solid, links.cell, links.code, links.term]
    inputs += [clock, rise, f]
    threads = -(-size // BLOCK) * BLOCK
    outputs = [links.value, sums]
    wp.launch(kernels.values, threads, inputs=inputs, outputs=outputs, block_dim=BLOCK, device=device)
    inputs = [tables, n, first, links.last, links.cell, links.code, links.value, sums]
    wp.launch(kernels.places, size, inputs=inputs, outputs=[f], device=device)


def pin(n, brick, links, pinned) -> None:
    """Marks the bricks in which a link moves fluid that is at rest.

    Args:
        n, brick: Cells of the domain and of a brick.
        links: As for ``apply``.
        pinned: int [bricks], set to 1 where that is so.
    """
    inputs = [n, brick, links.last, links.cell, links.code, links.term]
    if links.cell.shape[0] > 0:
        wp.launch(_pin, links.cell.shape[0], inputs=inputs, outputs=[pinned], device=pinned.device)
