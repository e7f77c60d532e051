"""Reads light of a scene: one entry of the table that all sheets share, then a bilinear read of each component.

As `wlm_kernels.atlas.decode`, but that a sheet's tiles begin at a place of their own in the table, that texels are
packed as RGB9E5, and that light is a sum of components, rectangles beside each other, by the state's factors.

Read `wlm/atlas/scene/exact.py` first: the same in float64 NumPy.
"""

import warp as wp

from wlm_kernels.atlas.decode import Axis, axis_at, tile_place
from wlm_kernels.shared_exponent import unpack_rgb9e5

wp.set_module_options({"enable_backward": False})

_SIDE_MASK = wp.constant(15)
_BLOCK = wp.constant(4)
_COUNT_BITS = wp.constant(8)
_COUNT_MASK = wp.constant(255)
_COARSE_BITS = wp.constant(4)
_COARSE_MASK = wp.constant(15)


@wp.func
def _mixed(texels: wp.array3d[wp.uint32], page: int, row: int, column: int, x: Axis) -> wp.vec3:
    """The light of a row between two texels, of the rectangle that begins so many columns on."""
    near = unpack_rgb9e5(texels[page, row, column + x.low])
    return wp.lerp(near, unpack_rgb9e5(texels[page, row, column + x.high]), x.share)


@wp.func
def _mixed_blocks(blocks: wp.array3d[wp.vec3h], page: int, row: int, column: int, x: Axis) -> wp.vec3:
    """`_mixed` of the second texture."""
    near = wp.vec3(blocks[page, row, column + x.low])
    return wp.lerp(near, wp.vec3(blocks[page, row, column + x.high]), x.share)


@wp.func
def _in_block(entry: wp.uint16, place: float, first_block_code: int) -> Axis:
    """`axis_at` where a component has one block."""
    return axis_at(entry - (entry & wp.uint16(_SIDE_MASK)) + wp.uint16(first_block_code), place, first_block_code)


@wp.kernel
def _read(
    # in:
    uv: wp.array1d[wp.vec2],
    sheet: wp.array1d[int],
    sheets: wp.array2d[int],  # [S, 7]
    size: int,
    factor: wp.array1d[wp.vec3],  # [C]
    lut: wp.array3d[wp.uint16],
    texels: wp.array3d[wp.uint32],
    blocks: wp.array3d[wp.vec3h],
    first_block_code: int,
    # out:
    out: wp.array1d[wp.vec3],
):
    """One point per thread."""
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
    rows = int(1)  # of blocks
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
    # NaN where there is no place.
    total = wp.vec3(0.0, 0.0, 0.0) * (across[1] + down[1])
    count = last & _COUNT_MASK
    if count > 0:
        total += factor[first]
    whole = count - coarse
    for k in range(count):
        right = k * step
        if k >= whole:
            # Blocks, one below the other beside the other components.
            right = whole * step + _BLOCK * ((k - whole) / rows)
            below = _BLOCK * ((k - whole) % rows)
            x = _in_block(lut[row, column, 0], across[1], first_block_code)
            y = _in_block(lut[row, column, 1], down[1], first_block_code)
            y.low += below
            y.high += below
        top = wp.vec3(0.0, 0.0, 0.0)
        bottom = wp.vec3(0.0, 0.0, 0.0)
        if of_blocks:
            top = _mixed_blocks(blocks, page, y.low, right, x)
            bottom = _mixed_blocks(blocks, page, y.high, right, x)
        else:
            top = _mixed(texels, page, y.low, right, x)
            bottom = _mixed(texels, page, y.high, right, x)
        total += wp.cw_mul(factor[first + 1 + k], wp.lerp(top, bottom, y.share))
    # Factors have any sign.
    for c in range(3):
        if total[c] < 0.0:
            total[c] = 0.0
    out[i] = total


def read(uv, sheet, sheets, size: int, factor, lut, texels, blocks, first_block_code: int, out) -> None:
    """Reads light at points.

    Args:
        uv: vec2 [N], u right, v down; clamped to [0, 1]. NaN reads NaN.
        sheet: int [N], the sheet or level of each point.
        sheets: int [S, 7]: rows and columns of texels; first row and column in the table; rows and columns of tiles;
            one number that isn't read.
        size: B, texels along a tile.
        factor: vec3 [C], of each mixture a constant and then one of each component.
        lut: uint16 [ty, tx, 4], for x and y: first texel of the first component's rectangle << 4 | number of its texels
            - 1; number of its factors; page << 12 | number of coarse components << 8 | number of components. Or of the
            first two alone, [ty, tx, 2]: one component and one page.
        texels: uint32 [pages, Hp, Wp], RGB9E5; the components of a tile follow each other along a row.
        blocks: vec3h [pages, Hb, Wb], the second texture, in blocks of 4 x 4 texels.
        first_block_code: As of `wlm_kernels.atlas.decode`; 16: no entry is of the second texture.
        out: vec3 [N], written.
    """
    inputs = [uv, sheet, sheets, size, factor, lut, texels, blocks, first_block_code]
    wp.launch(_read, uv.shape, inputs=inputs, outputs=[out], device=uv.device)
