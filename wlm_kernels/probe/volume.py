"""Reads light at any point from nested grids around a viewer, whose blocks are found through a page table.

Each level l is a grid of cubes, the blocks, with edge s_l. A block has integer coordinates b, covers `[b s, (b + 1) s)`
and has D numbers, the light at its centre. Only the blocks in the level's window are in memory: sides_l blocks along
the axes from block base_l on. The slot of a block is its coordinates modulo sides_l, so that a window that moves by one
block changes one slab of slots (gaussian-probe-compression, section 3.4). The page table has an entry for each slot:
the row of the array `pool` with the numbers of the slot's block, or a negative number where this light is missing.

Arrays for L levels, with S slots in all: pool int16 [R, D], the bits of half floats, and factor float [R], whose
products are the numbers, since half floats alone do not hold every light; pages int16 [S], by slot; starts int [L],
first slot of each level; sides, bases vec3i [L]; views vec4 [L], position of the points' origin in the window,
`origin / s - base - 1/2`, and 1 / s. Gradients are not computed. The reference is `tests/reference/volume.py`.
"""

import warp as wp

_AHEAD = wp.constant(0.5)  # sides; distance in front of a surface at which its light is read
_CHUNK = 4  # numbers that a GPU's thread reads: 8 bytes of a row; a point of 27 numbers takes 7 threads
# The factor 2^112 between `small_of` and a half float, in two steps: light below 2^68 does not overflow.
_LIFT = wp.constant(2.0**76)
_REST = wp.constant(2.0**36)
_PARTS = wp.constant(-0x70002000)  # 0x8fffe000: the bits of a half float's parts in a float

vec8 = wp.types.vector(length=8, dtype=float)
vec8i = wp.types.vector(length=8, dtype=int)


@wp.func
def wrap(i: int, size: int) -> int:
    r = i % size  # has the sign of i
    return wp.where(r < 0, r + size, r)


@wp.func
def small_of(bits: wp.int16) -> float:
    """Returns a finite half float times 2^-112 from its bits; on a CPU Warp's conversion takes many times as long."""
    return wp.cast((int(bits) << 13) & _PARTS, float)


@wp.func
def inside(local: wp.vec3i, sides: wp.vec3i) -> bool:
    low = wp.min(wp.min(local[0], local[1]), local[2])
    return low >= 0 and local[0] < sides[0] and local[1] < sides[1] and local[2] < sides[2]


@wp.kernel(enable_backward=False)
def _read(
    # in:
    pool: wp.array2d[wp.int16],
    factor: wp.array1d[float],
    pages: wp.array1d[wp.int16],
    starts: wp.array1d[int],
    sides: wp.array1d[wp.vec3i],
    bases: wp.array1d[wp.vec3i],
    views: wp.array1d[wp.vec4],
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
    left = float(1.0)  # weight of the corners that no level has had so far
    covered = float(0.0)
    most = float(0.0)
    by = int(-1)
    for level in range(bases.shape[0]):
        view = views[level]
        x = p[0] * view[3] + view[0] + ahead[0]
        y = p[1] * view[3] + view[1] + ahead[1]
        z = p[2] * view[3] + view[2] + ahead[2]
        # No corner is in the window beyond it. NaN compares false too, so that no float out of range is cast to int.
        n = sides[level]
        near = x >= -1.0 and y >= -1.0 and z >= -1.0 and x < float(n[0]) and y < float(n[1]) and z < float(n[2])
        if near and left > 0.0:
            low = wp.vec3(wp.floor(x), wp.floor(y), wp.floor(z))
            fx = x - low[0]
            fy = y - low[1]
            fz = z - low[2]
            corner = wp.vec3i(int(low[0]), int(low[1]), int(low[2]))
            # Places of the two blocks along each axis among the slots, without a division for every corner.
            base = bases[level]
            start_slot = starts[level]
            u0 = wrap(base[0] + corner[0], n[0])
            v0 = wrap(base[1] + corner[1], n[1])
            w0 = wrap(base[2] + corner[2], n[2])
            u1 = wp.where(u0 + 1 == n[0], 0, u0 + 1)
            v1 = wp.where(v0 + 1 == n[1], 0, v0 + 1)
            w1 = wp.where(w0 + 1 == n[2], 0, w0 + 1)
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
                row = int(-1)
                if inside(local, n):
                    u = wp.where(offset[0] == 1, u1, u0)
                    v = wp.where(offset[1] == 1, v1, v0)
                    row = int(pages[start_slot + (u * n[1] + v) * n[2] + wp.where(offset[2] == 1, w1, w0)])
                if row >= 0:
                    if share > 0.0:  # the row of a block without weight may hold anything, NaN too
                        w[k] = share * factor[row] * _LIFT
                    here += share
                else:
                    missing += share
                rows[k] = wp.max(row, 0)
            if here > 0.0:
                for c in range(start, stop):
                    s = float(0.0)
                    for k in range(8):
                        if w[k] != 0.0:
                            s += w[k] * small_of(pool[rows[k], c])
                    out[i, c] = out[i, c] + left * (s * _REST)
                covered += left * here
                if left * here > most:
                    most = left * here
                    by = level
                # The sum of the missing weights is exactly 0 if no corner is missing; 1 - here may differ by rounding.
                left *= missing
    if covered > 0.0:
        for c in range(start, stop):
            out[i, c] = out[i, c] / covered
    if part == 0:
        answered[i] = by
        weight[i] = wp.min(covered, 1.0)


def read(pool, factor, pages, starts, sides, bases, views, points, normals, out, answered, weight) -> None:
    """Writes the light at points, from the finest level that has it.

    At each level, from the finest, the 8 blocks whose centres surround a point have trilinear weights. Blocks that are
    present add their weighted light; the weight of missing blocks passes on to the next level. The sum is divided by
    the weight of all blocks that were present. The light is thus continuous across missing blocks, borders of windows
    and changes of level. If the finest level has all 8 blocks, only this level is read, and a linear field is
    reproduced.

    Args:
        pool, factor, pages, starts, sides, bases, views: The blocks' light, the page table and the windows, see the
            module's docstring.
        points: vec3 [M], relative to the origin of `views`. No block covers a point that is NaN or far away.
        normals: vec3 [M], of unit length: light is read half a block in front of the point's surface, so that the far
            side of a wall contributes less; or an empty array, [0]: light is read at the point itself.
        out: float [M, D], written; 0 where no block covers the point.
        answered: int [M], written: the level with the largest weight, -1 if no block covers the point.
        weight: float [M], written: fraction of the weight that blocks of any level cover, 0 to 1.
    """
    channels = out.shape[1]
    # Several threads of a GPU share a point's channels; on a CPU each would look the blocks up again.
    chunk = min(_CHUNK, channels) if pool.device.is_cuda else channels
    wp.launch(
        _read,
        (len(points), -(-channels // chunk)),
        inputs=[pool, factor, pages, starts, sides, bases, views, points, normals, chunk],
        outputs=[out, answered, weight],
        device=pool.device,
    )
