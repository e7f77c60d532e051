"""Light of all orders of scattering, predicted per pixel from light scattered once and from diffusion.

At albedo a the light of a pixel is a S + a^2 R, where S is the light scattered once at albedo 1. R is predicted as a
weighted sum of features of the pixel: S, S under the opposite light, opacity, the diffusion solver's estimate of R, and
the parts of the last two that come from thin smoke. Each weight is a polynomial in the cosine of the angle between
light and camera and in the logarithm of the smoke's optical depth. Weights were fitted for several albedos, and are
interpolated linearly between them.
"""

from collections.abc import Sequence

import warp as wp

_OPTIONS = {"enable_backward": False}
wp.set_module_options(_OPTIONS)

FEATURES = 28
MIXES = 10

THINNEST = 1e-4
"""Transparencies below this have the same optical depth."""

_THINNEST = wp.constant(THINNEST)
_BRIGHTEST = wp.constant(6.0)  # limit of light over opacity; a white surface under irradiance 4 pi has 4

_Features = wp.types.vector(length=FEATURES, dtype=float)
_Mixes = wp.types.vector(length=MIXES, dtype=float)


@wp.func
def features(
    single: float, opposite: float, diffused: float, from_thin: float, transparency: float, thin: float
) -> _Features:
    """Computes the features of a pixel, from which R is predicted; `thin` is the opacity of thin smoke."""
    opacity = 1.0 - transparency
    root = wp.sqrt(single)
    spread = wp.sqrt(diffused)
    x = _Features()
    x[0] = single
    x[1] = opposite
    x[2] = opacity
    x[3] = opacity * opacity
    x[4] = -wp.log(wp.max(transparency, _THINNEST)) / 9.0
    x[5] = single * single
    x[6] = single * opacity
    x[7] = root
    x[8] = spread
    for n in range(9):
        x[9 + n] = opacity * x[n]
    x[18] = diffused
    x[19] = diffused * opacity
    x[20] = diffused * diffused
    x[21] = diffused * opacity * opacity
    x[22] = root * spread
    x[23] = wp.sqrt(opposite) * spread
    x[24] = from_thin
    x[25] = from_thin * opacity
    x[26] = thin
    x[27] = thin * opacity
    return x


@wp.func
def _mixes(cosine: float, depth: float) -> _Mixes:
    m = _Mixes()
    m[0] = 1.0
    m[1] = cosine
    m[2] = cosine * cosine
    m[3] = depth
    m[4] = depth * depth
    m[5] = cosine * depth
    m[6] = cosine * cosine * cosine
    m[7] = depth * depth * depth
    m[8] = cosine * cosine * depth
    m[9] = cosine * depth * depth
    return m


@wp.kernel
def _write_mixes(
    # in:
    depth: wp.array[float],
    known: wp.array[float],
    cosine: float,
    # out:
    out: wp.array[float],
):
    """Computes the polynomial's terms in one thread; the depth is scaled from the range of the fit to -1 to 1."""
    at = (2.0 * depth[0] - known[0] - known[1]) / (known[1] - known[0])
    m = _mixes(cosine, wp.clamp(at, -1.0, 1.0))
    for n in range(MIXES):
        out[n] = m[n]


@wp.kernel
def _weigh(
    # in:
    weights: wp.array3d[float],
    mixes: wp.array2d[float],
    nodes: wp.vec3i,
    shares: wp.vec3,
    # out:
    out: wp.array3d[float],
):
    light, a, feature = wp.tid()
    total = float(0.0)
    for n in range(MIXES):
        one = weights[nodes[a], n, feature]
        total += mixes[light, n] * wp.lerp(one, weights[nodes[a] + 1, n, feature], shares[a])
    out[light, a, feature] = total


@wp.kernel
def _light(
    # in:
    single: wp.array3d[float],
    opposite: wp.array3d[float],
    diffused: wp.array4d[float],
    from_thin: wp.array4d[float],
    transparency: wp.array2d[float],
    thin: wp.array2d[float],
    weights: wp.array3d[float],
    albedos: wp.vec3,
    places: wp.vec3i,
    # out:
    out: wp.array4d[float],
):
    n, row, column = wp.tid()
    t = transparency[row, column]
    s = single[n, row, column]
    found = wp.vec3()
    o = opposite[n, row, column]
    for a in range(diffused.shape[1]):
        x = features(s, o, diffused[n, a, row, column], from_thin[n, a, row, column], t, thin[row, column])
        more = float(0.0)
        for m in range(FEATURES):
            more += weights[n, a, m] * x[m]
        once = albedos[a] * s
        total = once + albedos[a] * albedos[a] * wp.max(more, 0.0)
        # The result is at most the light of a white surface, and at least the light scattered once.
        found[a] = wp.max(wp.min(total, _BRIGHTEST * (1.0 - t)), once)
    for channel in range(3):
        out[n, row, column, channel] = found[places[channel]]


def mixes(depth: wp.array, known: wp.array, cosine: float, out: wp.array) -> None:
    """Computes the terms of the polynomial that gives the features' weights for a light, float [MIXES].

    `depth`, float [1], is the logarithm of the smoke's mean optical depth, clamped to the smallest and the largest in
    the fit, `known`, float [2]; `cosine` is that of the angle between the directions to the light and to the camera.
    """
    wp.launch(_write_mixes, 1, [depth, known, float(cosine)], [out], device=out.device)


def light(
    single: wp.array,
    opposite: wp.array,
    diffused: wp.array,
    from_thin: wp.array,
    transparency: wp.array,
    thin: wp.array,
    weights: wp.array,
    mixed: wp.array,
    albedos: Sequence[float],
    nodes: Sequence[tuple[int, float]],
    places: Sequence[int],
    buffer: wp.array,
    out: wp.array,
) -> None:
    """Computes the light of all orders of scattering, for each of L lights separately.

    Args:
        single, opposite: float [L, H, W], light scattered once under each light, and under its opposite light.
        diffused, from_thin: float [L, A, H, W], R by diffusion at A albedos, one to three, and the part of this from
            thin smoke.
        transparency: float [H, W], transparency of the smoke.
        thin: float [H, W], opacity of thin smoke.
        weights: float [N, MIXES, FEATURES], fitted coefficients of the polynomials at N albedos.
        mixed: float [L, MIXES], the terms that `mixes` computes for each light.
        albedos: The A albedos.
        nodes: For each albedo the index of the fitted albedo below it, and the fraction of the way to the next one.
        places: For each colour channel the index of its albedo among the A albedos.
        buffer: float [L, A, FEATURES], scratch memory, receives the weights of the features.
        out: float [L, H, W, 3], written: the light in R, G and B.
    """
    fill = [0] * (3 - len(albedos))
    before, shares = wp.vec3i(*(n for n, _ in nodes), *fill), wp.vec3(*(share for _, share in nodes), *fill)
    wp.launch(_weigh, buffer.shape, [weights, mixed, before, shares], [buffer], device=out.device)
    inputs = [
        single,
        opposite,
        diffused,
        from_thin,
        transparency,
        thin,
        buffer,
        wp.vec3(*albedos, *fill),
        wp.vec3i(*places),
    ]
    wp.launch(_light, single.shape, inputs, [out], device=out.device)
