"""Encoding of the network's input and decoding of its output, each in one pass over the image.

`encode_six` converts the images of the coarse march (`marches.coarse_six_way`) into the network's input, the guide;
`decode` converts the network's output into light. There are no gradients: networks are trained in torch. Read first:
`encode_guide`, `encode_lightmaps` and `decode_lightmaps` of `wlm/smoke/network/planes.py` for the encodings.
"""

import warp as wp

from wlm_kernels.smoke import marches

LIGHTS = 6
"""Number of planes of light, which come first; they may exceed 1, the other planes may not."""

PLANES = LIGHTS + 2
"""Number of planes of the network's output: the lights, opacity and emission."""

FOOT, FOOT_CODE = 0.0031308, 0.04045
"""End of the linear part of sRGB's curve (IEC 61966-2-1), in linear light and encoded."""

_OPTIONS = {"enable_backward": False}
_HALF_MAX = 65504.0
_TRANSPARENCY, _EMISSION = (marches.PLANES.index(name) for name in ("transparency", "emission"))


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
    image are clamped to it; NaN stays NaN.
    """
    wp.launch(_decode, planes.shape[1:], inputs=[planes], outputs=[out], device=planes.device)
