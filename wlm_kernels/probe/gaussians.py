"""3D Gaussians with latent vectors, summed at points (gaussian-probe-compression, eq. 2 to 6), and their gradients.

A Gaussian is a row of 10 + L numbers: centre (3), log of the scale (3), quaternion w x y z (4), latent vector F_k (L).
With S = diag(scale), R the rotation and W = S^-1 R^T,

    F(x) = sum_k F_k w_k(x),   w_k(x) = exp(-|u|^2 / 2),   u = W_k (x - centre_k),   over the k that reach x.

Gaussian k reaches x if x is in its support, an ellipsoid or sphere with a radius in standard deviations. `Shape` has
the numbers that are computed once from a row. The backward pass sums the symmetric matrix a w u u^T and the vector a w
u over the points, where a is the scalar product of F_k and the loss's gradient with respect to F. `chain` converts the
sums to gradients of the row, without differences of large numbers. For very thin Gaussians u itself is a difference of
large numbers, and is computed in float64. The reference is `tests/reference/gaussians.py`.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

LATENT = 10  # first number of the latent in a row, after centre, log of the scale and rotation
SHAPE_NUMBERS = 9  # sums for the gradients of centre (3), scale and rotation (6)

# A shorter quaternion has no direction in float32: it is no rotation, and has no gradient.
_SHORTEST = wp.constant(1.0e-12)
# Ratio of the longest to the shortest scale above which u is computed in float64; float32 loses about 1e-7 times it.
_SLENDER = wp.constant(100.0)


@wp.struct
class Shape:
    """A Gaussian without its latent vector, prepared for evaluation.

    Attributes:
        centre: Centre, in the coordinates of the points.
        whiten: W = S^-1 R^T.
        rest: W minus its rounded value `whiten`, for Gaussians so thin that it matters; else 0.
        reach: Half the size of the support's bounding box along each axis.
        radius: Squared radius of a spherical support; 0 for an ellipsoid.
        slender: 1 for a Gaussian so thin that W (x - centre) needs float64, else 0.
    """

    centre: wp.vec3
    whiten: wp.mat33
    rest: wp.mat33
    reach: wp.vec3
    radius: float
    slender: int


@wp.func
def _unit(q: Any) -> Any:
    n = wp.length(q)
    if n < type(n)(_SHORTEST):
        return type(q)(type(n)(1.0), type(n)(0.0), type(n)(0.0), type(n)(0.0))
    return q / n


@wp.func
def _rotation(q: wp.vec4) -> wp.mat33:
    return wp.quat_to_matrix(wp.quat(q[1], q[2], q[3], q[0]))


@wp.func
def _rotation(q: wp.vec4d) -> wp.mat33d:
    return wp.quat_to_matrix(wp.quatd(q[1], q[2], q[3], q[0]))


@wp.func
def _log_scale(rows: wp.array2d[float], k: int) -> wp.vec3:
    return wp.vec3(rows[k, 3], rows[k, 4], rows[k, 5])


@wp.func
def _quaternion(rows: wp.array2d[float], k: int) -> wp.vec4:
    return wp.vec4(rows[k, 6], rows[k, 7], rows[k, 8], rows[k, 9])


@wp.func
def shape_of(rows: wp.array2d[float], k: int, cut: float, sphere: int) -> Shape:
    """Returns the `Shape` of one Gaussian.

    Args:
        rows: [K, 10 + L], parameters of the Gaussians.
        k: Index of the Gaussian.
        cut: Radius of the support in standard deviations.
        sphere: 1: the support is the sphere whose radius is the longest half axis (eq. 6); 0: the ellipsoid.
    """
    log_scale = _log_scale(rows, k)
    q = _quaternion(rows, k)
    s = wp.vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
    shape = Shape()
    shape.centre = wp.vec3(rows[k, 0], rows[k, 1], rows[k, 2])
    r = wp.mat33()
    if wp.max(log_scale) - wp.min(log_scale) > wp.log(_SLENDER):
        one = wp.float64(1.0)
        turn = _rotation(_unit(wp.vec4d(q)))
        exact = wp.mat33d()
        for a in range(3):
            factor = one / wp.exp(wp.float64(log_scale[a]))
            for b in range(3):
                exact[a, b] = turn[b, a] * factor
        shape.slender = 1
        shape.whiten = wp.mat33(exact)
        shape.rest = wp.mat33(exact - wp.mat33d(shape.whiten))
        r = wp.mat33(turn)
    else:
        r = _rotation(_unit(q))
        shape.whiten = wp.diag(wp.vec3(1.0 / s[0], 1.0 / s[1], 1.0 / s[2])) * wp.transpose(r)
    longest = wp.max(s)
    if sphere != 0:
        shape.reach = cut * wp.vec3(longest, longest, longest)
        shape.radius = cut * cut * longest * longest
    else:
        axes = r * wp.diag(s)
        shape.reach = cut * wp.vec3(wp.length(axes[0]), wp.length(axes[1]), wp.length(axes[2]))
    return shape


@wp.func
def _whitened(shape: Shape, x: wp.vec3) -> wp.vec3:
    if shape.slender != 0:
        r = wp.vec3d(x) - wp.vec3d(shape.centre)
        return wp.vec3((wp.mat33d(shape.whiten) + wp.mat33d(shape.rest)) * r)
    return shape.whiten * (x - shape.centre)


@wp.func
def _reaches(shape: Shape, x: wp.vec3, d2: float, cut: float) -> bool:
    if shape.radius > 0.0:
        return wp.length_sq(x - shape.centre) < shape.radius
    return d2 < cut * cut


@wp.func
def touches(shape: Shape, middle: wp.vec3, half: wp.vec3) -> bool:
    """Tests whether the bounding box of a Gaussian's support meets another box. `shape` is the Gaussian. `middle` and
    `half` are the other box's centre and half its size."""
    d = wp.abs(middle - shape.centre) - half
    return d[0] <= shape.reach[0] and d[1] <= shape.reach[1] and d[2] <= shape.reach[2]


