"""The lattice Boltzmann step in 16 bits on a GPU: each thread does two cells that are neighbours along z.

`lattice.step_kernel` does the same cell by cell, with the same results, and is what a CPU runs. Here two populations
share a load, a conversion and a store of 32 bits. In a far step populations along z lie one cell beside these pairs:
threads pass halves of pairs to their neighbours in the warp, and only those at its ends, or at the ends of a row of
cells, load and store single halves.
"""

import functools

import warp as wp

from wlm_kernels.fluid.lattice import OPTIONS, Spec, collision, mirror_tables
from wlm_kernels.fluid.lattice_links import SOLID, Boundaries, is_link, word_of
from wlm_kernels.fluid.lattice_sets import cell_of, lattice, memory_functions

BLOCK = 128

_LOW = wp.constant(wp.uint32(0xFFFF))
_HALF = wp.constant(wp.uint32(16))

_POKE = """
    if (first && second) *reinterpret_cast<unsigned*>(f.data + k) = pair;
    else if (first) *reinterpret_cast<unsigned short*>(f.data + k) = (unsigned short)pair;
    else if (second) *reinterpret_cast<unsigned short*>(f.data + k + 1) = (unsigned short)(pair >> 16);
"""


@wp.func_native("""
    float x;
    asm("{.reg .b16 l, h; mov.b32 {l, h}, %1; cvt.f32.f16 %0, l;}" : "=f"(x) : "r"(pair));
    return x;
""")
def _first(pair: wp.uint32) -> float: ...


@wp.func_native("""
    float x;
    asm("{.reg .b16 l, h; mov.b32 {l, h}, %1; cvt.f32.f16 %0, h;}" : "=f"(x) : "r"(pair));
    return x;
""")
def _second(pair: wp.uint32) -> float: ...


@wp.func_native("""
    unsigned pair;
    asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(pair) : "f"(second), "f"(first));
    return pair;
""")
def _pack(first: float, second: float) -> wp.uint32: ...


@wp.func_native("return __shfl_up_sync(0xffffffff, value, 1);")
def _before(value: wp.uint32) -> wp.uint32: ...


@wp.func_native("return __shfl_down_sync(0xffffffff, value, 1);")
def _after(value: wp.uint32) -> wp.uint32: ...


