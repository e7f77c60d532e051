"""Boundary conditions of the lattice: walls, inlets, outlets and solid bodies; where populations are stored.

Read `tests/reference/lattice.py` first: `stream` there has the same conditions in float64 NumPy, link by link.

**Storage.** Steps work in place, in the AA pattern (Bailey et al. 2009, "Accelerating lattice Boltzmann fluid flow
simulations using graphics processors"). After an even number of steps the array is *at home*: row q, cell i has the
population that left cell i along the opposite of c_q. The next step is *far*: for each q a cell reads the population
that arrives along c_q from row opposite(q) of the cell it left, and writes into the same element the population that
leaves it for that cell. Row q, cell i then has the population that arrives at cell i along c_q. The step after that
reads and writes only elements of its own cell, and the array is at home again. No element is touched by two cells in a
step.

**Links.** A link is a fluid cell and a direction q from which a population arrives from beyond a face of the domain or
out of a solid. Its element is row q of its own cell in both kinds of steps, so that the population that the cell sent
into the boundary comes back (half-way bounce-back). What a condition adds to it is added when it is read:

- bounce: 6 w_q c_q . u at a wall or a body with the velocity u.
- inlet: the same; it adds a mass of u per cell of the face. The term may rise from 0 in the first steps.
- slip: a wall without friction: the mirror image of the population that leaves the neighbouring cell. Such a link is no
  link in this sense: its element is that of the mirrored neighbour, in the same way as that of a cell inside.
- outlet: the equilibrium at the cell's own density and velocity (zero gradient), which the cell writes into the
  element instead of the population that leaves. When it is read it is shifted, by w_q times the same factor at all
  outlets, so that outflow equals inflow: mass is conserved to rounding.
- pressure: the outlet without the shift; its density relaxes towards a given density.

Velocities into the domain are set to 0 at an outlet: backflow would feed on itself.
"""

import warp as wp

from wlm_kernels.fluid.lattice_sets import Tables, cell_of, equilibrium, index_of, wrapped

wp.set_module_options({"enable_backward": False})

BOUNCE, SLIP, OUTLET, PRESSURE, INLET = range(5)
_BOUNCE, _SLIP, _OUTLET, _PRESSURE, _INLET = (wp.constant(kind) for kind in (BOUNCE, SLIP, OUTLET, PRESSURE, INLET))

BLOCK = 256

# Bit q of a cell's word, 1 to 26, says that direction q is a link (but not that of a slip wall).
SOLID, TERMS, OUTFLOW = (wp.constant(wp.uint32(1 << bit)) for bit in (31, 30, 29))
"""Bits of a cell's word: it is solid; links of it add a term; links of it are outlets."""

FIXED = wp.constant(wp.float64(2.0**40))
"""Sums over links are integers, in units of 1 / FIXED, so that they do not depend on the order."""

# An outlet of fixed density reflects all sound. Relaxed at this rate per crossing of the domain (0.25 to 0.6 in the
# literature, Poinsot and Lele 1992), it transmits most of the sound and still keeps the mean density.
HOLD = wp.constant(0.3)

_NO_FACE = wp.constant(255)
_WORD = wp.constant(32)


@wp.struct
class Boundaries:
    """The boundaries of a domain of N cells, on a device.

    `n` are the cells along x, y and z; `bounded` is 1 for each axis that is not periodic; `rise` is 1 over the number
    of steps in which inlets rise to their velocity.

    Cells of faces are numbered face by face, from `first`, int [6], on, on a face by its two axes in the order x, y, z;
    `rank` and `kind`, uint8, and `velocity`, vec3, are as in `wlm.fluid.faces.Face`; `excess`, float [6], is the
    density minus 1 to which the outlets of a face relax.

    `solid`, uint8 [N] or [0], is the number of the body of each cell; `bodies`, vec3 [3, 256], are velocities,
    angular velocities and centres of the bodies.

    `words`, uint32 [N], have bits for each cell, see the module, and `busy`, uint32 [ceil(N / 32)], has one for each
    cell whose word is not 0; [0] where there are neither faces nor solids. `net`, int64 [1], is the mass that the
    outlets of the last step add; `fixed`, int64 [3], that which walls and bodies add, that which inlets add, and the
    sum of the weights of outlets.
    """

    n: wp.vec3i
    bounded: wp.vec3i
    rise: float
    first: wp.array1d[int]
    rank: wp.array1d[wp.uint8]
    kind: wp.array1d[wp.uint8]
    velocity: wp.array1d[wp.vec3]
    excess: wp.array1d[float]
    solid: wp.array1d[wp.uint8]
    bodies: wp.array2d[wp.vec3]
    words: wp.array1d[wp.uint32]
    busy: wp.array1d[wp.uint32]
    net: wp.array1d[wp.int64]
    fixed: wp.array1d[wp.int64]


