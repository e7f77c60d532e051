"""A video codec over the hours: AV1 in 10 bits with full chroma, the smallest on disk, without random access.

The frames are the levels of `wlm.baselines.lightmap_levels` as an AVIF sequence by libaom, in YCgCo, which at equal
size is 0.3 to 1 dB above YCbCr. A texel can't be read without decoding its whole frame and those that it follows from,
and what a GPU holds is the decoded frame. Gaps are filled smoothly: detail there would cost as much as on a chart.

Compared with HEVC by x265 ("slower", 4:4:4, PSNR tuning) AV1 takes a fifth less for the same PSNR on `city`.
"""

import numpy as np

from wlm.baselines.lightmap_levels import TileRanges, prepare, seen_texels, to_codes
from wlm.baselines.rival import EXTRA, Rival, disk_size, measure
from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need

_BITS = 10
_WHITE = (1 << _BITS) - 1
_YCGCO = 8  # matrix coefficients, ITU-T H.273
_SPEED = 3  # 0 (slowest) to 10
_RANGES = ("day", "hour")


def encode_av1(
    frames: np.ndarray, mask: np.ndarray, quality: int = 80, ranges: str = "day", speed: int = _SPEED
) -> Rival:
    """All lightmaps of a set as one AV1 sequence.

    Args:
        frames: [T, H, W, 3], linear RGB.
        mask: [H, W], true where a texel is valid.
        quality: 0 to 100.
        ranges: What a tile's levels are relative to: its range over the `day`, or at each `hour`. The first is better
            where hours are alike, the second where they differ much.
        speed: libaom's, 0 (slowest, best) to 10.

    Returns:
        The rival; `decoded` is float32 [T, H, W, 3].

    Raises:
        WlmError: As the block codecs, or a setting is out of range.
    """
    if not 0 <= quality <= 100:
        raise WlmError(f"av1: expected a quality from 0 to 100, got {quality}")
    if ranges not in _RANGES:
        raise WlmError(f"av1: unknown ranges {ranges!r}, expected one of {', '.join(_RANGES)}")
    if not 0 <= speed <= 10:
        raise WlmError(f"av1: expected a speed from 0 to 10, got {speed}")
    codecs = need("imagecodecs", EXTRA)
    # Each texel more that must be right costs bits here: one is what a bilinear read needs.
    codes, seen = to_codes(prepare(frames, mask)), seen_texels(mask, ring=1)
    span = TileRanges.over_times if ranges == "day" else TileRanges.of
    tiles = span(codes, seen, by_channel=False)  # grey stays grey
    levels = fill_smoothly(tiles.levels(codes), seen)
    texels = (levels * _WHITE + 0.5).astype(np.uint16)

    def encode() -> bytes:
        # One frame is a still picture.
        return codecs.avif_encode(
            texels if len(texels) > 1 else texels[0],
            level=quality,
            speed=speed,
            bitspersample=_BITS,
            pixelformat="444",
            matrix=_YCGCO,
            codec="aom",
            numthreads=1,
        )

    def decode(data: bytes) -> np.ndarray:
        return tiles.radiance(codecs.avif_decode(data).reshape(texels.shape) / np.float32(_WHITE))

    return measure(
        f"av1-{quality}" + ("-hour" if ranges == "hour" else ""),
        encode,
        decode,
        bytes=lambda data: len(data) + len(tiles.tobytes()),
        disk_bytes=lambda data: len(data) + disk_size(tiles.tobytes()),
    )


def fill_smoothly(images: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Gives texels outside the mask means of ever larger neighbourhoods, so that few bits describe them.

    Args:
        images: float32 [..., H, W, C].
        mask: bool [H, W]; what lies outside it isn't read.

    Returns:
        A new array; 0 where the mask is empty.
    """
    weight = mask.astype(np.float32)[..., None]
    return _pull_push(np.where(mask[..., None], images, np.float32(0.0)), weight)


def _pull_push(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Fills values [..., h, w, C], which are multiplied by their weights [h, w, 1] in [0, 1]."""
    height, width = weight.shape[:2]
    if height == width == 1:
        return values / np.where(weight > 0.0, weight, np.float32(1.0))
    pad = ((0, height % 2), (0, width % 2), (0, 0))
    halves = [
        sum(np.pad(array, ((0, 0),) * (array.ndim - 3) + pad)[..., y::2, x::2, :] for y in (0, 1) for x in (0, 1))
        for array in (values, weight)
    ]
    # A coarse texel with any weight is whole: it is the mean of what it covers.
    whole = 1.0 / np.maximum(halves[1], np.float32(1.0))
    coarse = _pull_push(halves[0] * whole, halves[1] * whole)
    fine = coarse.repeat(2, axis=-3).repeat(2, axis=-2)[..., :height, :width, :]
    return values + (1.0 - weight) * fine
