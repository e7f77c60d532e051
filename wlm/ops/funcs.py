"""Functions for use inside your own Warp kernels, with gradients under `wp.Tape`.

    plane, triplane, volume     feature grids, sampled linearly
    bc7_texel                   a texel of a block with trainable endpoints and weights
    gaussian_weight             the value of a 3D Gaussian at a point
    network                     a small network with two hidden layers; makes the function for given sizes

They compute what the operations of the same names compute for one point, in a kernel whose module has its backward pass
enabled (Warp's default). Nothing is checked. Gradients reach arrays that require one, also through slices such as
`values[i]`, and are exact to float32 unless a function says otherwise.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels import mlp as mlp_kernels
from wlm_kernels.lightmap.blocks import ste_endpoint, ste_mix, ste_weight
from wlm_kernels.raster.texture import Axis, axis_at, codes

_LINEAR, _CLAMP = (wp.constant(code) for code in codes("linear", "clamp"))
_WRAP = wp.constant(codes("linear", "wrap")[1])


@wp.func
def _axis(x: float, size: int, periodic: bool) -> Axis:
    return axis_at(x, size, _LINEAR, wp.where(periodic, _WRAP, _CLAMP))


@wp.func_grad(_axis)
def _axis_backward(x: float, size: int, periodic: bool, grad: Axis):
    wp.adjoint[x] += _axis(x, size, periodic).slope * grad.weight


@wp.func
def _mix(low: Any, high: Any, weight: float):
    return (1.0 - weight) * low + weight * high


@wp.func
def plane(values: wp.array2d[Any], uv: wp.vec2, periodic: bool):
    """Samples a plane of features bilinearly, like `wlm.ops.plane`.

    Args:
        values: [H, W] of floats or of vectors of floats, with a gradient; for layers, pass `values[layer]`.
        uv: u along the width and v along the height, both in [0, 1], with a gradient, the slope between two cells.
        periodic: Whether v wraps round; else it is clamped, as u always is.

    Returns:
        A value of the array's type.
    """
    x = _axis(uv[0], values.shape[1], False)
    y = _axis(uv[1], values.shape[0], periodic)
    low = _mix(values[y.low, x.low], values[y.low, x.high], x.weight)
    return _mix(low, _mix(values[y.high, x.low], values[y.high, x.high], x.weight), y.weight)


@wp.func
def volume(values: wp.array3d[Any], uvw: wp.vec3, periodic: bool):
    """Samples a volume of features trilinearly, like `wlm.ops.volume`.

    Args:
        values: [D, H, W] of floats or of vectors of floats, with a gradient.
        uvw: u along the width, v along the height, w along the depth, all in [0, 1]; with a gradient.
        periodic: Whether w wraps round; else it is clamped, as the others always are.

    Returns:
        A value of the array's type.
    """
    z = _axis(uvw[2], values.shape[0], periodic)
    uv = wp.vec2(uvw[0], uvw[1])
    return _mix(plane(values[z.low], uv, False), plane(values[z.high], uv, False), z.weight)


@wp.func
def triplane(xy: wp.array2d[Any], xz: wp.array2d[Any], yz: wp.array2d[Any], point: wp.vec3):
    """Sums the samples of three planes at the projections of a point, like `wlm.ops.triplane` with `reduce="sum"`.

    Args:
        xy, xz, yz: [H, W] each, of one type of floats or of vectors of floats; with gradients.
        point: x, y, z in [0, 1]; with a gradient.

    Returns:
        A value of the arrays' type.
    """
    on_xy = plane(xy, wp.vec2(point[0], point[1]), False)
    on_xz = plane(xz, wp.vec2(point[0], point[2]), False)
    return on_xy + on_xz + plane(yz, wp.vec2(point[1], point[2]), False)


@wp.func
def _texel(e0: wp.vec4, e1: wp.vec4, w: float, quantised: bool) -> wp.vec4:
    q = int(quantised)
    return ste_mix(ste_endpoint(e0, q), ste_endpoint(e1, q), ste_weight(w, q), q)


@wp.func_grad(_texel)
def _texel_backward(e0: wp.vec4, e1: wp.vec4, w: float, quantised: bool, grad: wp.vec4):
    # Clamping and rounding are straight-through.
    q = int(quantised)
    used = ste_weight(w, q)
    wp.adjoint[e0] += (1.0 - used) * grad
    wp.adjoint[e1] += used * grad
    wp.adjoint[w] += wp.dot(ste_endpoint(e1, q) - ste_endpoint(e0, q), grad)


@wp.func
def bc7_texel(
    endpoints: wp.array3d[wp.vec4], weights: wp.array2d[float], row: int, column: int, quantised: bool
) -> wp.vec4:
    """Decodes a texel of a map of BC7 blocks, like `wlm.ops.bc7_texels` (neural-dynamic-gi, eq. 8).

    Args:
        endpoints: [H/4, W/4, 2]: two RGBA colours per block, clamped to [0, 1] for use; with a gradient.
        weights: [H, W], one per texel, clamped likewise; with a gradient.
        row, column: The texel.
        quantised: Whether to round to the levels of BC7 mode 6; clamping and rounding are straight-through.
    """
    block = endpoints[row // 4, column // 4]
    return _texel(block[0], block[1], weights[row, column], quantised)


@wp.func
def gaussian_weight(centre: wp.vec3, log_scale: wp.vec3, rotation: wp.vec4, point: wp.vec3, cut: float) -> float:
    """Evaluates a 3D Gaussian at a point: exp(-|u|^2 / 2) with u = S^-1 R^T (x - centre).

    This is gaussian-probe-compression, eq. 2. Everything but `cut` has a gradient. For a Gaussian whose longest scale
    is r times its shortest one, u loses about 1e-7 r to rounding; `wlm.ops.gaussian_sum` doesn't.

    Args:
        centre: Centre, in the unit of the point.
        log_scale: Natural logarithm of the scale along each axis.
        rotation: Quaternion w x y z of any length; at length 0 it is the identity and has no gradient.
        point: The point x.
        cut: Radius in standard deviations along each axis outside which the result is 0.
    """
    q = wp.normalize(wp.quat(rotation[1], rotation[2], rotation[3], rotation[0]))
    u = wp.cw_mul(
        wp.quat_rotate_inv(q, point - centre),
        wp.vec3(wp.exp(-log_scale[0]), wp.exp(-log_scale[1]), wp.exp(-log_scale[2])),
    )
    d2 = wp.dot(u, u)
    return wp.where(d2 < cut * cut, wp.exp(-0.5 * d2), 0.0)


@dataclass(frozen=True)
class Network:
    """A network's function for use inside kernels, and its types.

    Attributes:
        evaluate: `wp.func` (hidden, output, n, x) -> y, the result of network n for one input, of type `vec_out`:
            `hidden` is an array [N, I + H + 2] of `vec_hidden`, `output` one [N, H + 1] of `vec_out`, and `x` of type
            `vec_in`: the memory of the arguments of `wlm.ops.mlp`. All three have gradients.
        vec_in, vec_hidden, vec_out: Vectors of I, H and O floats; one of three floats is `wp.vec3`.
    """

    evaluate: Any
    vec_in: Any
    vec_hidden: Any
    vec_out: Any


@functools.cache
def network(inputs: int, hidden: int, outputs: int, gelu: str = "exact") -> Network:
    """Makes (once) the function of networks of I inputs, two hidden layers of H units and O outputs: `wlm.ops.mlp`.

    Args:
        inputs, hidden, outputs: I, H and O, at least 1; H up to 64 is tested.
        gelu: "exact", "tanh" or "fast", see `wlm.ops.mlp`.
    """
    made = mlp_kernels.kernels(inputs, hidden, gelu, outputs)
    vec_in, vec_hidden, vec_out = made.vec_in, made.vec_hidden, made.vec_out
    first, second, third, gate, slope = made.first, made.second, made.third, made.gate, made.slope
    back_hidden, back_output, back_input = made.back_hidden, made.back_output, made.back_input
    second_row = inputs + 1

    @wp.func
    def evaluate(w: wp.array2d[vec_hidden], o: wp.array2d[vec_out], n: int, x: vec_in) -> vec_out:
        a1 = first(w, n, x)
        a2 = second(w, n, wp.cw_mul(a1, gate(a1)))
        return third(o, n, wp.cw_mul(a2, gate(a2)))

    @wp.func_grad(evaluate)
    def backward(w: wp.array2d[vec_hidden], o: wp.array2d[vec_out], n: int, x: vec_in, grad: vec_out):
        a1 = first(w, n, x)
        g1 = gate(a1)
        a2 = second(w, n, wp.cw_mul(a1, g1))
        g2 = gate(a2)
        d2 = wp.cw_mul(back_output(o, n, grad), slope(a2, g2))
        d1 = wp.cw_mul(back_hidden(w, n, d2), slope(a1, g1))
        wp.adjoint[x] += back_input(w, n, d1)
        for c in range(wp.static(inputs)):
            _add_gradient(w, wp.adjoint[w], n, c, x[c] * d1)
        _add_gradient(w, wp.adjoint[w], n, wp.static(inputs), d1)
        for c in range(wp.static(hidden)):
            _add_gradient(w, wp.adjoint[w], n, wp.static(second_row) + c, a1[c] * g1[c] * d2)
            _add_gradient(o, wp.adjoint[o], n, c, a2[c] * g2[c] * grad)
        _add_gradient(w, wp.adjoint[w], n, wp.static(second_row + hidden), d2)
        _add_gradient(o, wp.adjoint[o], n, wp.static(hidden), grad)

    return Network(evaluate, vec_in, vec_hidden, vec_out)


# A slice of an array knows its gradients itself, and has none as an adjoint.
@wp.func_native("""
    if (values.grad) wp::atomic_add(&wp::index_grad(values, i, j), value);
    else if (adjoint.data) wp::atomic_add(&wp::index(adjoint, i, j), value);
""")
def _add_gradient(values: wp.array2d[Any], adjoint: wp.array2d[Any], i: int, j: int, value: Any): ...
