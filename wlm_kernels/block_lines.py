"""Lines through the colours of a block of 4 x 4 texels, which the encoders of BC6H and ASTC fit to light.

Both formats interpolate between two colours in a space that is roughly the logarithm of light. A line is fitted there
by weighted least squares, with the squared derivative of light as a further weight of each texel, so that the error in
linear light is small.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

TEXELS = wp.constant(16)
ALL = wp.constant(0xFFFF)
HUGE = wp.constant(3.4e38)
_LARGEST = wp.constant(65504.0)
_TOP = wp.constant(65535.0)
_STRETCH = wp.constant(64.0 / 31.0)  # factor from a half float's bits to BC6H's 16-bit space
_BIAS = wp.constant((127 - 15) << 23)  # from the bits of a float to those of a half float
_LEAST_WEIGHT = wp.constant(1.0e-4)  # fraction of the largest texel weight

Colours = wp.types.matrix(shape=(16, 3), dtype=float)
Indices = wp.types.vector(length=16, dtype=int)
Numbers = wp.types.vector(length=16, dtype=float)
Ends = wp.types.matrix(shape=(4, 3), dtype=float)
Moments = wp.types.vector(length=10, dtype=float)
Terms = wp.types.matrix(shape=(16, 10), dtype=float)


@wp.struct
class Texels:
    """The target texels of a block: their linear light, the weights of their squared errors, and their colours in
    the format's 16-bit space, not rounded.

    `pull` is the weight of each channel's squared error in the 16-bit space, `middle` the mean of `place` over the
    texels, and `metric` the scale of each channel's distance from it: the square root of the mean of `pull`.
    """

    light: Colours
    weight: Numbers
    place: Colours
    pull: Colours
    middle: wp.vec3
    metric: wp.vec3


@wp.struct
class Sums:
    """The normal equations of a line's two ends, for each channel: sums over the texels, weighted, of products of their
    interpolation weights a (first end) and b (second end), and of their colours (`place`) times a and b."""

    aa: wp.vec3
    ab: wp.vec3
    bb: wp.vec3
    ay: wp.vec3
    by: wp.vec3


@wp.func
def light_of(bits: int) -> float:
    """Returns the value of a half float, 0 or more and finite, by its bits."""
    if bits < 1024:
        return float(bits) / 16777216.0
    return wp.cast((bits + (112 << 10)) << 13, float)


@wp.func
def in_mask(mask: int, texel: int) -> bool:
    return ((mask >> texel) & 1) == 1


@wp.func
def axis_of(m: Moments, rounds: int):
    """Computes the principal axis of points with the moments m, in `rounds` power iterations, and their scatter along
    it."""
    inverse = 1.0 / wp.max(m[0], 1.0e-30)
    xx, xy, xz = m[4] - m[1] * m[1] * inverse, m[5] - m[1] * m[2] * inverse, m[6] - m[1] * m[3] * inverse
    yy, yz, zz = m[7] - m[2] * m[2] * inverse, m[8] - m[2] * m[3] * inverse, m[9] - m[3] * m[3] * inverse
    a = wp.mat33(xx, xy, xz, xy, yy, yz, xz, yz, zz)
    axis = a[0]
    if yy > xx and yy > zz:
        axis = a[1]
    elif zz > xx:
        axis = a[2]
    for _round in range(rounds):
        length = wp.length(axis)
        if length > 0.0:
            axis = a * (axis / length)
    length = wp.length(axis)
    if length > 0.0:
        axis = axis / length
    return axis, wp.max(wp.dot(axis, a * axis), 0.0)


@wp.func
def spread(m: Moments) -> float:
    """Computes the scatter of points with the moments m: the weighted sum of squared distances from the mean."""
    inverse = 1.0 / wp.max(m[0], 1.0e-30)
    return wp.max(m[4] + m[7] + m[9] - (m[1] * m[1] + m[2] * m[2] + m[3] * m[3]) * inverse, 0.0)


@wp.func
def scaled_place(texels: Texels, texel: int) -> wp.vec3:
    """Returns a texel's colour in the 16-bit space relative to the block's mean, scaled by `texels.metric`."""
    return wp.cw_mul(texels.place[texel] - texels.middle, texels.metric)


@wp.func
def terms_of(texels: Texels) -> Terms:
    """Returns each texel's terms of the moments: weight, weighted colour (`scaled_place`), six weighted products."""
    terms = Terms()
    square = wp.cw_mul(texels.metric, texels.metric)
    for i in range(TEXELS):
        point = scaled_place(texels, i)
        x, y, z = point[0], point[1], point[2]
        weight = wp.dot(wp.cw_div(texels.pull[i], square), wp.vec3(1.0 / 3.0))
        terms[i] = weight * Moments(1.0, x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
    return terms


@wp.func
def moments_of(terms: Terms, mask: int) -> Moments:
    """Sums the terms of the texels in `mask`."""
    total = Moments()
    for i in range(TEXELS):
        if in_mask(mask, i):
            total += terms[i]
    return total


@wp.func
def _solved(products: wp.vec3, right: wp.vec2, before: wp.vec2) -> wp.vec2:
    """Solves for the two ends of a channel within the format's range; returns `before` if they are underdetermined."""
    aa, ab, bb = products[0], products[1], products[2]
    determinant = aa * bb - ab * ab
    if not (determinant > 1.0e-5 * aa * bb and determinant > 0.0):
        return wp.vec2(wp.clamp(before[0], 0.0, _TOP), wp.clamp(before[1], 0.0, _TOP))
    a = (right[0] * bb - right[1] * ab) / determinant
    b = (right[1] * aa - right[0] * ab) / determinant
    # Where one end is clamped to the range, the other is optimal given it.
    if a < 0.0 or a > _TOP:
        a = wp.clamp(a, 0.0, _TOP)
        b = (right[1] - ab * a) / wp.max(bb, 1.0e-30)
    elif b < 0.0 or b > _TOP:
        b = wp.clamp(b, 0.0, _TOP)
        a = (right[0] - ab * b) / wp.max(aa, 1.0e-30)
    return wp.vec2(wp.clamp(a, 0.0, _TOP), wp.clamp(b, 0.0, _TOP))


@wp.func
def ends_of(sums: Sums, a: wp.vec3, b: wp.vec3):
    """Solves the normal equations for a line's ends; `a` and `b` are the previous ends."""
    for c in range(3):
        products = wp.vec3(sums.aa[c], sums.ab[c], sums.bb[c])
        pair = _solved(products, wp.vec2(sums.ay[c], sums.by[c]), wp.vec2(a[c], b[c]))
        a[c] = pair[0]
        b[c] = pair[1]
    return a, b


@wp.func
def extremes(texels: Texels, mask: int, moments: Moments, axis: wp.vec3):
    """Returns the first and the last place of the texels in `mask` along an axis through their mean; `moments` are
    theirs."""
    low = float(HUGE)
    high = float(-HUGE)
    for i in range(TEXELS):
        if in_mask(mask, i):
            t = wp.dot(scaled_place(texels, i), axis)
            low = wp.min(low, t)
            high = wp.max(high, t)
    mean = wp.vec3(moments[1], moments[2], moments[3]) / wp.max(moments[0], 1.0e-30)
    centre = wp.dot(mean, axis)
    a = texels.middle + wp.cw_div(mean + axis * (low - centre), texels.metric)
    b = texels.middle + wp.cw_div(mean + axis * (high - centre), texels.metric)
    return a, b


@wp.func
def along(texels: Texels, texel: int, a: wp.vec3, b: wp.vec3) -> float:
    """Returns the place of a texel between two ends, from 0 to 1."""
    pulled = wp.cw_mul(texels.pull[texel], b - a)
    square = wp.dot(pulled, b - a)
    t = float(0.0)
    if square > 0.0:
        t = wp.clamp(wp.dot(pulled, texels.place[texel] - a) / square, 0.0, 1.0)
    return t


@wp.func
def nearest(texels: Texels, mask: int, a: wp.vec3, b: wp.vec3, steps: int) -> Numbers:
    """Returns the places of the texels in `mask` between two ends, rounded to a number of steps."""
    places = Numbers()
    for i in range(TEXELS):
        if in_mask(mask, i):
            places[i] = wp.floor(along(texels, i, a, b) * float(steps) + 0.5) / float(steps)
    return places


@wp.func
def sums_of(texels: Texels, mask: int, places: Numbers) -> Sums:
    """Sums the normal equations of a line for the texels in `mask`; `places` are the second end's shares of them."""
    sums = Sums()
    for i in range(TEXELS):
        if in_mask(mask, i):
            pull = texels.pull[i]
            t = places[i]
            s = 1.0 - t
            sums.aa += pull * (s * s)
            sums.ab += pull * (s * t)
            sums.bb += pull * (t * t)
            weighted = wp.cw_mul(pull, texels.place[i])
            sums.ay += weighted * s
            sums.by += weighted * t
    return sums


@wp.func
def _place_of(light: float, astc: bool) -> wp.vec2:
    """Returns linear light, 0 or more, converted to a format's 16-bit space, and the derivative of light by the
    result. Within an octave both spaces are piecewise linear in light: BC6H's with one piece, ASTC's with three."""
    bits = wp.cast(light, int) - _BIAS
    octave = bits >> 23  # exponent of a half float
    part = float(bits & 0x7FFFFF) / 8192.0  # mantissa of a half float, not rounded
    if octave < 1:
        octave = 0
        part = light * 16777216.0
    unit = wp.cast((wp.max(octave, 1) + 102) << 23, float)  # the derivative of light by the mantissa
    if not astc:
        return wp.vec2((1024.0 * float(octave) + part) * _STRETCH, unit / _STRETCH)
    base = 2048.0 * float(octave)
    if part < 192.0:
        return wp.vec2(base + part * (8.0 / 3.0), unit * 0.375)
    if part < 704.0:
        return wp.vec2(base + 2.0 * part + 128.0, unit * 0.5)
    return wp.vec2(base + 1.6 * part + 409.6, unit * 0.625)


@wp.func
def gathered(light: wp.array2d[wp.vec3], weight: wp.array2d[float], number: int, astc: bool) -> Texels:
    """Reads block `number`; the 16-bit space is that of ASTC or BC6H."""
    texels = Texels()
    heaviest = float(0.0)
    for i in range(TEXELS):
        heaviest = wp.max(heaviest, weight[number, i])
    metric = wp.vec3(0.0)
    for i in range(TEXELS):
        # A texel without weight gets a very small weight, since interpolation still reads it.
        w = float(1.0)
        if heaviest > 0.0:
            w = wp.max(weight[number, i] / heaviest, _LEAST_WEIGHT)
        texels.weight[i] = w
        for c in range(3):
            value = wp.clamp(light[number, i][c], 0.0, _LARGEST)
            place = _place_of(value, astc)
            texels.light[i, c] = value
            texels.place[i, c] = place[0]
            texels.pull[i, c] = w * place[1] * place[1]
        texels.middle += texels.place[i] / float(TEXELS)
        metric += texels.pull[i] / float(TEXELS)
    # Texels far darker than others must not lose all weight: a line through the bright ones alone may miss black.
    least = 1.0e-6 * wp.max(metric)
    for c in range(3):
        texels.metric[c] = wp.sqrt(wp.max(metric[c], least))
        for i in range(TEXELS):
            texels.pull[i, c] = wp.max(texels.pull[i, c], texels.weight[i] * least)
    return texels
