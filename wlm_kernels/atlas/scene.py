"""Reads light of a scene: one entry of the table that all sheets share, then a bilinear read of each component.

As `wlm_kernels.atlas.decode`, but that a sheet's tiles begin at a place of their own in the table, that texels are
packed as RGB9E5, and that light is a sum of components, each a layer of the texture, by the state's factors.

Read `wlm/atlas/scene/exact.py` first: the same in float64 NumPy.
"""

import warp as wp

from wlm_kernels.atlas.decode import Axis, axis_at, tile_place
from wlm_kernels.shared_exponent import unpack_rgb9e5

wp.set_module_options({"enable_backward": False})

_NO_BLOCKS = wp.constant(16)  # more than any size's code: no entry names blocks


@wp.func
def _mixed(texels: wp.array3d[wp.uint32], layer: int, row: int, x: Axis) -> wp.vec3:
    """The light of a row between two texels."""
    return wp.lerp(unpack_rgb9e5(texels[layer, row, x.low]), unpack_rgb9e5(texels[layer, row, x.high]), x.share)


@wp.kernel
def _read(
    # in:
    uv: wp.array1d[wp.vec2],
    sheet: wp.array1d[int],
    sheets: wp.array2d[int],  # [S, 7]
    size: int,
    factor: wp.array1d[wp.vec3],  # [K]
    lut: wp.array3d[wp.uint16],
    texels: wp.array3d[wp.uint32],
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
    x = axis_at(lut[row, column, 0], across[1], _NO_BLOCKS)
    y = axis_at(lut[row, column, 1], down[1], _NO_BLOCKS)
    total = wp.vec3(0.0, 0.0, 0.0)
    count = factor.shape[0]
    for k in range(count):
        layer = sheets[s, 6] * count + k
        top = _mixed(texels, layer, y.low, x)
        bottom = _mixed(texels, layer, y.high, x)
        total += wp.cw_mul(factor[k], wp.lerp(top, bottom, y.share))
    out[i] = total


def read(uv, sheet, sheets, size: int, factor, lut, texels, out) -> None:
    """Reads light at points.

    Args:
        uv: vec2 [N], u right, v down; clamped to [0, 1]. NaN reads NaN.
        sheet: int [N], the sheet of each point.
        sheets: int [S, 7]: rows and columns of texels; first row and column in the table; rows and columns of tiles;
            page.
        size: B, texels along a tile.
        factor: vec3 [K], of each component.
        lut: uint16 [ty, tx, 2], for x and y: first texel of the rectangle << 4 | number of its texels - 1.
        texels: uint32 [pages K, Hp, Wp], RGB9E5; a page's components follow each other.
        out: vec3 [N], written.
    """
    wp.launch(_read, uv.shape, inputs=[uv, sheet, sheets, size, factor, lut, texels], outputs=[out], device=uv.device)
