"""RGB9E5 texels in kernels: three mantissas of nine bits and one exponent.

Read `wlm.formats.shared_exponent` first, which does the same in NumPy.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LARGEST = wp.constant(65408.0)


@wp.func
def unpack_rgb9e5(word: wp.uint32) -> wp.vec3:
    """Unpacks an RGB9E5 texel to linear RGB."""
    scale = wp.pow(2.0, float(int(wp.rshift(word, wp.uint32(27)))) - 24.0)
    return scale * wp.vec3(
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
    exponent = int(0)
    if largest >= 3.0517578125e-5:  # 2 ** -15: below, mantissas of the least exponent are enough
        # The logarithm may round to the next whole number.
        exponent = int(wp.floor(wp.log2(largest))) + 16
        if largest >= wp.pow(2.0, float(exponent) - 15.0):
            exponent += 1
        if largest < wp.pow(2.0, float(exponent) - 16.0):
            exponent -= 1
    if wp.floor(largest * wp.pow(2.0, 24.0 - float(exponent)) + 0.5) >= 512.0:
        exponent += 1
    scale = wp.pow(2.0, 24.0 - float(exponent))
    word = wp.uint32(int(wp.floor(r * scale + 0.5)))
    word = word | wp.lshift(wp.uint32(int(wp.floor(g * scale + 0.5))), wp.uint32(9))
    word = word | wp.lshift(wp.uint32(int(wp.floor(b * scale + 0.5))), wp.uint32(18))
    return word | wp.lshift(wp.uint32(exponent), wp.uint32(27))
