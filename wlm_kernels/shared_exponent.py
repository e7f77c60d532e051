"""RGB9E5 texels in kernels: three mantissas of nine bits and one exponent.

Read `wlm.formats.shared_exponent` first, which does the same in NumPy.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LARGEST = wp.constant(65408.0)


@wp.func
def power_of_two(exponent: int) -> float:
    """Returns 2 ** exponent, from -126 to 127."""
    return wp.cast(wp.lshift(wp.uint32(exponent + 127), wp.uint32(23)), float)


@wp.func
def unpack_rgb9e5(word: wp.uint32) -> wp.vec3:
    """Unpacks an RGB9E5 texel to linear RGB."""
    return power_of_two(int(wp.rshift(word, wp.uint32(27))) - 24) * wp.vec3(
        float(int(word & wp.uint32(511))),
        float(int(wp.rshift(word, wp.uint32(9)) & wp.uint32(511))),
        float(int(wp.rshift(word, wp.uint32(18)) & wp.uint32(511))),
    )


@wp.func
def pack_rgb9e5(light: wp.vec3) -> wp.uint32:
    """Packs linear RGB, clamped to the format's range, into an RGB9E5 texel."""
    r = wp.clamp(light[0], 0.0, LARGEST)
    g = wp.clamp(light[1], 0.0, LARGEST)
    b = wp.clamp(light[2], 0.0, LARGEST)
    largest = wp.max(r, wp.max(g, b))
    # The exponent of the float is that of its highest bit; the least exponent of the format is 0.
    exponent = wp.max(int(wp.rshift(wp.cast(largest, wp.uint32), wp.uint32(23))) - 111, 0)
    scale = power_of_two(24 - exponent)
    if wp.floor(largest * scale + 0.5) >= 512.0:
        exponent += 1
        scale *= 0.5
    word = wp.uint32(int(wp.floor(r * scale + 0.5)))
    word = word | wp.lshift(wp.uint32(int(wp.floor(g * scale + 0.5))), wp.uint32(9))
    word = word | wp.lshift(wp.uint32(int(wp.floor(b * scale + 0.5))), wp.uint32(18))
    return word | wp.lshift(wp.uint32(exponent), wp.uint32(27))
