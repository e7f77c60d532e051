"""A video codec over the hours: AV1 in 10 bits with full chroma, the smallest on disk, without random access.

The frames are the levels of `benchmarks.rivals.lightmap_levels` as a stream of libaom's, coded as the profile `video`
codes its pages (`wlm.lightmap.video`), but all of a set as one, with a ring round charts. A texel can't be read without
decoding its whole frame and those that it follows from, and what a GPU holds is the decoded frame. Gaps are filled
smoothly: detail there would cost as much as on a chart.

Compared with HEVC by x265 ("slower", 4:4:4, PSNR tuning) AV1 takes a fifth less for the same PSNR on `city`.
"""

import numpy as np

from benchmarks.rivals.lightmap_levels import TileRanges, prepare, seen_texels, to_codes
from benchmarks.rivals.rival import EXTRA, Rival, disk_size, measure
from wlm.errors import WlmError
from wlm.lightmap.video import encode_levels
from wlm.lightmap.video_packing import WHITE, decode_levels
from wlm.texels import fill_smoothly

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
    # Each texel more that must be right costs bits here: one is what a bilinear read needs.
    codes, seen = to_codes(prepare(frames, mask)), seen_texels(mask, ring=1)
    span = TileRanges.over_times if ranges == "day" else TileRanges.of
    tiles = span(codes, seen, by_channel=False)  # grey stays grey
    levels = fill_smoothly(tiles.levels(codes), seen)

    def encode() -> bytes:
        return encode_levels(levels, quality, speed, EXTRA)

    def decode(stream: bytes) -> np.ndarray:
        return tiles.radiance(decode_levels(stream, *levels.shape[:3], EXTRA) / np.float32(WHITE))

    return measure(
        f"av1-{quality}" + ("-hour" if ranges == "hour" else ""),
        encode,
        decode,
        bytes=lambda data: len(data) + len(tiles.tobytes()),
        disk_bytes=lambda data: len(data) + disk_size(tiles.tobytes()),
    )