@functools.cache
def pair_kernel(spec: Spec, far: bool) -> wp.Kernel:
    """Builds (once) the kernel of a step in place with the settings of a spec, far or at home, see `lattice_links`.

    The storage is float16, and the number of cells along z even. Threads are in whole warps: one for every two cells,
    and more up to a multiple of 32. Arguments are those of the kernel of `lattice.step_kernel`, without the last.
    """
    memory, c = memory_functions(spec.lattice, spec.storage, spec.wide), lattice(spec.lattice).c
    collide = collision(spec)
    element, index, vec, count = memory.element, memory.index, memory.vec, len(c)
    indices, words = wp.types.vector(count, index), wp.types.vector(count, wp.uint32)
    rows, signs = mirror_tables(spec.lattice)

    @wp.func_native("return *reinterpret_cast<const unsigned*>(f.data + k);")
    def peek_pair(f: wp.array2d[wp.float16], k: index) -> wp.uint32: ...

    @wp.func_native("return loads ? *reinterpret_cast<const unsigned short*>(f.data + k) : 0u;")
    def peek_if(f: wp.array2d[wp.float16], k: index, loads: bool) -> wp.uint32: ...

    @wp.func_native(_POKE)
    def poke(f: wp.array2d[wp.float16], k: index, pair: wp.uint32, first: bool, second: bool): ...

    @wp.func
    def takes(word: wp.uint32, q: int) -> bool:
        """Tests whether a cell of this word reads and writes population q like a cell inside."""
        return (word & (SOLID | (wp.uint32(1) << wp.uint32(q)))) == wp.uint32(0)

    @wp.kernel(module="unique", module_options=OPTIONS)
    def step(
        # in:
        b: Boundaries,
        f: wp.array2d[wp.float16],
        tau: float,
        eddy: float,
        forces: wp.array1d[wp.vec3],
        parity: int,
        # out:
        clock: wp.array1d[int],
        trouble: wp.array1d[wp.int64],
    ):
        thread = wp.tid()
        lane = thread % 32
        done = clock[parity]
        if thread == 0:
            clock[1 - parity] = done + 1
            b.net[0] = wp.int64(0)
        n = b.n
        i = wp.min(2 * thread, f.shape[1] - 2)
        p = cell_of(n, i)
        down = wp.vec3i()
        up = wp.vec3i()
        low = int(0)
        high = int(0)
        for a in range(2):
            down[a] = wp.where(p[a] == 0, n[a], p[a]) - 1
            up[a] = wp.where(p[a] == n[a] - 1, 0, p[a] + 1)
            if wp.static(spec.slips):
                if b.bounded[a] != 0 and p[a] == 0:
                    down[a] = 0
                    low = low | wp.static(1 << a)
                if b.bounded[a] != 0 and p[a] == n[a] - 1:
                    up[a] = p[a]
                    high = high | wp.static(1 << a)
        x = wp.vec3i(down[0], p[0], up[0])
        y = wp.vec3i(down[1], p[1], up[1])
        row_begins = p[2] == 0
        row_ends = p[2] + 2 == n[2]
        begins = row_begins or lane == 0
        ends = row_ends or lane == 31
        z_before = wp.where(row_begins, n[2], p[2]) - 1
        z_after = wp.where(row_ends, 0, p[2] + 2)
        # Slip walls at the ends of a row mirror populations along z, too.
        mirror_before = int(0)
        mirror_after = int(0)
        if wp.static(spec.slips):
            if b.bounded[2] != 0 and row_begins:
                mirror_before = 4
                z_before = 0
            if b.bounded[2] != 0 and row_ends:
                mirror_after = 4
                z_after = n[2] - 1

        # The elements of a far step: that of the pair there, and that of the half beside it. All are loaded at once.
        at = indices()
        beside = indices()
        pairs = words()
        halves = words()
        for q in range(wp.static(count)):
            at[q] = element(f, wp.static(q), i)
            if wp.static(far and q > 0):
                line = (x[wp.static(1 - c[q][0])] * n[1] + y[wp.static(1 - c[q][1])]) * n[2]
                row = int(wp.static(rows[q][0]))
                edge_row = int(wp.static(rows[q][0]))
                if wp.static(spec.slips):
                    crossed = (low & wp.static(signs[q][0])) | (high & wp.static(signs[q][1]))
                    edge = crossed | wp.where(wp.static(c[q][2] > 0), mirror_before, mirror_after)
                    for m in range(1, 8):
                        if wp.static(m & ~(signs[q][0] | signs[q][1]) == 0):
                            if wp.static(m < 4):
                                row = wp.where(crossed == wp.static(m), wp.static(rows[q][m]), row)
                            edge_row = wp.where(edge == wp.static(m), wp.static(rows[q][m]), edge_row)
                at[q] = element(f, row, line + p[2])
                if wp.static(c[q][2] > 0):
                    beside[q] = element(f, edge_row, line + z_before)
                    halves[q] = peek_if(f, beside[q], begins)
                if wp.static(c[q][2] < 0):
                    beside[q] = element(f, edge_row, line + z_after)
                    halves[q] = peek_if(f, beside[q], ends)
            pairs[q] = peek_pair(f, at[q])
        word = wp.uint32(0)
        word2 = wp.uint32(0)
        if wp.static(spec.bounded):
            word = word_of(b, i)
            word2 = word_of(b, i + 1)
        if 2 * thread >= f.shape[1]:
            word = SOLID
            word2 = SOLID
        # The words of the cells before and after the pair.
        word_before = _before(word2)
        word_after = _after(word)
        g = vec()
        g2 = vec()
        for q in range(wp.static(count)):
            pair = pairs[q]
            if wp.static(far and c[q][2] > 0):
                other = _before(pair) >> _HALF
                if begins:
                    other = halves[q]
                pair = other | (pair << _HALF)
            if wp.static(far and c[q][2] < 0):
                other = _after(pair)
                if ends:
                    other = halves[q]
                pair = (pair >> _HALF) | (other << _HALF)
            if wp.static(far and q > 0 and spec.bounded):
                if is_link(word | word2, wp.static(q)):
                    own = peek_pair(f, element(f, wp.static(q), i))
                    if is_link(word, wp.static(q)):
                        pair = (pair & ~_LOW) | (own & _LOW)
                    if is_link(word2, wp.static(q)):
                        pair = (pair & _LOW) | (own & ~_LOW)
            g[q] = _first(pair)
            g2[q] = _second(pair)
        left = vec()
        left2 = vec()
        if (word & SOLID) == wp.uint32(0):
            left = collide(g, i, tau, eddy, forces, done, trouble)
        if (word2 & SOLID) == wp.uint32(0):
            left2 = collide(g2, i + 1, tau, eddy, forces, done, trouble)
        for q in range(wp.static(count)):
            back = wp.static(((q - 1) ^ 1) + 1 if q else 0)
            pair = _pack(left[back], left2[back])
            takes_first = takes(word, wp.static(q))
            takes_second = takes(word2, wp.static(q))
            if wp.static(far and q > 0):
                if wp.static(c[q][2] == 0):
                    poke(f, at[q], pair, takes_first, takes_second)
                if wp.static(c[q][2] > 0):
                    both = (pair >> _HALF) | (_after(pair) << _HALF)
                    poke(f, at[q], both, takes_second, not ends and takes(word_after, wp.static(q)))
                    if begins and takes_first:
                        poke(f, beside[q], pair, True, False)
                if wp.static(c[q][2] < 0):
                    both = (_before(pair) >> _HALF) | (pair << _HALF)
                    poke(f, at[q], both, not begins and takes(word_before, wp.static(q)), takes_first)
                    if ends and takes_second:
                        poke(f, beside[q], pair >> _HALF, True, False)
                if wp.static(spec.bounded):
                    if is_link(word | word2, wp.static(q)):
                        home = element(f, wp.static(q), i)
                        poke(f, home, pair, is_link(word, wp.static(q)), is_link(word2, wp.static(q)))
            else:
                solid = (word & SOLID) != wp.uint32(0)
                solid2 = (word2 & SOLID) != wp.uint32(0)
                poke(f, at[q], pair, not solid, not solid2)

    return step
