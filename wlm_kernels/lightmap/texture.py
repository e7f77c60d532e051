"""Assembles decoded tiles into one RGB9E5 texture with mips, for `wlm.lightmap.runtime.MapDecoder`."""

import warp as wp

from wlm_kernels.shared_exponent import pack_rgb9e5, unpack_rgb9e5

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _place(
    # in:
    tiles: wp.array3d[wp.uint32],
    corners: wp.array1d[wp.vec2i],
    # out:
    texture: wp.array2d[wp.uint32],
):
    n, i, j = wp.tid()
    y = corners[n][0] + i
    x = corners[n][1] + j
    if y < texture.shape[0] and x < texture.shape[1]:
        texture[y, x] = tiles[n, i, j]


@wp.kernel
def _paint(
    # in:
    colours: wp.array1d[wp.vec3],
    corners: wp.array1d[wp.vec2i],
    # out:
    texture: wp.array2d[wp.uint32],
):
    n, i, j = wp.tid()
    y = corners[n][0] + i
    x = corners[n][1] + j
    if y < texture.shape[0] and x < texture.shape[1]:
        texture[y, x] = pack_rgb9e5(colours[n])


@wp.kernel
def _halve(
    # in:
    fine: wp.array2d[wp.uint32],
    weight: wp.array2d[float],
    # out:
    coarse: wp.array2d[wp.uint32],
):
    y, x = wp.tid()
    # The last texel of an odd side covers three texels.
    bottom = wp.where(y == coarse.shape[0] - 1, fine.shape[0], 2 * y + 2)
    right = wp.where(x == coarse.shape[1] - 1, fine.shape[1], 2 * x + 2)
    light = wp.vec3()
    total = float(0.0)
    for i in range(2 * y, bottom):
        for j in range(2 * x, right):
            w = weight[i, j]
            light += w * unpack_rgb9e5(fine[i, j])
            total += w
    if total > 0.0:
        light = light / total
    coarse[y, x] = pack_rgb9e5(light)


@wp.kernel
def _fill(
    # in:
    target: wp.array1d[wp.vec2i],
    source: wp.array1d[wp.vec2i],
    # in and out:
    texture: wp.array2d[wp.uint32],
):
    g = wp.tid()
    texture[target[g][0], target[g][1]] = texture[source[g][0], source[g][1]]


def place(tiles, corners, texture) -> None:
    """Copies decoded tiles into the texture of a lightmap.

    Args:
        tiles: uint32 [n, 128, 128], RGB9E5.
        corners: vec2i [n], row and column of each tile's first texel; texels outside the texture are left out.
        texture: uint32 [H, W], changed.
    """
    wp.launch(_place, tiles.shape, inputs=[tiles, corners], outputs=[texture], device=texture.device)


def paint(colours, corners, side: int, texture) -> None:
    """Fills tiles of the texture with one colour each.

    Args:
        colours: vec3 [n], radiance.
        corners: vec2i [n], row and column of each tile's first texel; texels outside the texture are left out.
        side: Texels along a side of a tile.
        texture: uint32 [H, W], changed.
    """
    dim = (len(colours), side, side)
    wp.launch(_paint, dim, inputs=[colours, corners], outputs=[texture], device=texture.device)


def halve(fine, weight, coarse) -> None:
    """Makes the next smaller mip level: weighted means of 2x2 texels.

    Args:
        fine: uint32 [h, w], RGB9E5.
        weight: float [h, w], weight of each texel; 0 in gaps.
        coarse: uint32 [max(h // 2, 1), max(w // 2, 1)], written: RGB9E5; 0 where all weights are 0.
    """
    wp.launch(_halve, coarse.shape, inputs=[fine, weight], outputs=[coarse], device=coarse.device)


def fill(target, source, texture) -> None:
    """Copies G texels within a texture, uint32 [H, W], to fill gaps between charts with the light of other texels.
    `source` and `target`, vec2i [G], are rows and columns; no source may be a target."""
    wp.launch(_fill, target.shape, inputs=[target, source], outputs=[texture], device=texture.device)
