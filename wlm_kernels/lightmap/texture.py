"""Assembles decoded tiles into one RGB9E5 texture with mips, for `wlm.lightmap.runtime.MapDecoder`."""

import warp as wp

from wlm_kernels.shared_exponent import pack_rgb9e5, unpack_rgb9e5

wp.set_module_options({"enable_backward": False})


@wp.kernel
def _add(
    # in:
    tiles: wp.array3d[wp.uint32],
    colours: wp.array1d[wp.vec3],
    slots: wp.array2d[int],
    weights: wp.array1d[wp.vec3],
    corners: wp.array1d[wp.vec2i],
    # out:
    texture: wp.array2d[wp.uint32],
):
    n, i, j = wp.tid()
    y = corners[n][0] + i
    x = corners[n][1] + j
    if y >= texture.shape[0] or x >= texture.shape[1]:
        return
    first = slots[n, 0]
    if slots.shape[1] == 1 and first >= 0 and wp.length_sq(weights[0] - wp.vec3(1.0)) == 0.0:
        # One group at full weight is not rounded again.
        texture[y, x] = tiles[first, i, j]
        return
    light = wp.vec3()
    for g in range(slots.shape[1]):
        slot = slots[n, g]
        if slot < 0:
            light += wp.cw_mul(weights[g], colours[-1 - slot])
        else:
            light += wp.cw_mul(weights[g], unpack_rgb9e5(tiles[slot, i, j]))
    texture[y, x] = pack_rgb9e5(light)


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


def add(tiles, colours, slots, weights, corners, texture) -> None:
    """Adds the decoded tiles of G light groups into the texture of a lightmap: weighted sums of linear light.

    Args:
        tiles: uint32 [k, 128, 128], RGB9E5, the tiles of all groups.
        colours: vec3 [c], radiance of the constant tiles of all groups, 0 at index 0 for tiles that a group lacks.
        slots: int [n, G], for each tile and group s >= 0 for `tiles[s]`, or s < 0 for `colours[-1 - s]`.
        weights: vec3 [G], factors of red, green and blue.
        corners: vec2i [n], row and column of each tile's first texel; texels outside the texture are left out.
        texture: uint32 [H, W], RGB9E5, changed. The sum is rounded once.
    """
    dim, inputs = (len(corners), *tiles.shape[1:]), [tiles, colours, slots, weights, corners]
    wp.launch(_add, dim, inputs=inputs, outputs=[texture], device=texture.device)


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
