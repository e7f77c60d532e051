"""Reads a lightmap from tiles: one entry of a table, then one bilinear read of a small texture.

Tile (i, j) of size B spans the lightmap's texel centres i B to (i + 1) B along x, and j B to (j + 1) B along y; its
entry names the rectangle of the texture that holds it, or of a second texture, made of blocks. The rectangle's
outermost samples lie on the tile's borders.

Read `wlm/atlas/exact.py` first: the same in float64 NumPy.
"""

import warp as wp

SIDE_BITS = wp.constant(4)
_SIDE_MASK = wp.constant(15)
_BLOCK = wp.constant(4)


@wp.struct
class Axis:
    """Two texels along an axis, and the weight of the second."""

    low: int
    high: int
    share: float


@wp.func
def tile_place(u: float, texels: int, size: int, tiles: int) -> wp.vec2:
    """Number of the tile that holds a coordinate, and the place in it from 0 to 1; for NaN tile 0 and NaN."""
    if not (u == u):
        return wp.vec2(0.0, u)
    x = wp.clamp(u * float(texels) - 0.5, 0.0, float(texels - 1)) / float(size)
    tile = wp.min(wp.floor(x), float(tiles - 1))
    return wp.vec2(tile, x - tile)


@wp.func
def axis_at(entry: wp.uint16, place: float, first_block_code: int) -> Axis:
    """The two texels that a place in a tile lies between."""
    first = int(entry) >> SIDE_BITS
    last = int(entry) & _SIDE_MASK
    if last >= first_block_code:
        first = _BLOCK * first
        last = _BLOCK * (last - first_block_code) + _BLOCK - 1
    x = place * float(last)
    axis = Axis()
    below = wp.max(wp.min(int(x), last - 1), 0)
    axis.low = first + below
    axis.high = first + wp.min(below + 1, last)
    axis.share = x - float(below)
    return axis


@wp.func
def _bilinear(texels: wp.array2d[wp.vec3h], x: Axis, y: Axis) -> wp.vec3:
    top = wp.lerp(wp.vec3(texels[y.low, x.low]), wp.vec3(texels[y.low, x.high]), x.share)
    bottom = wp.lerp(wp.vec3(texels[y.high, x.low]), wp.vec3(texels[y.high, x.high]), x.share)
    return wp.lerp(top, bottom, y.share)


@wp.kernel(enable_backward=False)
def _decode(
    # in:
    uv: wp.array1d[wp.vec2],
    height: int,
    width: int,
    size: int,
    lut: wp.array3d[wp.uint16],
    texels: wp.array2d[wp.vec3h],
    blocks: wp.array2d[wp.vec3h],
    first_block_code: int,
    # out:
    out: wp.array1d[wp.vec3],
):
    """One point per thread."""
    i = wp.tid()
    u = uv[i]
    across = tile_place(u[0], width, size, lut.shape[1])
    down = tile_place(u[1], height, size, lut.shape[0])
    row, column = int(down[0]), int(across[0])
    entry = lut[row, column, 0]
    x = axis_at(entry, across[1], first_block_code)
    y = axis_at(lut[row, column, 1], down[1], first_block_code)
    if (int(entry) & _SIDE_MASK) < first_block_code:
        out[i] = _bilinear(texels, x, y)
    else:
        out[i] = _bilinear(blocks, x, y)


def decode(uv, height: int, width: int, size: int, lut, texels, out, blocks=None, first_block_code=16) -> None:
    """Reads light at points.

    Args:
        uv: vec2 [N], u right, v down; clamped to [0, 1]. NaN reads NaN.
        height, width: Texels of the lightmap.
        size: B, texels along a tile.
        lut: uint16 [ty, tx, 2], for x and y: first texel of the rectangle << 4 | number of its texels - 1.
        texels: vec3h [Hp, Wp].
        out: vec3 [N], written.
        blocks: vec3h [Hb, Wb], multiples of 4: the second texture; None: there is none.
        first_block_code: The least number in the low bits of an entry that means the second texture, in blocks: the
            first block << 4 | `first_block_code` + number of blocks - 1.
    """
    inputs = [uv, height, width, size, lut, texels, texels if blocks is None else blocks, first_block_code]
    wp.launch(_decode, uv.shape, inputs=inputs, outputs=[out], device=uv.device)
