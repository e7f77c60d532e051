"""Sums Gaussians at any points, and computes the gradients (gaussian-probe-compression, eq. 2 to 6, 11 and 12).

With `cubes` a point only evaluates the Gaussians that its cube lists, with the same result as from all Gaussians.
`backward` computes the gradient with respect to the Gaussians: a thread adds up one Gaussian's gradient over the points
of all cubes within the Gaussian's reach. `backward_points` computes the gradient with respect to the points, one per
thread. There are no atomic additions. The gradients treat the set of Gaussians that reach a point as constant. The
reference is `benchmarks.plain.gaussian_sum`; for probes that do not move, `step` trains faster.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.probe.cubes import REACH_MARGIN, Cubes, cube_of, everything, sort_by_cube, span
from wlm_kernels.probe.gaussians import LATENT, SHAPE_NUMBERS, Shape, functions, shape_of, touches

wp.set_module_options({"enable_backward": False})

SUPPORTS = ("ellipsoid", "sphere")


@wp.kernel
def _shapes(
    # in:
    rows: wp.array2d[float],
    cut: float,
    sphere: int,
    # out:
    out: wp.array1d[Shape],
):
    k = wp.tid()
    out[k] = shape_of(rows, k, cut, sphere)


@wp.kernel
def _cubes_of(
    # in:
    cubes: Cubes,
    x: wp.array1d[wp.vec3],
    # out:
    keys: wp.array1d[int],
    items: wp.array1d[int],
):
    i = wp.tid()
    keys[i] = cube_of(cubes, x[i])
    items[i] = i


@dataclass(frozen=True)
class _Kernels:
    forward: Any
    backward: Any
    backward_points: Any


@functools.cache
def sum_kernels(latent: int) -> _Kernels:
    """Builds (once) the kernels that sum Gaussians at points, and its gradients, for latent vectors of one length."""
    fn = functions(latent)
    vec_latent, vec_sums = fn.vec_latent, fn.vec_sums
    add, accumulate, chain, slope = fn.add, fn.accumulate, fn.chain, fn.slope
    options = {"enable_backward": False, "max_unroll": 32}

    @wp.kernel(module="unique", module_options=options)
    def forward(
        # in:
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        x: wp.array1d[wp.vec3],
        cut: float,
        # out:
        f: wp.array2d[float],
    ):
        i = wp.tid()
        cube = cube_of(cubes, x[i])
        s = vec_latent()
        for j in range(cubes.start[cube], cubes.start[cube + 1]):
            k = cubes.item[j]
            s = add(s, shapes[k], rows, k, x[i], cut)
        for c in range(wp.static(latent)):
            f[c, i] = s[c]

    @wp.kernel(module="unique", module_options=options)
    def backward(
        # in:
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        order: wp.array1d[int],
        start: wp.array1d[int],
        x: wp.array1d[wp.vec3],
        cut: float,
        grad_f: wp.array2d[float],
        # out:
        grad: wp.array2d[float],
    ):
        k = wp.tid()
        shape = shapes[k]
        first, last = span(cubes, shape.centre, shape.reach)
        sums = vec_sums()
        for a in range(first[0], last[0] + 1):
            for b in range(first[1], last[1] + 1):
                # Cubes along the last axis are neighbours in memory, and so are their points.
                row = (a * cubes.counts[1] + b) * cubes.counts[2]
                for j in range(start[row + first[2]], start[row + last[2] + 1]):
                    i = order[j]
                    # Most points are out of reach: a loose test comes before their gradients are loaded.
                    if touches(shape, x[i], REACH_MARGIN * shape.reach):
                        g = vec_latent()
                        for c in range(wp.static(latent)):
                            g[c] = grad_f[c, i]
                        sums = accumulate(sums, shape, rows, k, x[i], g, cut)
        head = chain(sums, shape, rows, k)
        for c in range(wp.static(LATENT)):
            grad[k, c] = head[c]
        for c in range(wp.static(latent)):
            grad[k, LATENT + c] = sums[SHAPE_NUMBERS + c]

    @wp.kernel(module="unique", module_options=options)
    def backward_points(
        # in:
        rows: wp.array2d[float],
        shapes: wp.array1d[Shape],
        cubes: Cubes,
        x: wp.array1d[wp.vec3],
        cut: float,
        grad_f: wp.array2d[float],
        # out:
        grad: wp.array1d[wp.vec3],
    ):
        i = wp.tid()
        cube = cube_of(cubes, x[i])
        g = vec_latent()
        for c in range(wp.static(latent)):
            g[c] = grad_f[c, i]
        total = wp.vec3()
        for j in range(cubes.start[cube], cubes.start[cube + 1]):
            k = cubes.item[j]
            total += slope(shapes[k], rows, k, x[i], g, cut)
        grad[i] = total

    return _Kernels(forward, backward, backward_points)


def shapes(rows, cut: float, support: str = "ellipsoid"):
    """Builds the `Shape` of each Gaussian.

    Args:
        rows: float [K, 10 + L], parameters of the K Gaussians, see `gaussians`.
        cut: Radius of a support, outside which a Gaussian is 0, in standard deviations.
        support: "ellipsoid", or "sphere": the sphere whose radius is the longest half axis (eq. 6).

    Returns:
        Shape [K].
    """
    out = wp.empty(rows.shape[0], dtype=Shape, device=rows.device)
    wp.launch(_shapes, out.shape, inputs=[rows, cut, SUPPORTS.index(support)], outputs=[out], device=rows.device)
    return out


def sum(rows, shapes, cubes, x, f, cut: float) -> None:
    """Computes F(x), the sum of F_k w_k(x) over the Gaussians that reach x (eq. 5): F_k is the latent vector of
    Gaussian k, w_k(x) its value at x.

    The lists of `cubes` do not change the result, not even its last bit, unless a list lacks a Gaussian that reaches a
    point of its cube.

    Args:
        rows: float [K, 10 + L], parameters of the K Gaussians, see `gaussians`.
        shapes: Shape [K], made from the rows with this cut.
        cubes: `cubes.Cubes` of the shapes; None: every point evaluates all Gaussians.
        x: vec3 [N], the points; no Gaussian reaches a point that is NaN.
        f: float [L, N], the sums F(x), written.
        cut: Radius of a support in standard deviations.
    """
    cubes = cubes or everything(rows.shape[0], rows.device)
    kernel = sum_kernels(rows.shape[1] - LATENT).forward
    wp.launch(kernel, x.shape, inputs=[rows, shapes, cubes, x, cut], outputs=[f], device=rows.device)


def backward(rows, shapes, cubes, x, grad_f, grad, cut: float) -> None:
    """Computes the gradient of `sum` with respect to the Gaussians' rows.

    Args:
        rows, shapes, cubes, x, cut: As for `sum`.
        grad_f: float [L, N], gradient of the loss with respect to `f`.
        grad: float [K, 10 + L], written: gradient with respect to `rows`.
    """
    device, count = rows.device, x.shape[0]
    cubes = cubes or everything(rows.shape[0], device)
    kernel = sum_kernels(rows.shape[1] - LATENT).backward
    total = cubes.start.shape[0] - 1
    keys, order = (wp.empty(2 * count, dtype=int, device=device) for _ in range(2))
    start = wp.empty(total + 1, dtype=int, device=device)
    wp.launch(_cubes_of, count, inputs=[cubes, x], outputs=[keys, order], device=device)
    sort_by_cube(keys, order, count, total, start)
    inputs = [rows, shapes, cubes, order, start, x, cut, grad_f]
    wp.launch(kernel, rows.shape[0], inputs=inputs, outputs=[grad], device=device)


def backward_points(rows, shapes, cubes, x, grad_f, grad, cut: float) -> None:
    """Computes the gradient of `sum` with respect to its points. `rows`, `shapes`, `cubes`, `x`, `grad_f` and `cut` are
    as for `backward`. `grad` is vec3 [N], written: the gradient with respect to `x`."""
    cubes = cubes or everything(rows.shape[0], rows.device)
    kernel = sum_kernels(rows.shape[1] - LATENT).backward_points
    wp.launch(kernel, x.shape, inputs=[rows, shapes, cubes, x, cut, grad_f], outputs=[grad], device=rows.device)
