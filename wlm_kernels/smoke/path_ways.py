"""Random numbers and directions of paths: a phase function's, and a sky's by its brightness."""

import math

import warp as wp

_TWO_PI = wp.constant(2.0 * math.pi)


@wp.struct
class Sky:
    """Light from infinitely far off, a map of texels of one radiance each.

    Row 0 is around +y; column 0 begins at +x and columns go on towards +z. `rows` and `columns` are running sums of the
    chances of a row, and of a column within its row. `total` is the integral of the mean radiance over the sphere.
    """

    radiance: wp.array2d[wp.vec3]
    rows: wp.array1d[float]
    columns: wp.array2d[float]
    total: float


@wp.struct
class Way:
    """A direction, its chance per solid angle, and the random state after it."""

    direction: wp.vec3
    chance: float
    random: wp.uint64


@wp.func
def stir(x: wp.uint64) -> wp.uint64:
    x = x ^ (x >> wp.uint64(31))
    x = x * wp.uint64(6364136223846793005)
    x = x ^ (x >> wp.uint64(29))
    x = x * wp.uint64(3935559000370003845)
    return x ^ (x >> wp.uint64(32))


@wp.func
def following(random: wp.uint64) -> wp.uint64:
    return random * wp.uint64(6364136223846793005) + wp.uint64(1442695040888963407)


@wp.func
def bits(random: wp.uint64) -> wp.uint32:
    """32 random bits (PCG-XSH-RR, O'Neill 2014)."""
    x = wp.uint32(((random >> wp.uint64(18)) ^ random) >> wp.uint64(27))
    turn = wp.uint32(random >> wp.uint64(59))
    return (x >> turn) | (x << ((wp.uint32(32) - turn) & wp.uint32(31)))


@wp.func
def uniform(random: wp.uint64) -> float:
    """A number of at least 0 and below 1, of 24 bits."""
    return float(bits(random) >> wp.uint32(8)) * (1.0 / 16777216.0)


@wp.func
def scatter(g: float, d: wp.vec3, u: float, v: float) -> wp.vec3:
    """A direction by the Henyey-Greenstein phase function of a path that goes along d."""
    cosine = 1.0 - 2.0 * u
    if wp.abs(g) > 1.0e-3:
        share = (1.0 - g * g) / (1.0 - g + 2.0 * g * u)
        cosine = (1.0 + g * g - share * share) / (2.0 * g)
    cosine = wp.clamp(cosine, -1.0, 1.0)
    sine = wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0))
    # Two directions across d without a division by nearly 0 (Duff et al. 2017).
    sign = wp.where(d[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + d[2])
    b = d[0] * d[1] * a
    across = wp.vec3(1.0 + sign * d[0] * d[0] * a, sign * b, -sign * d[0])
    beside = wp.vec3(b, sign + d[1] * d[1] * a, -d[1])
    angle = _TWO_PI * v
    return wp.normalize(cosine * d + sine * (wp.cos(angle) * across + wp.sin(angle) * beside))


@wp.func
def texel(sky: Sky, d: wp.vec3) -> wp.vec3:
    """The sky's radiance in a direction."""
    rows = sky.radiance.shape[0]
    columns = sky.radiance.shape[1]
    row = int(wp.acos(wp.clamp(d[1], -1.0, 1.0)) / (0.5 * _TWO_PI) * float(rows))
    turn = wp.atan2(d[2], d[0])
    if turn < 0.0:
        turn += _TWO_PI
    column = int(turn / _TWO_PI * float(columns))
    return sky.radiance[wp.clamp(row, 0, rows - 1), wp.clamp(column, 0, columns - 1)]


@wp.func
def chance_of(sky: Sky, radiance: wp.vec3) -> float:
    """Chance per solid angle of a direction in a texel."""
    return (radiance[0] + radiance[1] + radiance[2]) / (3.0 * sky.total)


@wp.func
def toward_sky(sky: Sky, random: wp.uint64) -> Way:
    """A direction by the sky's brightness."""
    way = Way()
    rows = sky.radiance.shape[0]
    columns = sky.radiance.shape[1]
    random = following(random)
    u = uniform(random)
    row = int(0)
    past = rows - 1
    while row < past:
        middle = (row + past) // 2
        if sky.rows[middle] > u:
            past = middle
        else:
            row = middle + 1
    random = following(random)
    u = uniform(random)
    column = int(0)
    past = columns - 1
    while column < past:
        middle = (column + past) // 2
        if sky.columns[row, middle] > u:
            past = middle
        else:
            column = middle + 1
    top = wp.cos(0.5 * _TWO_PI * float(row) / float(rows))
    bottom = wp.cos(0.5 * _TWO_PI * float(row + 1) / float(rows))
    random = following(random)
    height = wp.lerp(top, bottom, uniform(random))
    random = following(random)
    turn = _TWO_PI * (float(column) + uniform(random)) / float(columns)
    across = wp.sqrt(wp.max(1.0 - height * height, 0.0))
    way.direction = wp.vec3(across * wp.cos(turn), height, across * wp.sin(turn))
    way.chance = chance_of(sky, sky.radiance[row, column])
    way.random = random
    return way
