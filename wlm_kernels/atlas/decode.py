"""Reads lightmaps that are stored as tiles: one entry of a lookup texture, then bilinear reads of a colour texture.

A lightmap is cut into tiles of size B. Tile (i, j) spans the lightmap's texel centres i B to (i + 1) B along x, and j B
to (j + 1) B along y. Its entry in the lookup texture gives a rectangle of the colour texture, or of a second colour
texture that consists of blocks of 4 x 4 texels. The rectangle's outermost samples lie on the tile's borders.

`decode` reads the tiles of one lightmap. `decode_shared` reads tiles that many lightmaps and lighting states share:
light is a sum of components, each times a factor of the lighting state, and the rectangles of a tile's components lie
beside each other (`wlm.atlas.model`).

`benchmarks/atlas_exact.py` computes the same in float64 NumPy and is easier to read.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

SIDE_BITS = wp.constant(4)
_SIDE_MASK = wp.constant(15)
_BLOCK = wp.constant(4)
_COUNT_BITS = wp.constant(8)
_COUNT_MASK = wp.constant(255)
_COARSE_BITS = wp.constant(4)
_COARSE_MASK = wp.constant(15)


@wp.struct
class Axis:
    """Two neighbouring texels along an axis, and the weight of the second."""

    low: int
    high: int
    share: float


@wp.func
def tile_place(u: float, texels: int, size: int, tiles: int) -> wp.vec2:
    """Returns the index of the tile in which u lies along an axis of `texels` texels and `tiles` tiles, and the
    position in the tile from 0 to 1. If u is NaN, the index is 0 and the position NaN."""
    if not (u == u):
        return wp.vec2(0.0, u)
    x = wp.clamp(u * float(texels) - 0.5, 0.0, float(texels - 1)) / float(size)
    tile = wp.min(wp.floor(x), float(tiles - 1))
    return wp.vec2(tile, x - tile)


@wp.func
def axis_at(entry: wp.uint16, place: float, first_block_code: int) -> Axis:
    """Returns the two texels around a position in a tile along one axis, and the weight of the second texel. `place` is
    the position from 0 to 1; `entry` is one number of the tile in the lookup texture, see `decode`."""
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
def _bilinear(pages: wp.array3d[wp.vec3h], page: int, right: int, x: Axis, y: Axis) -> wp.vec3:
    """Reads texture `page` bilinearly at x and y, after moving both texels of x to the right by `right` texels."""
    left = right + x.low
    next = right + x.high
    top = wp.lerp(wp.vec3(pages[page, y.low, left]), wp.vec3(pages[page, y.low, next]), x.share)
    bottom = wp.lerp(wp.vec3(pages[page, y.high, left]), wp.vec3(pages[page, y.high, next]), x.share)
    return wp.lerp(top, bottom, y.share)


@wp.kernel
def _decode(
    # in:
    uv: wp.array1d[wp.vec2],
    height: int,
    width: int,
    size: int,
    lut: wp.array3d[wp.uint16],
    texels: wp.array3d[wp.vec3h],
    blocks: wp.array3d[wp.vec3h],
    first_block_code: int,
    # out:
    out: wp.array1d[wp.vec3],
):
    i = wp.tid()
    u = uv[i]
    across = tile_place(u[0], width, size, lut.shape[1])
    down = tile_place(u[1], height, size, lut.shape[0])
    row, column = int(down[0]), int(across[0])
    entry = lut[row, column, 0]
    x = axis_at(entry, across[1], first_block_code)
    y = axis_at(lut[row, column, 1], down[1], first_block_code)
    if (int(entry) & _SIDE_MASK) < first_block_code:
        out[i] = _bilinear(texels, 0, 0, x, y)
    else:
        out[i] = _bilinear(blocks, 0, 0, x, y)


def decode(uv, height: int, width: int, size: int, lut, texels, out, blocks=None, first_block_code=16) -> None:
    """Writes the light of a lightmap that is stored as tiles, at N points.

    Args:
        uv: vec2 [N], coordinates (u, v), u right and v down, clamped to [0, 1]. The light at NaN is NaN.
        height, width: Size of the lightmap in texels.
        size: B, number of texels along a tile.
        lut: uint16 [ty, tx, 2], for each tile an entry for x and one for y: (first texel of the rectangle) << 4 |
            (number of its texels - 1).
        texels: vec3h [1, Hp, Wp], the colour texture.
        out: vec3 [N], written.
        blocks: vec3h [1, Hb, Wb], the second colour texture, with sides that are multiples of 4; None if there is none.
        first_block_code: An entry whose low 4 bits are at least this number refers to the second texture and counts
            blocks of 4 texels: (first block) << 4 | (`first_block_code` + number of blocks - 1). With 16 no entry does.
    """
    inputs = [uv, height, width, size, lut, texels, texels if blocks is None else blocks, first_block_code]
    wp.launch(_decode, uv.shape, inputs=inputs, outputs=[out], device=uv.device)


@wp.func
def _in_block(entry: wp.uint16, place: float, first_block_code: int) -> Axis:
    """Returns the texels and weight at `place` (0 to 1) along one axis of the 4 x 4 block with which `entry` begins."""
    return axis_at(entry - (entry & wp.uint16(_SIDE_MASK)) + wp.uint16(first_block_code), place, first_block_code)


@wp.kernel
def _decode_shared(
    # in:
    uv: wp.array1d[wp.vec2],
    sheet: wp.array1d[int],
    sheets: wp.array2d[int],  # [S, 7]
    size: int,
    factor: wp.array1d[wp.vec3],  # [C]
    lut: wp.array3d[wp.uint16],
    texels: wp.array3d[wp.vec3h],
    blocks: wp.array3d[wp.vec3h],
    first_block_code: int,
    # out:
    out: wp.array1d[wp.vec3],
):
    i = wp.tid()
    u = uv[i]
    s = sheet[i]
    down = tile_place(u[1], sheets[s, 0], size, sheets[s, 4])
    across = tile_place(u[0], sheets[s, 1], size, sheets[s, 5])
    row = sheets[s, 2] + int(down[0])
    column = sheets[s, 3] + int(across[0])
    x = axis_at(lut[row, column, 0], across[1], first_block_code)
    y = axis_at(lut[row, column, 1], down[1], first_block_code)
    step = (int(lut[row, column, 0]) & _SIDE_MASK) + 1
    of_blocks = step > first_block_code
    rows = int(1)  # rows of blocks
    if of_blocks:
        step = _BLOCK * (step - first_block_code)
        rows = wp.max((int(lut[row, column, 1]) & _SIDE_MASK) + 1 - first_block_code, 1)
    first = int(0)
    last = int(1)
    if lut.shape[2] == 4:
        first = int(lut[row, column, 2])
        last = int(lut[row, column, 3])
    page = last >> (_COUNT_BITS + _COARSE_BITS)
    coarse = (last >> _COUNT_BITS) & _COARSE_MASK
    # The result is NaN where the coordinate is NaN.
    total = wp.vec3(0.0, 0.0, 0.0) * (across[1] + down[1])
    count = last & _COUNT_MASK
    if count > 0:
        total += factor[first]
    whole = count - coarse
    for k in range(count):
        right = k * step
        if k >= whole:
            # Coarse components are stacked in columns beside the others.
            right = whole * step + _BLOCK * ((k - whole) / rows)
            below = _BLOCK * ((k - whole) % rows)
            x = _in_block(lut[row, column, 0], across[1], first_block_code)
            y = _in_block(lut[row, column, 1], down[1], first_block_code)
            y.low += below
            y.high += below
        light = wp.vec3(0.0, 0.0, 0.0)
        if of_blocks:
            light = _bilinear(blocks, page, right, x, y)
        else:
            light = _bilinear(texels, page, right, x, y)
        total += wp.cw_mul(factor[first + 1 + k], light)
    # Factors may be negative, and so may the sum.
    for c in range(3):
        if total[c] < 0.0:
            total[c] = 0.0
    out[i] = total


def decode_shared(uv, sheet, sheets, size: int, factor, lut, texels, blocks, first_block_code: int, out) -> None:
    """Writes the light of tiles that many lightmaps and lighting states share, at N points in one lighting state.

    Args:
        uv: vec2 [N], coordinates (u, v), u right and v down, clamped to [0, 1]. The light at NaN is NaN.
        sheet: int [N], for each point the row in `sheets` of its lightmap or mip level.
        sheets: int [S, 7], for each lightmap or mip level: height and width in texels; row and column of its first tile
            in the lookup texture; rows and columns of tiles; and one number that is ignored.
        size: B, number of texels along a tile.
        factor: vec3 [C], the factors of the lighting state. Each group of tiles whose light changes alike has its own
            factors: a constant, followed by one factor for each component.
        lut: uint16 [ty, tx, 4], for each tile the entries for x and y of its first component, as for `decode`; the
            index of its constant in `factor`; and page << 12 | number of coarse components << 8 | number of components.
            A coarse component is a single block. With one component and one page: [ty, tx, 2], only the entries.
        texels: vec3h [pages, Hp, Wp], the colour texture; the components of a tile follow each other along a row.
        blocks: vec3h [pages, Hb, Wb], the second colour texture, in blocks of 4 x 4 texels.
        first_block_code: As for `decode`.
        out: vec3 [N], written.
    """
    inputs = [uv, sheet, sheets, size, factor, lut, texels, blocks, first_block_code]
    wp.launch(_decode_shared, uv.shape, inputs=inputs, outputs=[out], device=uv.device)
