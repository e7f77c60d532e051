"""Decoding tiles that are stored as video, once it is unpacked: levels of 10 bits between two bounds of their colour.

Levels are `[N T, 128, 128]` of uint32, the T pictures of a tile one after another: red, green and blue from the lowest
bit.
"""

import warp as wp

from wlm_kernels.lightmap.decode import bytes_over
from wlm_kernels.lightmap.frames import power
from wlm_kernels.shared_exponent import pack_rgb9e5

wp.set_module_options({"enable_backward": False})


@wp.struct
class StoredVideo:
    """N tiles with a picture at each of T times."""

    levels: wp.array3d[wp.uint32]  # [N T, 128, 128]
    least: wp.array1d[float]  # [N T], colour of level 0
    span: wp.array1d[float]  # [N T], that of level 1023 less it
    times: int
    gamma: float


@wp.func
def level_of(word: wp.uint32, shift: int) -> float:
    return float(int(wp.rshift(word, wp.uint32(shift)) & wp.uint32(1023))) / 1023.0


@wp.func
def video_colour(stored: StoredVideo, picture: int, y: int, x: int) -> wp.vec3:
    """The colour in gamma space of a texel of a picture."""
    word = stored.levels[picture, y, x]
    level = wp.vec3(level_of(word, 0), level_of(word, 10), level_of(word, 20))
    least = stored.least[picture]
    return wp.vec3(least, least, least) + stored.span[picture] * level


@wp.func
def video_radiance(stored: StoredVideo, early: int, late: int, share: float, n: int, y: int, x: int) -> wp.vec3:
    """Radiance between two pictures (eq. 2)."""
    light = power(video_colour(stored, n * stored.times + early, y, x), stored.gamma)
    if share > 0.0:
        other = power(video_colour(stored, n * stored.times + late, y, x), stored.gamma)
        light = (1.0 - share) * light + share * other
    return light


@wp.kernel
def _decode_radiance(
    # in:
    stored: StoredVideo,
    early: int,
    late: int,
    share: float,
    tiles: wp.array1d[int],
    # out:
    out: wp.array3d[wp.vec3],
):
    i, y, x = wp.tid()
    out[i, y, x] = video_radiance(stored, early, late, share, tiles[i], y, x)


@wp.kernel
def _decode_bytes(
    # in:
    stored: StoredVideo,
    early: int,
    late: int,
    share: float,
    tiles: wp.array1d[int],
    inverse_peak: wp.array1d[float],
    # out:
    out: wp.array3d[wp.uint32],
):
    i, y, x = wp.tid()
    n = tiles[i]
    if share > 0.0:
        colour = power(video_radiance(stored, early, late, share, n, y, x), 1.0 / stored.gamma)
    else:
        colour = video_colour(stored, n * stored.times + early, y, x)
    out[i, y, x] = bytes_over(colour, inverse_peak[n])


@wp.kernel
def _decode_shared(
    # in:
    stored: StoredVideo,
    early: int,
    late: int,
    share: float,
    tiles: wp.array1d[int],
    # out:
    out: wp.array3d[wp.uint32],
):
    i, y, x = wp.tid()
    out[i, y, x] = pack_rgb9e5(video_radiance(stored, early, late, share, tiles[i], y, x))


def decode_radiance(stored, early: int, late: int, share: float, tiles, out) -> None:
    """Decodes tiles to linear radiance.

    Args:
        stored: `StoredVideo`.
        early, late, share: The two pictures around the time, and the share of the second in [0, 1).
        tiles: int [n], the tiles to decode.
        out: vec3 [n, 128, 128], written.
    """
    inputs = [stored, early, late, share, tiles]
    wp.launch(_decode_radiance, out.shape, inputs=inputs, outputs=[out], device=out.device)


def decode_bytes(stored, early: int, late: int, share: float, tiles, inverse_peak, out) -> None:
    """Decodes tiles to 8-bit colour in gamma space over a bound.

    Args:
        stored, early, late, share, tiles: As for `decode_radiance`.
        inverse_peak: float [N], 1 / the bound of each tile; 0 for a black one.
        out: uint32 [n, 128, 128], RGBA from the lowest byte, alpha 255, written.
    """
    inputs = [stored, early, late, share, tiles, inverse_peak]
    wp.launch(_decode_bytes, out.shape, inputs=inputs, outputs=[out], device=out.device)


def decode_shared(stored, early: int, late: int, share: float, tiles, out) -> None:
    """Decodes tiles to linear radiance as RGB9E5.

    Args:
        stored, early, late, share, tiles: As for `decode_radiance`.
        out: uint32 [n, 128, 128], written.
    """
    inputs = [stored, early, late, share, tiles]
    wp.launch(_decode_shared, out.shape, inputs=inputs, outputs=[out], device=out.device)
