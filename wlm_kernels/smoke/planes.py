"""Encoding of the network's input and decoding of its output, each in one pass over the image.

`encode_six` converts the images of the coarse march (`marches.coarse_six_way`) into the network's input, the guide;
`decode` converts the network's output into light. `kernels` builds the kernels that add, near smoke, the outputs of the
network's heads and a filtered guide; sums are always float32. There are no gradients: networks are trained in torch.
Read first: `encode_guide`, `encode_lightmaps` and `decode_lightmaps` of `wlm/smoke/network/planes.py` for the
encodings, and `_wanted` of `tests/kernels/test_six_planes.py`, which is `compose` in a few lines of torch.
"""

import functools
from dataclasses import dataclass
from typing import Any

import warp as wp

from wlm_kernels.smoke import marches
from wlm_kernels.smoke.naf_block import lane_sum

LIGHTS = 6
"""Number of planes of light, which come first; they may exceed 1, the other planes may not."""

PLANES = LIGHTS + 2
"""Number of planes of the network's output: the lights, opacity and emission."""

STRIP = 4
"""Number of vertically adjacent pixels that one thread of `compose` computes."""

Taps = wp.types.vector(PLANES, wp.float32)
"""Weights by which a pixel of one plane of the guide adds to each output plane."""

FOOT, FOOT_CODE = 0.0031308, 0.04045
"""End of the linear part of sRGB's curve (IEC 61966-2-1), in linear light and encoded."""

_OPTIONS = {"enable_backward": False}
_BOUNDS = (256, 2)  # threads per block and blocks per multiprocessor: without it registers limit the occupancy to half
_HALF_MAX = 65504.0
_TRANSPARENCY, _EMISSION = (marches.PLANES.index(name) for name in ("transparency", "emission"))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Two wide loads: the compiler does not know that the weights are aligned.
    const float4* wide = reinterpret_cast<const float4*>(weights.data + i);
    const float4 a = __ldg(wide), b = __ldg(wide + 1);
    wp::vec_t<8, float> taps;
    taps.c[0] = a.x; taps.c[1] = a.y; taps.c[2] = a.z; taps.c[3] = a.w;
    taps.c[4] = b.x; taps.c[5] = b.y; taps.c[6] = b.z; taps.c[7] = b.w;
    return taps;
#else
    return weights.data[i];
#endif
""")
def _load(weights: wp.array1d[Taps], i: int) -> Taps:
    """Loads element i; the array must begin at a multiple of 16 bytes, so that the GPU loads it at once."""
    ...


@wp.func
def _srgb(linear: float) -> float:
    """Encodes linear light by sRGB's curve, continued above 1; values below 0 count as 0."""
    if linear <= FOOT:
        return 12.92 * wp.max(linear, 0.0)
    return 1.055 * wp.pow(linear, 1.0 / 2.4) - 0.055


@wp.func
def _linear(code: float) -> float:
    """Decodes sRGB values to linear light, the inverse of `_srgb`; values below 0 count as 0."""
    if code <= FOOT_CODE:
        return wp.max(code, 0.0) / 12.92
    return wp.pow((code + 0.055) / 1.055, 2.4)


@wp.func
def _at_most_one(value: float) -> float:
    """Clamps to 1 and keeps NaN, which `wp.min` would turn into 1."""
    return wp.where(value > 1.0, 1.0, value)


@wp.func
def _at_least_zero(value: float) -> float:
    """Clamps to 0 and keeps NaN, which `wp.max` would turn into 0."""
    return wp.where(value < 0.0, 0.0, value)


@wp.kernel(module="unique", module_options=_OPTIONS)
def _encode_six(
    # in:
    planes: wp.array3d[float],
    far: float,
    length: float,
    hot: bool,
    # out:
    out: wp.array3d[float],
):
    row, column = wp.tid()
    for k in range(wp.static(LIGHTS)):
        out[k, row, column] = _srgb(planes[k, row, column])
    glow = float(0.0)
    if hot:
        glow = _at_least_zero(planes[wp.static(_EMISSION), row, column])
    out[wp.static(LIGHTS), row, column] = _srgb(glow / (1.0 + glow))
    out[wp.static(LIGHTS + 1), row, column] = 1.0 - planes[wp.static(_TRANSPARENCY), row, column]
    depth = planes[wp.static(marches.DEPTH), row, column]
    share = _at_most_one(_at_least_zero((far - depth) / length))
    out[wp.static(LIGHTS + 2), row, column] = share * float(depth > 0.0)