@dataclass(frozen=True)
class GaussianFunctions:
    """The `wp.func`s on Gaussians with latent vectors of one length L; the module defines rows, F_k and w_k.

    `rows` is float [K, 10 + L], k an index, `shape` = `shape_of` that row, `cut` its reach in standard deviations.

    Attributes:
        vec_latent: vec of L floats.
        vec_sums: vec of 9 + L floats, the backward pass's sums over points.
        add: (f, shape, rows, k, x, cut) -> f plus F_k w_k(x).
        accumulate: (sums, shape, rows, k, x, grad_f, cut) -> `sums` plus the terms of point x.
        slope: (shape, rows, k, x, grad_f, cut) -> k's part of the gradient of x.
        chain: (sums, shape, rows, k) -> gradient of a row but for the latent, whose gradient is the last L sums.
    """

    vec_latent: Any
    vec_sums: Any
    add: Any
    accumulate: Any
    slope: Any
    chain: Any


_vec10 = wp.types.vector(LATENT, float)


@functools.cache
def functions(latent: int) -> GaussianFunctions:
    """Builds (once) the `wp.func`s for sums of Gaussians with latent vectors of this length, and for gradients."""
    vec_latent = wp.types.vector(latent, float)
    vec_sums = wp.types.vector(SHAPE_NUMBERS + latent, float)

    @wp.func
    def add(f: vec_latent, shape: Shape, rows: wp.array2d[float], k: int, x: wp.vec3, cut: float) -> vec_latent:
        u = _whitened(shape, x)
        d2 = wp.dot(u, u)
        if _reaches(shape, x, d2, cut):
            w = wp.exp(-0.5 * d2)
            for c in range(wp.static(latent)):
                f[c] = f[c] + w * rows[k, LATENT + c]
        return f

    @wp.func
    def accumulate(
        sums: vec_sums, shape: Shape, rows: wp.array2d[float], k: int, x: wp.vec3, g: vec_latent, cut: float
    ) -> vec_sums:
        u = _whitened(shape, x)
        d2 = wp.dot(u, u)
        if _reaches(shape, x, d2, cut):
            w = wp.exp(-0.5 * d2)
            a = float(0.0)
            for c in range(wp.static(latent)):
                a += g[c] * rows[k, LATENT + c]
                sums[SHAPE_NUMBERS + c] = sums[SHAPE_NUMBERS + c] + w * g[c]
            v = a * w * u
            for c in range(3):
                sums[c] = sums[c] + v[c]
                sums[3 + c] = sums[3 + c] + v[c] * u[c]
            sums[6] = sums[6] + v[1] * u[2]
            sums[7] = sums[7] + v[2] * u[0]
            sums[8] = sums[8] + v[0] * u[1]
        return sums

    @wp.func
    def slope(shape: Shape, rows: wp.array2d[float], k: int, x: wp.vec3, g: vec_latent, cut: float) -> wp.vec3:
        u = _whitened(shape, x)
        d2 = wp.dot(u, u)
        if not _reaches(shape, x, d2, cut):
            return wp.vec3()
        a = float(0.0)
        for c in range(wp.static(latent)):
            a += g[c] * rows[k, LATENT + c]
        return -a * wp.exp(-0.5 * d2) * (wp.transpose(shape.whiten) * u)

    @wp.func
    def chain(sums: vec_sums, shape: Shape, rows: wp.array2d[float], k: int) -> _vec10:
        log_scale = _log_scale(rows, k)
        q = _quaternion(rows, k)
        centre = wp.transpose(shape.whiten) * wp.vec3(sums[0], sums[1], sums[2])
        # A rotation by omega in the Gaussian's own axes changes u by -S^-1 [omega] S u.
        xy = wp.exp(log_scale[0] - log_scale[1])
        yz = wp.exp(log_scale[1] - log_scale[2])
        zx = wp.exp(log_scale[2] - log_scale[0])
        turn = wp.vec3(sums[6] * (yz - 1.0 / yz), sums[7] * (zx - 1.0 / zx), sums[8] * (xy - 1.0 / xy))
        n = wp.length(q)
        dq = wp.vec4()
        if n >= _SHORTEST:
            # For a unit q, dq = q (0, omega) / 2; the gradient has no component along q.
            h = q / n
            v = wp.vec3(h[1], h[2], h[3])
            vector = h[0] * turn + wp.cross(v, turn)
            dq = wp.vec4(-wp.dot(v, turn), vector[0], vector[1], vector[2]) * (2.0 / n)
        g = _vec10()
        for c in range(3):
            g[c] = centre[c]
            g[3 + c] = sums[3 + c]
        for c in range(4):
            g[6 + c] = dq[c]
        return g

    return GaussianFunctions(vec_latent, vec_sums, add, accumulate, slope, chain)
