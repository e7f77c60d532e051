"""Reading light at any point from nested grids of blocks around a viewer, through a page table.

A block of level l is the cell `[b s, (b + 1) s)` of a grid of cubes of side s_l, named by its integer coordinates b;
its D numbers stand for its centre. Level l keeps the window of `side` blocks along each axis that starts at base_l.
The slot of a block is its coordinates modulo `side`, so that a window that moves by one block changes one slab of
slots (gaussian-probe-compression, section 3.4). The page table has a number for each slot: the row of the pool in
which the numbers of the window's block lie, or -1 where it isn't there.

Arrays: pool float [R, D]; pages int [L * side^3], by slot; bases vec3i [L]; views vec4 [L], where the points' origin
lies in the grid, `origin / s - (base + side / 2 + 1/2)`, and 1 / s. None has a gradient.

The twin to read first: `tests/reference/volume.py`.
"""

import warp as wp

NOTHING = -(2**31)  # each coordinate of the block of a slot that no window has had yet

_AHEAD = wp.constant(0.5)  # sides: how far in front of a surface its light is read
_CHUNK = 4  # numbers that a GPU's thread reads: 16 bytes of a row, and 7 threads for a point of 27

vec8 = wp.types.vector(length=8, dtype=float)
vec8i = wp.types.vector(length=8, dtype=int)


@wp.func
def wrap(i: int, size: int) -> int:
    r = i % size  # takes the sign of i
    return wp.where(r < 0, r + size, r)


@wp.func
def slot_of(level: int, block: wp.vec3i, side: int) -> int:
    return ((level * side + wrap(block[0], side)) * side + wrap(block[1], side)) * side + wrap(block[2], side)