@wp.func
def is_solid(b: Boundaries, i: int) -> bool:
    if b.solid.shape[0] == 0:
        return False
    return b.solid[i] != wp.uint8(0)


@wp.func
def word_of(b: Boundaries, i: int) -> wp.uint32:
    """Returns the word of a cell; most cells have none, and groups of 32 cells without are seen in one number."""
    if b.busy.shape[0] == 0:
        return wp.uint32(0)
    if b.busy[i // _WORD] == wp.uint32(0):
        return wp.uint32(0)
    return b.words[i]


@wp.func
def is_link(word: wp.uint32, q: int) -> bool:
    return ((word >> wp.uint32(q)) & wp.uint32(1)) != wp.uint32(0)


@wp.func
def along(t: Tables, q: int) -> wp.vec3:
    return wp.vec3(float(t.c[q][0]), float(t.c[q][1]), float(t.c[q][2]))


@wp.func
def body_velocity(b: Boundaries, body: int, x: wp.vec3) -> wp.vec3:
    """Returns the velocity of a body at a point, in cells per step."""
    return b.bodies[0, body] + wp.cross(b.bodies[1, body], x - b.bodies[2, body])


@wp.func
def centre_of(p: wp.vec3i) -> wp.vec3:
    return wp.vec3(float(p[0]) + 0.5, float(p[1]) + 0.5, float(p[2]) + 0.5)


@wp.func
def beyond(x: int, n: int, bounded: int) -> bool:
    return bounded != 0 and (x < 0 or x >= n)


@wp.func
def mirrored(t: Tables, b: Boundaries, p: wp.vec3i, q: int):
    """Returns the cell, and the row in a far step, from which population q of the cell at p comes if no link is there:
    from within the domain, or mirrored by slip walls."""
    c = t.c[q]
    source = p - c
    for a in range(3):
        if beyond(source[a], b.n[a], b.bounded[a]):
            source[a] = p[a]
            c[a] = -c[a]
    return index_of(b.n, wrapped(b.n, source)), t.index[9 * (1 - c[0]) + 3 * (1 - c[1]) + 1 - c[2]]


@wp.func
def element_of(t: Tables, b: Boundaries, word: wp.uint32, p: wp.vec3i, i: int, q: int, far: int):
    """Returns the cell and the row from which cell i, at p, reads population q in the next step, far or not, and to
    which it wrote the population that left it along the opposite direction if the last step was the other kind."""
    if far == 0 or is_link(word, q):
        return i, q
    cell, row = mirrored(t, b, p, q)
    return cell, row


@wp.func
def face_cell(b: Boundaries, p: wp.vec3i, source: wp.vec3i):
    """Returns the face beyond which `source`, a neighbour of the cell at p, lies, and the number of its cell there: of
    several faces that of the lowest rank; -1 without."""
    rank = int(_NO_FACE)
    number = int(-1)
    cell = int(0)
    for a in range(3):
        if beyond(source[a], b.n[a], b.bounded[a]):
            face = 2 * a
            if source[a] >= 0:
                face = 2 * a + 1
            row = wp.where(a == 0, p[1], p[0])
            k = b.first[face] + row * wp.where(a == 2, b.n[1], b.n[2]) + wp.where(a == 2, p[1], p[2])
            if int(b.rank[k]) < rank:
                rank = int(b.rank[k])
                number = face
                cell = k
    return number, cell


@wp.func
def condition(t: Tables, b: Boundaries, p: wp.vec3i, q: int):
    """Returns what sends population q into the cell at p: a kind of boundary, or -1; and a number: the term of a wall,
    a body or an inlet at its full velocity, or the density minus 1 of an outlet."""
    source = p - t.c[q]
    face, cell = face_cell(b, p, source)
    kind = int(-1)
    term = float(0.0)
    if face >= 0:
        kind = int(b.kind[cell])
        if kind == _SLIP:
            k, _row = mirrored(t, b, p, q)
            if is_solid(b, k):
                kind = _BOUNCE
        elif kind == _OUTLET or kind == _PRESSURE:
            term = b.excess[face]
        else:
            term = 6.0 * t.w[q] * wp.dot(along(t, q), b.velocity[cell])
    elif b.solid.shape[0] > 0:
        body = int(b.solid[index_of(b.n, wrapped(b.n, source))])
        if body > 0:
            kind = _BOUNCE
            u = body_velocity(b, body, centre_of(p) - 0.5 * along(t, q))
            term = 6.0 * t.w[q] * wp.dot(along(t, q), u)
    return kind, term


@wp.func
def body_behind(t: Tables, b: Boundaries, p: wp.vec3i, q: int):
    """Returns the body that sends population q back into the cell at p, or 0; and the direction away from it, which is
    not c_q where a slip wall cuts the body: there the mirror image of the link is one of the body."""
    source = p - t.c[q]
    c = along(t, q)
    face, cell = face_cell(b, p, source)
    k = index_of(b.n, wrapped(b.n, source))
    if face >= 0:
        if int(b.kind[cell]) != _SLIP:
            return 0, wp.vec3d()
        k, _row = mirrored(t, b, p, q)
        for a in range(3):
            if beyond(source[a], b.n[a], b.bounded[a]):
                c[a] = -c[a]
    return int(b.solid[k]), wp.vec3d(wp.float64(c[0]), wp.float64(c[1]), wp.float64(c[2]))


@wp.func
def risen(b: Boundaries, done: int) -> float:
    """Returns the share of their velocity that inlets have in the step after `done` steps."""
    x = wp.min(1.0, float(done + 1) * b.rise)
    return x * x * (3.0 - 2.0 * x)


# One atomic sum for a warp, where all of its threads add.
@wp.func_native("""
#ifdef __CUDA_ARCH__
    bool whole = __activemask() == 0xffffffff;
    if (whole) for (int lanes = 16; lanes > 0; lanes /= 2) value += __shfl_xor_sync(0xffffffff, value, lanes);
    if (!whole || threadIdx.x % 32 == 0) atomicAdd((unsigned long long*)sum.data, (unsigned long long)value);
#else
    sum.data[0] += value;
#endif
""")
def add_up(sum: wp.array1d[wp.int64], value: wp.int64): ...


@wp.func
def face_cell_at(b: Boundaries, k: int) -> int:
    """Returns the cell at cell k of the faces; -1 if the cell is also one of a face before."""
    face = int(0)
    for a in range(1, 6):
        if b.bounded[a // 2] != 0 and k >= b.first[a]:
            face = a
    axis = face // 2
    width = wp.where(axis == 2, b.n[1], b.n[2])
    row = (k - b.first[face]) // width
    column = (k - b.first[face]) % width
    end = wp.where(face % 2 == 0, 0, b.n[axis] - 1)
    p = wp.vec3i(wp.where(axis == 0, end, row), wp.where(axis == 1, end, wp.where(axis == 0, row, column)), column)
    if axis == 2:
        p[2] = end
    for a in range(6):
        if a < face and b.bounded[a // 2] != 0 and p[a // 2] == wp.where(a % 2 == 0, 0, b.n[a // 2] - 1):
            return -1
    return index_of(b.n, p)


@wp.func
def shift(b: Boundaries, word: wp.uint32, done: int) -> float:
    """Returns the shift, over the weight, of what outlets send into a cell in the step after `done` steps."""
    if (word & OUTFLOW) == wp.uint32(0) or b.fixed[2] == wp.int64(0):
        return 0.0
    net = b.net[0] + b.fixed[0]
    inlets = wp.float64(risen(b, done)) * wp.float64(b.fixed[1])
    return float((wp.float64(net) + inlets) / wp.float64(b.fixed[2]))


@wp.func
def term_of(t: Tables, b: Boundaries, p: wp.vec3i, q: int, done: int, shifted: float) -> float:
    """Returns what a link adds to the population that it reads in the step after `done` steps, see `shift`."""
    kind, term = condition(t, b, p, q)
    if kind == _INLET:
        return risen(b, done) * term
    if kind == _OUTLET:
        return -t.w[q] * shifted
    if kind == _BOUNCE:
        return term
    return 0.0


@wp.func
def open_faces(b: Boundaries, source: wp.vec3i, u: wp.vec3):
    """Returns 0 for each axis along which air of velocity u would come in through the faces beyond which `source` lies,
    else 1; and the rate at which an outlet's density relaxes there."""
    passes = wp.vec3(1.0, 1.0, 1.0)
    hold = float(1.0)
    for a in range(3):
        if beyond(source[a], b.n[a], b.bounded[a]):
            hold = wp.min(hold, HOLD / float(b.n[a]))
            if (source[a] < 0 and u[a] > 0.0) or (source[a] >= 0 and u[a] < 0.0):
                passes[a] = 0.0
    return passes, hold


@wp.func
def outflow(t: Tables, b: Boundaries, p: wp.vec3i, q: int, kind: int, excess: float, drho: float, u: wp.vec3) -> float:
    """Returns what an outlet, a condition of kind `kind` and number `excess`, sends back as population q into the cell
    at p, whose fluid leaves with the density 1 + `drho` and the velocity u."""
    passes, hold = open_faces(b, p - t.c[q], u)
    if kind == _PRESSURE:
        drho += hold * (excess - drho)
    return equilibrium(t.w[q], t.c[q], drho, wp.cw_mul(passes, u))


@wp.func
def is_outlet(kind: int) -> bool:
    return kind == _OUTLET or kind == _PRESSURE


@wp.func
def fixed_point(value: float) -> wp.int64:
    return wp.int64(wp.round(wp.float64(value) * FIXED))


# Bits of 32 cells in one number: a warp on a GPU, where all threads of a warp take part; cells in turn on a CPU.
@wp.func_native("""
#ifdef __CUDA_ARCH__
    unsigned bits = __ballot_sync(0xffffffff, set);
    if ((i & 31) == 0) busy.data[i >> 5] = bits;
#else
    if ((i & 31) == 0) busy.data[i >> 5] = 0;
    busy.data[i >> 5] |= (unsigned)set << (i & 31);
#endif
""")
def _set_busy(busy: wp.array1d[wp.uint32], i: int, set: bool): ...


@wp.kernel
def _mark(
    # in:
    t: Tables,
    b: Boundaries,
):
    i = wp.tid()
    word = wp.uint32(0)
    walls = wp.float64(0.0)
    inlets = wp.float64(0.0)
    weights = wp.float64(0.0)
    live = i < b.words.shape[0]
    if live:
        if is_solid(b, i):
            word = SOLID
        else:
            p = cell_of(b.n, i)
            inside = p[0] > 0 and p[1] > 0 and p[2] > 0
            inside = inside and p[0] < b.n[0] - 1 and p[1] < b.n[1] - 1 and p[2] < b.n[2] - 1
            for q in range(1, t.w.shape[0]):
                # Nearly all cells are of fluid between fluid.
                if inside and not is_solid(b, index_of(b.n, p - t.c[q])):
                    continue
                kind, term = condition(t, b, p, q)
                if kind >= 0 and kind != _SLIP:
                    word = word | (wp.uint32(1) << wp.uint32(q))
                    if kind == _BOUNCE:
                        walls += wp.float64(term)
                        if term != 0.0:
                            word = word | TERMS
                    else:
                        word = word | TERMS
                        if kind == _INLET:
                            inlets += wp.float64(term)
                        else:
                            word = word | OUTFLOW
                            if kind == _OUTLET:
                                weights += wp.float64(t.w[q])
        b.words[i] = word
    _set_busy(b.busy, i, word != wp.uint32(0))
    # All threads of a block take part in its sums; most terms are 0.
    total = wp.vec3d(
        wp.tile_extract(wp.tile_sum(wp.tile(walls)), 0),
        wp.tile_extract(wp.tile_sum(wp.tile(inlets)), 0),
        wp.tile_extract(wp.tile_sum(wp.tile(weights)), 0),
    )
    if wp.tid() % wp.block_dim() == 0:
        for k in range(3):
            if total[k] != wp.float64(0.0):
                wp.atomic_add(b.fixed, k, wp.int64(wp.round(total[k] * FIXED)))


def mark(tables: Tables, boundaries: Boundaries) -> None:
    """Writes `words`, `busy` and `fixed` of boundaries from their faces, solids and bodies."""
    boundaries.fixed.zero_()
    threads, device = -(-boundaries.words.shape[0] // BLOCK) * BLOCK, boundaries.words.device
    wp.launch(_mark, threads, inputs=[tables, boundaries], block_dim=BLOCK, device=device)
