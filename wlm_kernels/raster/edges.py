"""Edge functions of triangles in homogeneous coordinates, and their exact signs.

`wlm_kernels.raster.rasterize` defines edge functions. Read `tests/reference/raster.py` first, which decides in integers
which pixels a triangle covers.
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

MOST_PIXELS = 16384
"""Maximum number of pixels along one axis; beyond it, terms of the exact edge function would not fit a float64."""

_LOW_BITS = wp.constant(wp.int64(2**29 - 1))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
# Rounding errors of an edge function, and of the determinant, are below 8 * 2^-53 of the sum of its terms' sizes.
_ROUNDING = wp.constant(wp.float64(2.0**-49))
# In pixels; far more than the rounding of a division.
_SLACK = wp.constant(wp.float64(1.0e-6))

vec12d = wp.types.vector(length=12, dtype=wp.float64)


@wp.struct
class Frame:
    """The pixel centres of an image, in integers: the centre of the pixel in column i and row j is the homogeneous
    point (x, y, w) = ((x + 2 i) height, (y + y_step j) width, scale * width * height).

    Attributes:
        height, width: Size of the image in pixels.
        x: Value of x for column 0.
        y, y_step: Value of y for row 0, and its change from row to row.
        scale: 1 where coordinates run from -1 to 1, 2 where they run from 0 to 1.
    """

    height: int
    width: int
    x: int
    y: int
    y_step: int
    scale: int


@wp.struct
class Corners:
    """The homogeneous corners (x, y, w) of a triangle, and the z of each corner."""

    a: wp.vec3d
    b: wp.vec3d
    c: wp.vec3d
    z: wp.vec3d


@wp.struct
class Box:
    """The pixels from column `left` to `right` and row `top` to `bottom`; none where left > right or top > bottom."""

    left: int
    right: int
    top: int
    bottom: int


@wp.struct
class Edges:
    """The three edge functions of a triangle, E = x X + y Y + c, positive inside. In pixel column i and row j, X is
    frame.x + 2 i and Y is frame.y + y_step j.

    Attributes:
        x, y, c: Coefficients; component i belongs to the edge opposite corner i.
        limit: Bound of the rounding error of each edge function; set by `edges_of`.
        sign: Sign of the determinant of the corners; 0 if the triangle covers nothing.
    """

    x: wp.vec3d
    y: wp.vec3d
    c: wp.vec3d
    limit: wp.vec3d
    sign: wp.float64


@wp.func
def corners_of(position: wp.array2d[float], triangle: wp.array2d[int], t: int) -> Corners:
    """Reads the corners of a triangle; its indices must be valid."""
    out = Corners()
    i = triangle[t, 0]
    j = triangle[t, 1]
    k = triangle[t, 2]
    if position.shape[1] == 2:
        out.a = wp.vec3d(wp.float64(position[i, 0]), wp.float64(position[i, 1]), _ONE)
        out.b = wp.vec3d(wp.float64(position[j, 0]), wp.float64(position[j, 1]), _ONE)
        out.c = wp.vec3d(wp.float64(position[k, 0]), wp.float64(position[k, 1]), _ONE)
    else:
        out.a = wp.vec3d(wp.float64(position[i, 0]), wp.float64(position[i, 1]), wp.float64(position[i, 3]))
        out.b = wp.vec3d(wp.float64(position[j, 0]), wp.float64(position[j, 1]), wp.float64(position[j, 3]))
        out.c = wp.vec3d(wp.float64(position[k, 0]), wp.float64(position[k, 1]), wp.float64(position[k, 3]))
        out.z = wp.vec3d(wp.float64(position[i, 2]), wp.float64(position[j, 2]), wp.float64(position[k, 2]))
    return out


@wp.func
def has_corners(triangle: wp.array2d[int], t: int, count: int) -> bool:
    """Returns whether all indices of a triangle are from 0 to `count` - 1."""
    i = triangle[t, 0]
    j = triangle[t, 1]
    k = triangle[t, 2]
    return wp.min(i, wp.min(j, k)) >= 0 and wp.max(i, wp.max(j, k)) < count


@wp.func
def finite(k: Corners) -> bool:
    return wp.isfinite(k.a) and wp.isfinite(k.b) and wp.isfinite(k.c) and wp.isfinite(k.z)


@wp.func
def exact_sign(p: wp.vec3d, v: wp.vec3d, w: wp.vec3d) -> wp.float64:
    """Returns the exact sign of det[p, v, w]; v and w are float32 numbers, p float32 numbers or integers up to 2^29.

    A product v_a w_b fits 48 bits, and each half of it times p_c fits a float64: twelve exact terms. They are added as
    an expansion, a sum of float64 numbers that don't overlap; its last component that isn't zero has the sign.
    """
    sums = vec12d()
    count = int(0)
    for term in range(6):
        axis = term // 2
        a = (axis + 1 + term % 2) % 3
        b = 3 - axis - a
        whole = v[a] * w[b]
        high = wp.cast(wp.cast(whole, wp.int64) & ~_LOW_BITS, wp.float64)
        factor = wp.where(term % 2 == 0, p[axis], -p[axis])
        for half in range(2):
            carry = factor * wp.where(half == 0, high, whole - high)
            for i in range(count):
                # Two-sum: total and the rounding error of carry + old, exact together.
                old = sums[i]
                total = carry + old
                rest = total - carry
                sums[i] = (carry - (total - rest)) + (old - rest)
                carry = total
            sums[count] = carry
            count += 1
    for i in range(12):
        last = sums[11 - i]
        if last != _ZERO:
            return wp.sign(last)
    return _ZERO


@wp.func
def centre(frame: Frame, row: int, column: int) -> wp.vec3d:
    """Returns the homogeneous centre P of a pixel, with integer components."""
    return wp.vec3d(
        wp.float64((frame.x + 2 * column) * frame.height),
        wp.float64((frame.y + frame.y_step * row) * frame.width),
        wp.float64(frame.scale * frame.width * frame.height),
    )


@wp.func
def functions(k: Corners, frame: Frame, sign: wp.float64) -> Edges:
    """Returns a triangle's edge functions times `sign`, in float64; exact products: a coefficient is rounded once."""
    out = Edges()
    n0 = sign * wp.cross(k.b, k.c)
    n1 = sign * wp.cross(k.c, k.a)
    n2 = sign * wp.cross(k.a, k.b)
    h = wp.float64(frame.height)
    w = wp.float64(frame.width)
    out.x = h * wp.vec3d(n0[0], n1[0], n2[0])
    out.y = w * wp.vec3d(n0[1], n1[1], n2[1])
    out.c = wp.float64(frame.scale) * w * h * wp.vec3d(n0[2], n1[2], n2[2])
    out.sign = sign
    return out