@wp.kernel(enable_backward=False)
def _unscroll(
    # in:
    pool: wp.array2d[float],
    pages: wp.array1d[int],
    bases: wp.array1d[wp.vec3i],
    side: int,
    # out:
    out: wp.array2d[float],
    valid: wp.array1d[wp.uint8],
):
    i, c = wp.tid()
    plane = side * side
    level = i // (plane * side)
    block = bases[level] + wp.vec3i(i // plane % side, i // side % side, i % side)
    row = pages[slot_of(level, block, side)]
    value = float(0.0)
    if row >= 0:
        value = pool[row, c]
    out[i, c] = value
    if c == 0:
        valid[i] = wp.uint8(wp.where(row >= 0, 1, 0))


@wp.kernel(enable_backward=False)
def _read(
    # in:
    pool: wp.array2d[float],
    pages: wp.array1d[int],
    bases: wp.array1d[wp.vec3i],
    views: wp.array1d[wp.vec4],
    side: int,
    points: wp.array1d[wp.vec3],
    normals: wp.array1d[wp.vec3],
    chunk: int,
    # out:
    out: wp.array2d[float],
    answered: wp.array1d[int],
    weight: wp.array1d[float],
):
    i, part = wp.tid()
    p = points[i]
    ahead = wp.vec3()
    if normals.shape[0] > 0:
        ahead = _AHEAD * normals[i]
    start = part * chunk
    stop = wp.min(start + chunk, out.shape[1])
    for c in range(start, stop):
        out[i, c] = 0.0
    left = float(1.0)  # the weight that no level has answered for yet
    covered = float(0.0)
    most = float(0.0)
    by = int(-1)
    edge = 0.5 * float(side)
    for level in range(bases.shape[0]):
        view = views[level]
        x = p[0] * view[3] + view[0] + ahead[0]
        y = p[1] * view[3] + view[1] + ahead[1]
        z = p[2] * view[3] + view[2] + ahead[2]
        # Beyond it no corner is in the window; NaN compares false too, and no float out of range becomes an int.
        near = x >= -edge - 1.0 and y >= -edge - 1.0 and z >= -edge - 1.0 and x < edge and y < edge and z < edge
        if near and left > 0.0:
            low = wp.vec3(wp.floor(x), wp.floor(y), wp.floor(z))
            fx = x - low[0]
            fy = y - low[1]
            fz = z - low[2]
            corner = wp.vec3i(int(low[0]), int(low[1]), int(low[2])) + wp.vec3i(side // 2, side // 2, side // 2)
            w = vec8()
            rows = vec8i()
            here = float(0.0)
            missing = float(0.0)
            for k in range(8):
                offset = wp.vec3i(k & 1, (k >> 1) & 1, k >> 2)
                local = corner + offset
                share = (
                    wp.where(offset[0] == 1, fx, 1.0 - fx)
                    * wp.where(offset[1] == 1, fy, 1.0 - fy)
                    * wp.where(offset[2] == 1, fz, 1.0 - fz)
                )
                inside = wp.min(wp.min(local[0], local[1]), local[2]) >= 0
                inside = inside and wp.max(wp.max(local[0], local[1]), local[2]) < side
                row = int(-1)
                if inside:
                    row = pages[slot_of(level, bases[level] + local, side)]
                if row >= 0:
                    w[k] = share
                    here += share
                else:
                    missing += share
                rows[k] = wp.max(row, 0)
            if here > 0.0:
                for c in range(start, stop):
                    s = float(0.0)
                    for k in range(8):
                        if w[k] > 0.0:  # a row that isn't meant may hold anything
                            s += w[k] * pool[rows[k], c]
                    out[i, c] = out[i, c] + left * s
                covered += left * here
                if left * here > most:
                    most = left * here
                    by = level
                # The sum of what is missing, not what is left of 1: exactly 0 where no corner is.
                left *= missing
    if covered > 0.0:
        for c in range(start, stop):
            out[i, c] = out[i, c] / covered
    if part == 0:
        answered[i] = by
        weight[i] = wp.min(covered, 1.0)


def unscroll(pool, pages, bases, side: int, out, valid) -> None:
    """Copies the blocks in window order: row `((l * side + x) * side + y) * side + z` is base_l + (x, y, z).

    Args:
        pool: float [R, D].
        pages: int [L * side^3].
        bases: vec3i [L].
        side: Blocks along an axis of a window.
        out: float [L * side^3, D]; 0 where a block isn't there.
        valid: uint8 [L * side^3], 1 where it is.
    """
    wp.launch(_unscroll, out.shape, inputs=[pool, pages, bases, side], outputs=[out, valid], device=pool.device)


def read(pool, pages, bases, views, side: int, points, normals, out, answered, weight) -> None:
    """Reads the light at points, from the finest level that has it.

    At each level, from the finest, the 8 blocks whose centres surround a point have trilinear weights. Those that are
    there add their share; the weight of the missing ones passes on to the next level. The sum is divided by the weight
    of all that answered. So the light is continuous over blocks that are missing, borders of windows and changes of
    level, and where the finest level has all 8 it alone answers, with a linear field reproduced. Where it has some,
    their light stands for their own centres, up to a block away.

    Args:
        pool: float [R, D].
        pages: int [L * side^3].
        bases: vec3i [L].
        views: vec4 [L].
        side: Blocks along an axis of a window, even.
        points: vec3 [M], relative to the origin of `views`. One that is NaN or far out is covered by nothing.
        normals: vec3 [M], of unit length: each point is read half a block's side ahead along its own, so that a wall's
            far side has less part in it; or [0]: where they are.
        out: float [M, D]; 0 where nothing covers the point.
        answered: int [M], the level with the largest share, -1 where none has any.
        weight: float [M], how much of the light was found at any level, 0 to 1.
    """
    channels = out.shape[1]
    # On a GPU several threads share a point's channels; a CPU's one thread would look the blocks up again for each.
    chunk = min(_CHUNK, channels) if pool.device.is_cuda else channels
    wp.launch(
        _read,
        (len(points), -(-channels // chunk)),
        inputs=[pool, pages, bases, views, side, points, normals, chunk],
        outputs=[out, answered, weight],
        device=pool.device,
    )
