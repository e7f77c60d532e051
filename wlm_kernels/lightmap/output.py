"""Interpolates linear radiance between the decoded tiles of two stored times.

8-bit tiles are uint32 [n, 128 * 128], RGBA with R in the lowest byte. Each tile has its own bound, the colour of byte
255: radiance is (byte / 255 * bound) ** gamma.
"""

import warp as wp

from wlm_kernels.shared_exponent import pack_rgb9e5, unpack_rgb9e5

wp.set_module_options({"enable_backward": False})


@wp.func
def byte_at(word: wp.uint32, c: int) -> float:
    return float(int(wp.rshift(word, wp.uint32(8 * c)) & wp.uint32(255)))


@wp.func
def with_byte(word: wp.uint32, c: int, share: float) -> wp.uint32:
    """Sets channel c of an RGBA word, which must be 0, to the byte of 255 * `share`, and returns the word."""
    return word | wp.lshift(wp.uint32(int(wp.clamp(share, 0.0, 1.0) * 255.0 + 0.5)), wp.uint32(8 * c))


@wp.func
def bound_of(inverse: float) -> float:
    if inverse > 0.0:
        return 1.0 / inverse
    return 0.0


@wp.kernel
def _blend(
    # in:
    early: wp.array2d[wp.uint32],
    late: wp.array2d[wp.uint32],
    early_inverse: wp.array1d[float],
    late_inverse: wp.array1d[float],
    share: float,
    gamma: float,
    # out:
    out: wp.array2d[wp.uint32],
):
    i, j = wp.tid()
    a = bound_of(early_inverse[i])
    b = bound_of(late_inverse[i])
    most = wp.max(a, b)
    word = wp.lshift(wp.uint32(255), wp.uint32(24))
    if most > 0.0:
        for c in range(3):
            x = wp.pow(byte_at(early[i, j], c) / 255.0 * a, gamma)
            y = wp.pow(byte_at(late[i, j], c) / 255.0 * b, gamma)
            word = with_byte(word, c, wp.pow((1.0 - share) * x + share * y, 1.0 / gamma) / most)
    out[i, j] = word


@wp.kernel
def _blend_shared(
    # in:
    early: wp.array1d[wp.uint32],
    late: wp.array1d[wp.uint32],
    share: float,
    # out:
    out: wp.array1d[wp.uint32],
):
    i = wp.tid()
    out[i] = pack_rgb9e5((1.0 - share) * unpack_rgb9e5(early[i]) + share * unpack_rgb9e5(late[i]))


def blend(early, late, early_inverse, late_inverse, share: float, gamma: float, out) -> None:
    """Interpolates between 8-bit tiles of two times in linear radiance (neural-dynamic-gi, eq. 2).

    Args:
        early, late: uint32 [n, 128 * 128], the tiles at two stored times.
        early_inverse, late_inverse: float [n], 1 / the bound (colour of byte 255) of each tile; 0 for a black tile.
        share: Weight of the later time, 0 to 1.
        gamma: Exponent that converts colours to radiance.
        out: uint32 [n, 128 * 128], written; the bound of a tile is the larger of its bounds at the two times.
    """
    inputs = [early, late, early_inverse, late_inverse, share, gamma]
    wp.launch(_blend, out.shape, inputs=inputs, outputs=[out], device=out.device)


def blend_shared(early, late, share: float, out) -> None:
    """Interpolates between RGB9E5 texels of two stored times, uint32 [n], in linear radiance (neural-dynamic-gi, eq.
    2). `share` is the weight of the later time, 0 to 1; the result is written to `out`, uint32 [n]."""
    wp.launch(_blend_shared, out.shape, inputs=[early, late, share], outputs=[out], device=out.device)