@wp.func
def edges_of(k: Corners, frame: Frame, cull: int) -> Edges:
    """Computes edge functions, positive inside, with rounding bounds; `sign` is 0 if the triangle covers nothing."""
    n = wp.cross(k.b, k.c)
    d = wp.dot(k.a, n)
    size = wp.abs(k.a[0] * n[0]) + wp.abs(k.a[1] * n[1]) + wp.abs(k.a[2] * n[2])
    sign = wp.sign(d)
    if not wp.abs(d) > _ROUNDING * size:
        sign = exact_sign(k.a, k.b, k.c)
    if cull != 0 and sign < _ZERO:
        sign = _ZERO
    out = functions(k, frame, sign)
    for i in range(3):
        across = wp.float64(2 * frame.width) * wp.abs(out.x[i])
        down = wp.float64(2 * frame.height) * wp.abs(out.y[i])
        out.limit[i] = _ROUNDING * (across + down + wp.abs(out.c[i]))
    return out


@wp.func
def covers(e: Edges, k: Corners, frame: Frame, row: int, column: int) -> bool:
    """Returns whether a pixel's centre lies inside the triangle: exact, with the top-left rule for points on edges."""
    p = centre(frame, row, column)
    v = k.b
    w = k.c
    for i in range(3):
        s = e.sign * exact_sign(p, v, w)
        if s == _ZERO:
            s = e.x[i]
        if s == _ZERO:
            s = e.y[i] * wp.float64(frame.y_step)
        if not s > _ZERO:
            return False
        # Edges opposite the corners in order: (b, c), (c, a), (a, b).
        v = w
        w = wp.where(i == 0, k.a, k.b)
    return True