def encode_six(planes: wp.array, near: float, far: float, hot: bool, out: wp.array) -> None:
    """Encodes the images of the coarse march as the network's input.

    Args:
        planes: float [9, H, W], the images `marches.PLANES`.
        near, far: Distances at which the smoke begins and ends, near < far, in the unit of the depth image.
        hot: Whether the smoke emits light; otherwise the emission is written as 0.
        out: float [9, H, W], written: six lights in sRGB; emission e as e / (1 + e) in sRGB; opacity; depth, from 1 at
            distance `near` to 0 at distance `far`, and 0 where there is no surface. NaN stays NaN.
    """
    inputs = [planes, far, far - near, hot]
    wp.launch(_encode_six, planes.shape[1:], inputs=inputs, outputs=[out], device=planes.device)


@wp.kernel(module="unique", module_options=_OPTIONS)
def _decode(
    # in:
    planes: wp.array3d[float],
    # out:
    out: wp.array3d[float],
):
    row, column = wp.tid()
    for k in range(wp.static(LIGHTS)):
        out[k, row, column] = _linear(planes[k, row, column])
    opacity = planes[wp.static(LIGHTS), row, column]
    out[wp.static(LIGHTS), row, column] = 1.0 - _at_most_one(_at_least_zero(opacity))
    share = _linear(planes[wp.static(LIGHTS + 1), row, column])
    most = wp.static(_HALF_MAX / (1.0 + _HALF_MAX))
    out[wp.static(LIGHTS + 1), row, column] = wp.where(share > most, _HALF_MAX, share / (1.0 - share))


def decode(planes: wp.array, out: wp.array) -> None:
    """Decodes the network's output, float [PLANES, H, W], six lights in sRGB, opacity, and emission e as e / (1 + e) in
    sRGB, into six lights, transparency, and emission, at most the largest half float. Values outside the range of an
    image are clamped to it; NaN stays NaN."""
    wp.launch(_decode, planes.shape[1:], inputs=[planes], outputs=[out], device=planes.device)


@dataclass(frozen=True)
class PlaneKernels:
    """The kernels for numbers of type T (float32 or half). Each description begins with the launch size.

    The guide is the network's input, C images T [C, H, W]; opacity and depth are the last two.

    Attributes:
        lanes: Number of threads L of `near` that share a block.
        near: [blocks L]: finds whether there is smoke in each block of reach x reach pixels. In: the guide.
            Out: int [ceil(H / reach), ceil(W / reach)], 0 or 1. A NaN is no smoke.
        compose: [ceil(H / STRIP), W]: adds the heads' outputs and the filtered guide, and clamps each image to its
            range. The result is 0 where neither a block nor one of its eight neighbours has smoke; elsewhere NaN stays
            NaN. In: the N outputs of the heads of each of G groups, T [G, ceil(H / stem), ceil(W / stem), N] or larger,
            where an output pixel has stem x stem pixels of the image; the guide; weights Taps [c edge edge] of a filter
            of the guide's first c images, column by column for each image, aligned to 16 bytes, with zeros outside the
            image; for each image its group and the first of its stem x stem outputs, int [PLANES, 2]; stem; the result
            of `near`. Out: float [PLANES, H, W].
    """

    lanes: int
    near: wp.Kernel
    compose: wp.Kernel


