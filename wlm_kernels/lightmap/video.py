"""Decoding tiles that are stored as video or levels, once unpacked: levels of 10 bits between two colours.

Levels are `[N T, 128, 128]` of uint32, the T pictures of a tile one after another: red, green and blue from the lowest
bit.
"""

import warp as wp

from wlm_kernels.lightmap.images import image_kernels

wp.set_module_options({"enable_backward": False})


@wp.struct
class StoredVideo:
    """N tiles with a picture at each of T times."""

    levels: wp.array3d[wp.uint32]  # [N T, 128, 128]
    least: wp.array1d[wp.vec3]  # [N T], colour of level 0
    span: wp.array1d[wp.vec3]  # [N T], that of level 1023 less it
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
    return stored.least[picture] + wp.cw_mul(stored.span[picture], level)


VIDEO = image_kernels(StoredVideo, video_colour)
"""Decodes pictures."""