@wp.func
def _extent(k: Corners, axis: int):
    """Returns the least and greatest x / w (axis 0) or y / w (axis 1) of a triangle's part before the viewer (w > 0).

    An edge that crosses w = 0 extends to plus or minus infinity. If no part has w > 0, the least is above the greatest.
    """
    low = wp.float64(wp.inf)
    high = wp.float64(-wp.inf)
    for i in range(3):
        near = wp.where(i == 0, k.a, wp.where(i == 1, k.b, k.c))
        if near[2] > _ZERO:
            place = near[axis] / near[2]
            low = wp.min(low, place)
            high = wp.max(high, place)
            for j in range(3):
                far = wp.where(j == 0, k.a, wp.where(j == 1, k.b, k.c))
                if not far[2] > _ZERO:
                    direction = far[axis] * near[2] - near[axis] * far[2]
                    if direction > _ZERO:
                        high = wp.float64(wp.inf)
                    if direction < _ZERO:
                        low = wp.float64(-wp.inf)
    return low, high


@wp.func
def first_pixel(place: wp.float64, count: int) -> int:
    """Returns the first of `count` pixels at or after a position in pixels; `count` if there is none."""
    return int(wp.clamp(wp.ceil(place - _SLACK), _ZERO, wp.float64(count)))


@wp.func
def last_pixel(place: wp.float64, count: int) -> int:
    """Returns the last of `count` pixels at or before a position in pixels; -1 if there is none."""
    return int(wp.clamp(wp.floor(place + _SLACK), -_ONE, wp.float64(count - 1)))


@wp.func
def box_of(k: Corners, frame: Frame) -> Box:
    """Returns the bounding box, in pixels, of the triangle's part in front of the viewer."""
    out = Box()
    x_low, x_high = _extent(k, 0)
    y_low, y_high = _extent(k, 1)
    x = wp.float64(frame.x)
    y = wp.float64(frame.y)
    size_x = wp.float64(frame.scale * frame.width)
    size_y = wp.float64(frame.scale * frame.height)
    out.left = first_pixel((size_x * x_low - x) / _TWO, frame.width)
    out.right = last_pixel((size_x * x_high - x) / _TWO, frame.width)
    if frame.y_step > 0:
        out.top = first_pixel((size_y * y_low - y) / _TWO, frame.height)
        out.bottom = last_pixel((size_y * y_high - y) / _TWO, frame.height)
    else:
        out.top = first_pixel((y - size_y * y_high) / _TWO, frame.height)
        out.bottom = last_pixel((y - size_y * y_low) / _TWO, frame.height)
    return out


@wp.func
def edges_at(k: Corners, frame: Frame, row: int, column: int):
    """Returns the edge functions at a covered pixel, made positive, and their derivatives by X and Y; see `Edges`."""
    e = functions(k, frame, _ONE)
    x = wp.float64(frame.x + 2 * column)
    y = wp.float64(frame.y + frame.y_step * row)
    f = x * e.x + (y * e.y + e.c)
    # The pixel is covered, so all have one sign.
    sign = wp.where(f[0] + f[1] + f[2] < _ZERO, -_ONE, _ONE)
    f = wp.vec3d(wp.max(sign * f[0], _ZERO), wp.max(sign * f[1], _ZERO), wp.max(sign * f[2], _ZERO))
    return f, sign * e.x, sign * e.y


@wp.func
def total_of(v: wp.vec3d) -> wp.float64:
    return v[0] + v[1] + v[2]


def frame(height: int, width: int, space: str) -> Frame:
    """Creates the `Frame` of an image of the given size in pixels, for positions in the space "clip" or "uv"."""
    for name, size in (("height", height), ("width", width)):
        if not 1 <= size <= MOST_PIXELS:
            raise ValueError(f"{name}: expected 1 to {MOST_PIXELS} pixels, got {size}")
    out = Frame()
    out.height, out.width = height, width
    if space == "uv":
        out.x, out.y, out.y_step, out.scale = 1, 1, 2, 2
    else:
        out.x, out.y, out.y_step, out.scale = 1 - width, height - 1, -2, 1
    return out