@functools.cache
def kernels(edge: int, reach: int, half: bool, cuda: bool) -> PlaneKernels:
    """Builds (once) the kernels for half floats or float32, on a GPU or a CPU, for a filter with an odd edge of at most
    15 pixels and blocks with an edge `reach` of 4, 8, 16 or 32 pixels."""
    if edge not in range(1, 16, 2):
        raise ValueError(f"edge: expected an odd number of pixels from 1 to 15, got {edge}")
    if reach not in (4, 8, 16, 32):
        raise ValueError(f"reach: expected 4, 8, 16 or 32 pixels, got {reach}")
    number: Any = wp.float16 if half else wp.float32
    # Neighbouring threads read neighbouring pixels. With one thread per block, neighbouring threads would read pixels a
    # block's width apart; maxima by atomics would need another launch that clears them.
    count = reach if cuda else 1
    column_type = wp.types.vector(STRIP + edge - 1, wp.float32)
    sums = wp.types.matrix((STRIP, PLANES), wp.float32)
    middle = edge // 2

    @wp.kernel(module="unique", module_options=_OPTIONS)
    def near(
        # in:
        guide: wp.array3d[number],
        # out:
        smoke: wp.array2d[int],
    ):
        t = wp.tid()
        lane = t % wp.static(count)
        i = t // wp.static(count) // smoke.shape[1]
        j = t // wp.static(count) % smoke.shape[1]
        opacity = guide.shape[0] - 2
        pixels = float(0.0)
        for y in range(wp.static(reach)):
            # Beyond the image's end its last pixels are read again, which belong to the same block.
            row = wp.min(i * wp.static(reach) + y, guide.shape[1] - 1)
            for x in range(wp.static(reach // count)):
                column = wp.min(j * wp.static(reach) + x * wp.static(count) + lane, guide.shape[2] - 1)
                pixels += float(float(guide[opacity, row, column]) > 0.0)
        pixels = lane_sum(pixels, wp.static(count))
        if lane == 0:
            smoke[i, j] = int(pixels > 0.0)

    @wp.kernel(module="unique", module_options=_OPTIONS, launch_bounds=_BOUNDS)
    def compose(
        # in:
        heads: wp.array4d[number],
        guide: wp.array3d[number],
        weights: wp.array1d[Taps],
        places: wp.array2d[int],
        stem: int,
        smoke: wp.array2d[int],
        # out:
        out: wp.array3d[float],
    ):
        strip, column = wp.tid()
        row = strip * wp.static(STRIP)
        # A block consists of whole strips.
        i = row // wp.static(reach)
        j = column // wp.static(reach)
        blocks = int(0)
        for y in range(3):
            for x in range(3):
                blocks += smoke[wp.clamp(i + y - 1, 0, smoke.shape[0] - 1), wp.clamp(j + x - 1, 0, smoke.shape[1] - 1)]
        total = sums()
        if blocks > 0:
            for c in range(weights.shape[0] // wp.static(edge * edge)):
                for x in range(wp.static(edge)):
                    q = column + x - wp.static(middle)
                    across = q >= 0 and q < guide.shape[2]
                    q = wp.clamp(q, 0, guide.shape[2] - 1)
                    values = column_type()
                    for y in range(wp.static(STRIP + edge - 1)):
                        r = row + y - wp.static(middle)
                        inside = across and r >= 0 and r < guide.shape[1]
                        # The load has no branch, so that all loads are issued at once.
                        value = float(guide[c, wp.clamp(r, 0, guide.shape[1] - 1), q])
                        values[y] = wp.where(inside, value, 0.0)
                    for y in range(wp.static(edge)):
                        here = wp.vec4(values[y], values[y + 1], values[y + 2], values[y + 3])
                        # Each weight is used for a whole strip: loading it takes as long as using it once.
                        total += wp.outer(here, _load(weights, (c * wp.static(edge) + x) * wp.static(edge) + y))
        for k in range(wp.static(PLANES)):
            group = places[k, 0]
            for y in range(wp.static(STRIP)):
                r = row + y
                if r < out.shape[1]:
                    value = float(0.0)
                    if blocks > 0:
                        place = places[k, 1] + (r % stem) * stem + column % stem
                        value = _at_least_zero(total[y, k] + float(heads[group, r // stem, column // stem, place]))
                        value = wp.where(k < wp.static(LIGHTS), value, _at_most_one(value))
                    out[k, r, column] = value

    return PlaneKernels(count, near, compose)
