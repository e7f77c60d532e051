"""Feature maps stored as BC7 mode 6 blocks: evaluates and quantises them in training, and decodes stored blocks.

A map of 4 channels is cut into blocks of 4x4 texels. A block has two endpoints `e0, e1` in [0, 1]^4 and one
weight in [0, 1] per texel; a texel is `(1 - w) e0 + w e1` (neural-dynamic-gi, eq. 7 and 8). BC7 mode 6 stores the
endpoints with 7 bits a channel plus one lowest bit shared by the four channels, and the weights with 4 bits.

With `quantised` 1, endpoints and weights are rounded to these levels, so that training sees the texels of the file. The
adjoint is straight-through: each rounding has derivative 1, and values outside [0, 1] keep their gradient, so that Adam
can bring them back. `benchmarks.plain.bc7_texels` is the same in a few lines of torch.

Arrays: endpoints `[S, H/4, W/4, 2]` of vec4, weights `[S, H, W]`, where S counts slices (tiles, or tiles x
times). Blocks of the file are `[S, H/4, W/4, 2]` of uint64, the low and the high half of 16 little-endian bytes.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def weight_index(w: float) -> int:
    """Returns the 4-bit index of the BC7 weight nearest to w; index i means the weight ((64 i + 7) // 15) / 64."""
    return int(wp.floor(wp.clamp(w, 0.0, 1.0) * 15.0 + 0.5))


@wp.func
def index_level(index: int) -> int:
    return (index * 64 + 7) // 15


@wp.func
def ste_weight(w: float, quantised: int) -> float:
    """Returns w clamped to [0, 1], or if quantised the nearest BC7 weight. The adjoint takes the derivative as 1."""
    if quantised == 0:
        return wp.clamp(w, 0.0, 1.0)
    return float(index_level(weight_index(w))) / 64.0


@wp.func
def endpoint_with_bit(v: wp.vec4, bit: float) -> wp.vec4:
    q = wp.vec4()
    for c in range(4):
        q[c] = wp.clamp(wp.floor((v[c] - bit) * 0.5 + 0.5), 0.0, 127.0) * 2.0 + bit
    return q


@wp.func
def endpoint_byte(e: wp.vec4) -> wp.vec4:
    """Returns the stored bytes of an endpoint as floats 0 to 255, with the shared lowest bit that gives less error."""
    v = wp.vec4(
        wp.clamp(e[0], 0.0, 1.0) * 255.0,
        wp.clamp(e[1], 0.0, 1.0) * 255.0,
        wp.clamp(e[2], 0.0, 1.0) * 255.0,
        wp.clamp(e[3], 0.0, 1.0) * 255.0,
    )
    even = endpoint_with_bit(v, 0.0)
    odd = endpoint_with_bit(v, 1.0)
    if wp.length_sq(odd - v) < wp.length_sq(even - v):
        return odd
    return even


@wp.func
def ste_endpoint(e: wp.vec4, quantised: int) -> wp.vec4:
    """Returns e clamped to [0, 1], or if quantised its stored bytes / 255. The adjoint takes the derivative as 1."""
    if quantised == 0:
        return wp.vec4(
            wp.clamp(e[0], 0.0, 1.0),
            wp.clamp(e[1], 0.0, 1.0),
            wp.clamp(e[2], 0.0, 1.0),
            wp.clamp(e[3], 0.0, 1.0),
        )
    return over_255(endpoint_byte(e))


@wp.func
def nearest(x: float) -> float:
    """Returns the integer nearest to x, at most 2^22 in size. On a GPU additions are faster than the function floor."""
    return (x + 12582912.0) - 12582912.0


@wp.func
def over_255(v: wp.vec4) -> wp.vec4:
    """Returns v / 255 of bytes to the last bit, without a division: the first factor has 16 bits, its products are
    exact."""
    return v * 0.003921627998352051 - v * 5.9370901084321304e-8


@wp.func
def byte_mix(a: float, b: float, w: float) -> float:
    """Returns BC7's integer interpolation of two bytes with a weight in 64ths, exact in float32."""
    # Of floor((n + 32) / 64), since n is an integer.
    return nearest(((64.0 - w) * a + w * b + 0.5) / 64.0)


@wp.func
def ste_mix(e0: wp.vec4, e1: wp.vec4, w: float, quantised: int) -> wp.vec4:
    """Returns (1 - w) e0 + w e1 (eq. 8); when quantised, rounded to bytes as the hardware decoder does."""
    if quantised == 0:
        return (1.0 - w) * e0 + w * e1
    # e * 255 is an integer up to float rounding, and w * 64 is one.
    a = e0 * 255.0
    b = e1 * 255.0
    q = wp.vec4()
    for c in range(4):
        q[c] = byte_mix(nearest(a[c]), nearest(b[c]), w * 64.0)
    return over_255(q)


@wp.func
def bits7(word: wp.uint64, at: int) -> float:
    return float(int(wp.rshift(word, wp.uint64(at)) & wp.uint64(127)))


@wp.func
def stored_texel(blocks: wp.array4d[wp.uint64], s: int, y: int, x: int) -> wp.vec4:
    """Decodes the texel (y, x) of slice s of a map that is stored as BC7 mode 6 blocks; channels are in [0, 1]."""
    low = blocks[s, y // 4, x // 4, 0]
    high = blocks[s, y // 4, x // 4, 1]
    p0 = float(int(wp.rshift(low, wp.uint64(63))))
    p1 = float(int(high & wp.uint64(1)))
    i = (y % 4) * 4 + x % 4
    index = int(wp.rshift(high, wp.uint64(4 * i)) & wp.uint64(15))
    if i == 0:  # the anchor has 3 bits, its top bit is always 0; bit 0 of the word is P1
        index = int(wp.rshift(high, wp.uint64(1)) & wp.uint64(7))
    k = float(index_level(index))
    return (
        wp.vec4(
            byte_mix(bits7(low, 7) * 2.0 + p0, bits7(low, 14) * 2.0 + p1, k),
            byte_mix(bits7(low, 21) * 2.0 + p0, bits7(low, 28) * 2.0 + p1, k),
            byte_mix(bits7(low, 35) * 2.0 + p0, bits7(low, 42) * 2.0 + p1, k),
            byte_mix(bits7(low, 49) * 2.0 + p0, bits7(low, 56) * 2.0 + p1, k),
        )
        / 255.0
    )


@wp.kernel
def _reconstruct(
    # in:
    endpoints: wp.array4d[wp.vec4],
    weights: wp.array3d[float],
    quantised: int,
    # out:
    out: wp.array3d[wp.vec4],
):
    s, y, x = wp.tid()
    e0, e1 = endpoints[s, y // 4, x // 4, 0], endpoints[s, y // 4, x // 4, 1]
    w = ste_weight(weights[s, y, x], quantised)
    out[s, y, x] = ste_mix(ste_endpoint(e0, quantised), ste_endpoint(e1, quantised), w, quantised)


@wp.kernel
def _reconstruct_backward(
    # in:
    endpoints: wp.array4d[wp.vec4],
    weights: wp.array3d[float],
    quantised: int,
    grad_out: wp.array3d[wp.vec4],
    # out:
    grad_endpoints: wp.array4d[wp.vec4],
    grad_weights: wp.array3d[float],
):
    # One block per thread: its sums have a fixed order, and no two threads write to one number.
    s, row, column = wp.tid()
    e0 = ste_endpoint(endpoints[s, row, column, 0], quantised)
    e1 = ste_endpoint(endpoints[s, row, column, 1], quantised)
    on_e0 = wp.vec4()
    on_e1 = wp.vec4()
    for i in range(16):
        y = 4 * row + i // 4
        x = 4 * column + i % 4
        w = ste_weight(weights[s, y, x], quantised)
        g = grad_out[s, y, x]
        on_e0 += (1.0 - w) * g
        on_e1 += w * g
        grad_weights[s, y, x] = wp.dot(e1 - e0, g)
    grad_endpoints[s, row, column, 0] = on_e0
    grad_endpoints[s, row, column, 1] = on_e1


@wp.kernel
def _quantise(
    # in:
    endpoints: wp.array4d[wp.vec4],
    weights: wp.array3d[float],
    # out:
    bytes_out: wp.array4d[wp.vec4ub],
    index_out: wp.array3d[wp.uint8],
):
    s, y, x = wp.tid()
    index_out[s, y, x] = wp.uint8(weight_index(weights[s, y, x]))
    if x % 4 == 0 and y % 4 < 2:  # two of a block's texels write one endpoint each
        q = endpoint_byte(endpoints[s, y // 4, x // 4, y % 4])
        bytes_out[s, y // 4, x // 4, y % 4] = wp.vec4ub(wp.uint8(q[0]), wp.uint8(q[1]), wp.uint8(q[2]), wp.uint8(q[3]))


def reconstruct(endpoints, weights, out, quantised: bool = False) -> None:
    """Writes all texels of a map, S slices of H x W texels, from its endpoints and weights (eq. 8).

    Args:
        endpoints: vec4 [S, H/4, W/4, 2], in [0, 1].
        weights: float [S, H, W], in [0, 1].
        out: vec4 [S, H, W], written.
        quantised: Whether endpoints and weights are rounded to the levels of BC7 mode 6.
    """
    inputs = [endpoints, weights, int(quantised)]
    wp.launch(_reconstruct, weights.shape, inputs=inputs, outputs=[out], device=weights.device)


def reconstruct_backward(endpoints, weights, grad_out, grad_endpoints, grad_weights, quantised: bool = False) -> None:
    """Computes gradients from the gradient of a result of `reconstruct`; clamping and rounding count as the identity.

    The gradients are the same in every run.

    Args:
        endpoints, weights, quantised: As for `reconstruct`.
        grad_out: vec4 [S, H, W], gradient of the result.
        grad_endpoints: vec4 [S, H/4, W/4, 2], written.
        grad_weights: float [S, H, W], written.
    """
    inputs = [endpoints, weights, int(quantised), grad_out]
    outputs = [grad_endpoints, grad_weights]
    wp.launch(_reconstruct_backward, endpoints.shape[:3], inputs=inputs, outputs=outputs, device=weights.device)


def quantise(endpoints, weights, bytes_out, index_out) -> None:
    """Writes the integers that the file stores for the endpoints and weights of S slices of H x W texels.

    Args:
        endpoints: vec4 [S, H/4, W/4, 2], in [0, 1].
        weights: float [S, H, W], in [0, 1].
        bytes_out: vec4ub [S, H/4, W/4, 2], written: each endpoint's bytes with their shared lowest bit.
        index_out: uint8 [S, H, W], written: each weight's index, 0 to 15.
    """
    wp.launch(
        _quantise,
        weights.shape,
        inputs=[endpoints, weights],
        outputs=[bytes_out, index_out],
        device=weights.device,
    )
