"""Bilinear and nearest reads of texels, and their derivatives (lightmap-uv-clustering-cascade, section 3.3.2).

u points right and v down, row 0 is at v = 0; texel i of n has its centre at (i + 1/2) / n. The boundary mode
says what coordinates outside [0, 1] read:

    clamp   the nearest texel of the border;
    wrap    the texture repeated;
    mirror  the texture repeated, every other copy mirrored: the triangle wave of period 2, F(x) = |x - 2 floor(x/2 +
            1/2)|. Eq. 8 of the paper has a floor in place of the absolute value, which makes it -2 or 0 everywhere.

Coordinates are float32, but weights are computed in float64: at 4,096 texels float32 would leave them 12 bits. A
coordinate that is NaN, or infinite and not clamped, reads NaN; it has no gradient, and adds none to the texture.

Kernels read textures with `axis_at`, `read`, `read_slope` and `add`. One `Axis` for u and one for v suffice for all
channels and their gradients. `wlm_kernels.raster.mips` has kernels that do only this.

Read `benchmarks/plain.py` first (`texture`), which does the same with torch's `grid_sample`.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BOUNDARIES = ("clamp", "wrap", "mirror")
FILTERS = ("linear", "nearest")

_WRAP, _MIRROR = (wp.constant(BOUNDARIES.index(name)) for name in ("wrap", "mirror"))
NEAREST = wp.constant(FILTERS.index("nearest"))


@wp.struct
class Axis:
    """The two texels that a coordinate reads along one axis, and their weights.

    Attributes:
        low, high: Indices of the texels on the two sides of the coordinate, equal at a border; always in the texture.
        weight: Weight of texel `high`, in [0, 1]; `low` has 1 - weight. NaN if the coordinate reads NaN.
        slope: Derivative of `weight` by the coordinate.
    """

    low: int
    high: int
    weight: float
    slope: float


@wp.func
def triangle_wave(x: float) -> float:
    """Evaluates the triangle wave of boundary "mirror" exactly: |x| in [-1, 1], period 2; NaN if x isn't finite."""
    t = wp.float64(x)
    half = wp.float64(0.5)
    return float(wp.abs(t - wp.float64(2.0) * wp.floor(half * t + half)))


@wp.func
def triangle_wave_slope(x: float) -> float:
    """Returns the slope of `triangle_wave`: 1 where it rises or in valleys, -1 where it falls or on peaks; 0 for
    NaN."""
    if not wp.isfinite(x):
        return 0.0
    t = wp.float64(x)
    half = wp.float64(0.5)
    return wp.where(t - wp.float64(2.0) * wp.floor(half * t + half) < wp.float64(0.0), -1.0, 1.0)


@wp.func
def axis_at(x: float, size: int, filter: int, boundary: int) -> Axis:
    """Finds the two texels next to a coordinate u or v along an axis of `size` texels, at least 1, and their weights;
    `filter` and `boundary` are integer codes, returned by `codes`."""
    out = Axis()
    n = wp.float64(size)
    t = wp.float64(x)
    slope = float(size)
    if boundary == _WRAP:
        t = t - wp.floor(t)
    elif boundary == _MIRROR:
        t = wp.float64(triangle_wave(x))
        slope = slope * triangle_wave_slope(x)
    if wp.isnan(t):
        out.weight = wp.nan
        return out
    t = wp.clamp(t, wp.float64(0.0), wp.float64(1.0))
    if filter == NEAREST:
        out.low = wp.min(int(t * n), size - 1)
        out.high = out.low
        return out
    place = t * n - wp.float64(0.5)
    lower = wp.floor(place)
    out.low = int(lower)
    out.high = out.low + 1
    out.weight = float(place - lower)
    out.slope = slope
    if boundary == _WRAP:
        out.low = wp.where(out.low < 0, size - 1, out.low)
        out.high = wp.where(out.high == size, 0, out.high)
    elif out.low < 0 or out.high == size:
        # Clamped or mirrored, the texel beyond the border is the border's own.
        out.low = wp.clamp(out.low, 0, size - 1)
        out.high = out.low
        out.weight = 0.0
        out.slope = 0.0
    return out


@wp.func
def read(texture: wp.array3d[float], x: Axis, y: Axis, c: int) -> float:
    """Samples channel c of a texture at the coordinates (x, y)."""
    top = texture[y.low, x.low, c]
    # A neighbour with weight 0 isn't read: it may be infinite.
    if x.weight != 0.0:
        top = (1.0 - x.weight) * top + x.weight * texture[y.low, x.high, c]
    if y.weight == 0.0:
        return top
    bottom = texture[y.high, x.low, c]
    if x.weight != 0.0:
        bottom = (1.0 - x.weight) * bottom + x.weight * texture[y.high, x.high, c]
    return (1.0 - y.weight) * top + y.weight * bottom


@wp.func
def read_slope(texture: wp.array3d[float], x: Axis, y: Axis, c: int) -> wp.vec2:
    """Returns the derivatives by u and by v of channel c, sampled at the coordinates (x, y)."""
    if wp.isnan(x.weight) or wp.isnan(y.weight):
        return wp.vec2()
    top_left = texture[y.low, x.low, c]
    top_right = texture[y.low, x.high, c]
    bottom_left = texture[y.high, x.low, c]
    bottom_right = texture[y.high, x.high, c]
    across = (1.0 - y.weight) * (top_right - top_left) + y.weight * (bottom_right - bottom_left)
    down = (1.0 - x.weight) * (bottom_left - top_left) + x.weight * (bottom_right - top_right)
    return wp.vec2(x.slope * across, y.slope * down)


@wp.func
def add(grad: wp.array3d[float], x: Axis, y: Axis, c: int, g: float):
    """Adds the gradient g of a result of `read` to the gradients of the texels that `read` has used."""
    if wp.isnan(x.weight) or wp.isnan(y.weight):
        return
    top = (1.0 - y.weight) * g
    wp.atomic_add(grad, y.low, x.low, c, (1.0 - x.weight) * top)
    if x.weight != 0.0:
        wp.atomic_add(grad, y.low, x.high, c, x.weight * top)
    if y.weight != 0.0:
        bottom = y.weight * g
        wp.atomic_add(grad, y.high, x.low, c, (1.0 - x.weight) * bottom)
        if x.weight != 0.0:
            wp.atomic_add(grad, y.high, x.high, c, x.weight * bottom)


def codes(filter: str, boundary: str) -> tuple[int, int]:
    """Returns the integer codes by which kernels know a filter and a boundary mode: "linear" interpolates between the
    four nearest texels, "nearest" reads the nearest one; the module describes "clamp", "wrap" and "mirror"."""
    for name, value, names in (("filter", filter, FILTERS), ("boundary", boundary, BOUNDARIES)):
        if value not in names:
            raise ValueError(f"{name}: expected {' or '.join(names)}, got {value!r}")
    return FILTERS.index(filter), BOUNDARIES.index(boundary)
