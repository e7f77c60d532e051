"""Parts of a NAFBlock other than its matrix products, for one image stored as rows of channels, one row per pixel.

`kernels` builds them for a number of channels and for float32 or half floats; sums are always float32. There are no
gradients: networks are trained in torch. Read `NafBlock` of `wlm/smoke/network/unet.py` first, the block in torch.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

STRIP = 4
"""Number of vertically adjacent pixels that one thread of `gate` computes."""

_EPSILON = 1e-6
_WARP = 32
_PER_LANE = 4


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Not the mask of active threads: after a branch some threads of the group may not be active yet.
    const unsigned first = (threadIdx.x % 32) / count * count;
    const unsigned group = (0xffffffffu >> (32 - count)) << first;
    for (int step = count / 2; step > 0; step /= 2)
        value += __shfl_xor_sync(group, value, step, count);
#endif
    return value;
""")
def lane_sum(value: float, count: int) -> float:
    """Sums a value over a group of `count` threads, a power of 2 up to 32; on a CPU returns the value itself."""
    ...


def lanes(channels: int, cuda: bool) -> int:
    """Returns the number of threads that share the channels of a pixel: a power of 2 up to 32 on a GPU, 1 on a CPU."""
    if not cuda:
        return 1
    count = -(-channels // _PER_LANE)
    return min(_WARP, 1 << (count - 1).bit_length())


@dataclass(frozen=True)
class NafKernels:
    """The kernels for numbers of type T (float32 or half). Each description begins with the launch size.

    P pixels of G images (for `gate` one image of H x W pixels) have rows of C channels, which L threads share.

    Attributes:
        norm: [P L]: adds a shift to each row, subtracts the mean and divides by the standard deviation. In: x T [P, C],
            shift float [G, C] for each P / G rows, and the number P / G. Out: T [P, C].
        gate: [ceil(H / STRIP), W, C]: a depthwise 3 x 3 convolution with zeros outside; then the product of the first
            half of the channels with the second. In: x T [H, W, 2 C], weights float [9, 2 C],
            biases float [2 C]. Out: T [H, W, C].
        attend: [G c L]: scales the weights of a matrix product of c channels by channel attention: by a factor for each
            input channel, a linear function of all channels' means. In: means float [G c], weights float [G, c, c] and
            biases float [G, c] of the attention, weights of the product float [G, c, c], from input to output.
            Out: T [G, c, c].
    """

    norm: wp.Kernel
    gate: wp.Kernel
    attend: wp.Kernel


@functools.cache
def kernels(channels: int, half: bool, cuda: bool) -> NafKernels:
    """Builds (once) the kernels of NAF blocks, for pixels of `channels` half floats or float32, on a GPU or a CPU."""
    number: Any = wp.float16 if half else wp.float32
    count = lanes(channels, cuda)
    each = -(-channels // count)
    share = wp.types.vector(each, wp.float32)

    @wp.kernel(enable_backward=False, module="unique")
    def norm(
        # in:
        x: wp.array2d[number],
        shift: wp.array2d[float],
        rows: int,
        # out:
        out: wp.array2d[number],
    ):
        i = wp.tid()
        p = i // wp.static(count)
        first = (i % wp.static(count)) * wp.static(each)
        g = p // rows
        value = share()
        mean = float(0.0)
        for k in range(wp.static(each)):
            c = first + k
            if c < wp.static(channels):
                value[k] = float(x[p, c]) + shift[g, c]
                mean += value[k]
        mean = lane_sum(mean, wp.static(count)) * wp.static(1.0 / channels)
        square = float(0.0)
        for k in range(wp.static(each)):
            if first + k < wp.static(channels):
                value[k] = value[k] - mean
                square += value[k] * value[k]
        square = lane_sum(square, wp.static(count)) * wp.static(1.0 / channels)
        inverse = 1.0 / wp.sqrt(square + wp.static(_EPSILON))
        for k in range(wp.static(each)):
            c = first + k
            if c < wp.static(channels):
                out[p, c] = number(value[k] * inverse)

    @wp.kernel(enable_backward=False, module="unique")
    def gate(
        # in:
        x: wp.array3d[number],
        weight: wp.array2d[float],
        bias: wp.array1d[float],
        # out:
        out: wp.array3d[number],
    ):
        strip, column, c = wp.tid()
        row = strip * wp.static(STRIP)
        d = c + out.shape[2]
        left = wp.vec4(bias[c])
        right = wp.vec4(bias[d])
        for j in range(3):
            q = column + j - 1
            across = float(q >= 0 and q < x.shape[1])
            q = wp.clamp(q, 0, x.shape[1] - 1)
            for i in range(wp.static(STRIP + 2)):
                r = row + i - 1
                # A factor instead of a branch: all loads are issued at once.
                inside = across * float(r >= 0 and r < x.shape[0])
                r = wp.clamp(r, 0, x.shape[0] - 1)
                a = inside * float(x[r, q, c])
                b = inside * float(x[r, q, d])
                for k in range(wp.static(STRIP)):
                    if i - k >= 0 and i - k < 3:
                        left[k] = left[k] + weight[3 * (i - k) + j, c] * a
                        right[k] = right[k] + weight[3 * (i - k) + j, d] * b
        for k in range(wp.static(STRIP)):
            if row + k < out.shape[0]:
                out[row + k, column, c] = number(left[k] * right[k])

    @wp.kernel(enable_backward=False, module="unique")
    def attend(
        # in:
        mean: wp.array1d[float],
        weight: wp.array3d[float],
        bias: wp.array2d[float],
        product: wp.array3d[float],
        # out:
        out: wp.array3d[number],
    ):
        t = wp.tid()
        lane = t % wp.static(count)
        g = t // wp.static(count) // wp.static(channels)
        i = t // wp.static(count) % wp.static(channels)
        factor = float(0.0)
        for k in range(wp.static(each)):
            c = lane + k * wp.static(count)
            if c < wp.static(channels):
                factor += weight[g, i, c] * mean[g * wp.static(channels) + c]
        factor = bias[g, i] + lane_sum(factor, wp.static(count))
        for k in range(wp.static(each)):
            o = lane + k * wp.static(count)
            if o < wp.static(channels):
                out[g, i, o] = number(factor * product[g, i, o])

    return NafKernels(norm, gate, attend)
