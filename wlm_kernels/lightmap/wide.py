"""Reads and writes vectors in one instruction on a GPU, where Warp's own accesses take one for each component.

Vectors must lie at multiples of their size, as they do in arrays that are not views into others at odd places.
"""

import warp as wp

from wlm_kernels.native import on_cuda

vec4l = wp.types.vector(4, wp.int64)
"""Four sums of a GPU, see `wlm_kernels.lightmap.adjoint`."""

_FOUR = """
    const float4 v = *reinterpret_cast<const float4*>(&wp::index(values, {at}));
    return wp::vec_t<4, float>(v.x, v.y, v.z, v.w);
"""
_TWO = """
    const float2 v = *reinterpret_cast<const float2*>(&wp::index(values, n, y, x));
    return wp::vec_t<2, float>(v.x, v.y);
"""
_TAKE = """
    longlong2* from = reinterpret_cast<longlong2*>(&wp::index(sums, 0, i));
    const longlong2 a = from[0], b = from[1];
    from[0] = from[1] = make_longlong2(0, 0);
    return wp::vec_t<4, float>(static_cast<float>(a.x), static_cast<float>(a.y), static_cast<float>(b.x),
                                static_cast<float>(b.y));
"""
_TAKE_EACH = """
    wp::vec_t<4, float> s;
    for (int c = 0; c < 4; ++c) {
        s.c[c] = static_cast<float>(wp::index(sums, 0, i).c[c]);
        wp::index(sums, 0, i).c[c] = 0;
    }
    return s;
"""
_WRITE = "*reinterpret_cast<float4*>(&wp::index(values, i)) = make_float4(v.c[0], v.c[1], v.c[2], v.c[3]);\n"


@wp.func_native(on_cuda(_FOUR.format(at="s, y, x, e"), "return wp::index(values, s, y, x, e);"))
def endpoint_at(values: wp.array4d[wp.vec4], s: int, y: int, x: int, e: int) -> wp.vec4: ...


@wp.func_native(on_cuda(_TWO, "return wp::index(values, n, y, x);"))
def two_at(values: wp.array3d[wp.vec2], n: int, y: int, x: int) -> wp.vec2: ...


@wp.func_native(on_cuda(_FOUR.format(at="i"), "return wp::index(values, i);"))
def four_at(values: wp.array1d[wp.vec4], i: int) -> wp.vec4: ...


@wp.func_native(on_cuda(_WRITE, "wp::index(values, i) = v;"))
def put_four(values: wp.array1d[wp.vec4], i: int, v: wp.vec4): ...


@wp.func_native(on_cuda(_TAKE, _TAKE_EACH))
def take_four(sums: wp.array2d[vec4l], i: int) -> wp.vec4:
    """Returns four sums of a GPU as floats and sets them to 0."""
