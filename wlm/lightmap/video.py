"""Tiles stored as video: the lightmaps of all times as one AV1 stream, the smallest on disk, unpacked when it is read.

As in frames a texel is a level between the least and the greatest colour of its tile at its time, in gamma space:

    colour = least + level (greatest - least),     radiance = colour ** gamma

All three channels share the two, so that grey stays grey, and levels have 10 bits, as GPUs read them (R10G10B10A2). A
texel can't be read without decoding its picture and those that it follows from: there is no random access, and what
a GPU holds is the unpacked levels, 32 bits for a texel and time.

A picture is a page of the map, up to 8 x 8 tiles: a stream for each tile would take 19% to 60% more. What lies beside
the valid texels is filled smoothly, which costs next to nothing; decoders fill the gaps with charts' light anyway. The
planes that are coded are luma, a green and an orange difference, in our own arithmetic: libavif's, in floats, loses 0.1
to 0.4 dB, and is no part of AV1's standard, which is exact to the bit.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from wlm.formats.av1 import encode_av1
from wlm.lightmap.frames import round_half
from wlm.lightmap.level_packing import STEPS
from wlm.lightmap.levels import encode_tile, mean_psnr, steps_for, tile_psnr
from wlm.lightmap.streams import load_kernels
from wlm.lightmap.video_packing import EXTRA, MIDDLE, WHITE, Page, decode_levels
from wlm.texels import fill_smoothly
from wlm.workers import each
from wlm_kernels.lightmap import level_coder

TRIAL_SPEED = 6
"""Of encodings that only choose: beyond it libaom is of another kind, which takes a quality for another."""

_DEAR = 1.0  # bits a valid texel and time, from which on levels are tried: below, AV1 is far ahead
_STEP = 4  # of the quality, for another point on the curve of PSNR over size


def encode_levels(levels: np.ndarray, quality: int, speed: int, extra: str = EXTRA) -> bytes:
    """Encodes levels as one stream.

    Args:
        levels: float32 [T, H, W, 3] in [0, 1].
        quality, speed, extra: As for `wlm.formats.av1.encode_av1`.

    Raises:
        WlmError: The encoder is missing.
    """
    planes = np.empty(levels.shape, np.uint16)
    for picture, out in zip(levels, planes, strict=True):
        red, green, blue = np.moveaxis(picture * np.float32(WHITE), 2, 0)
        luma = 0.25 * (red + blue) + 0.5 * green
        for i, plane in enumerate((luma, green - luma + MIDDLE, 0.5 * (red - blue) + MIDDLE)):
            out[..., i] = np.clip(plane + np.float32(0.5), 0, WHITE)
    return encode_av1(planes, quality, speed, extra)


@dataclass(frozen=True, eq=False)
class EncodedPage:
    """The tiles of a page as a stream of video, or as levels.

    Attributes:
        video: int, places of the tiles of video in the page, rising.
        stream: Their stream; empty where there is none.
        ranges: Of each of them half [n, T, 2], least and greatest.
        levels: Of each other tile, by its place, its stream and its ranges as levels, see `wlm.lightmap.levels`.
    """

    video: np.ndarray
    stream: bytes
    ranges: np.ndarray
    levels: dict[int, tuple[bytes, np.ndarray]]

    @property
    def size(self) -> int:
        """Bytes in the file."""
        levels = sum(len(stream) + ranges.nbytes for stream, ranges in self.levels.values())
        return len(self.stream) + self.ranges.nbytes + levels


def encode_page(
    page: Page, colour: Sequence[np.ndarray], valid: Sequence[np.ndarray], gamma: float, quality: int, speed: int
) -> EncodedPage:
    """Encodes a page as AV1; tiles as levels where these take fewer bytes at no lower PSNR.

    What a tile takes of AV1's stream quick encodings of each tile alone say, which in sum are within 2% of one of all.

    Args:
        page: The page.
        colour: Of its tiles float32 [T, 128, 128, 3], in gamma space.
        valid: Of each bool [128, 128].
        gamma: Of that space.
        quality: 0 to 100; one of `STEPS`: all tiles are levels.
        speed: Of AV1's encoder.

    Raises:
        WlmError: The encoder is missing.
    """
    tiles = list(zip(colour, valid, strict=True))
    none = np.zeros(0, int), b"", np.zeros((0, len(colour[0]), 2), np.float16)
    if quality in STEPS:
        return EncodedPage(*none, dict(enumerate(_encoded_levels(tiles, [STEPS[quality]] * len(tiles)))))
    stream, ranges = _encode_video(page, colour, valid, gamma, quality, speed)
    alone = EncodedPage(np.arange(len(tiles)), stream, ranges, {})
    if 8 * len(stream) < _DEAR * len(colour[0]) * sum(int(inside.sum()) for inside in valid):
        return alone
    decoded = _decoded(page, ranges, decode_levels(stream, len(colour[0]), *page.shape))
    goals = [mean_psnr(tile, other, inside, gamma) for (tile, inside), other in zip(tiles, decoded, strict=True)]
    steps = [steps_for(*tile, gamma, goal) for tile, goal in zip(tiles, goals, strict=True)]
    levels = dict(enumerate(_encoded_levels(tiles, steps)))
    worse = [i for i, goal in enumerate(goals) if tile_psnr(*tiles[i], gamma, steps[i]) < goal]
    choices = [alone]
    if not worse:
        choices.append(EncodedPage(*none, levels))
    if len(tiles) == 1:
        return min(choices, key=lambda choice: choice.size)
    shares = np.array([_alone(page, i, tiles[i], ranges[i], quality, max(speed, TRIAL_SPEED)) for i in levels], float)
    shares *= len(stream) / shares.sum()
    dearer = [i for i, (own, bounds) in levels.items() if len(own) + bounds.nbytes >= shares[i] + ranges[i].nbytes]
    kept = sorted({*worse, *dearer})
    if 0 < len(kept) < len(tiles):
        rest = Page.of(page.numbers[kept], page.places[kept])
        some = [colour[i] for i in kept], [valid[i] for i in kept], ranges[kept]
        others = {i: own for i, own in levels.items() if i not in kept}
        choices.append(EncodedPage(np.array(kept), _encoded(rest, *some, quality, speed), ranges[kept], others))
    return min(choices, key=lambda choice: choice.size)


def _alone(
    page: Page, at: int, tile: tuple[np.ndarray, np.ndarray], ranges: np.ndarray, quality: int, speed: int
) -> int:
    """Bytes of one tile of a page as a stream of its own."""
    own = Page.of(page.numbers[[at]], page.places[[at]])
    return len(_encoded(own, [tile[0]], [tile[1]], ranges[None], quality, speed))


def _encoded_levels(
    tiles: Sequence[tuple[np.ndarray, np.ndarray]], steps: Sequence[float]
) -> list[tuple[bytes, np.ndarray]]:
    """Stream and ranges of each of some tiles, colour and valid texels, as levels."""
    load_kernels(level_coder)
    return list(each(lambda one: encode_tile(*one[0], one[1]), zip(tiles, steps, strict=True)))


def _encode_video(
    page: Page, colour: Sequence[np.ndarray], valid: Sequence[np.ndarray], gamma: float, quality: int, speed: int
) -> tuple[bytes, np.ndarray]:
    """Encodes a page as AV1, with the ranges that yield more for their bytes: those of each time, or of all times.

    Where hours are alike, levels that are relative to one range follow from each other; where they differ much, dark
    ones lose their levels to bright ones. Which is better quick encodings say: one of either, and one more of another
    quality, which says what PSNR the smaller would have at the size of the larger.

    Returns:
        The stream, and the ranges of the tiles, half [n, T, 2], least and greatest.
    """
    by_time = np.stack([_range_of(tile[:, inside]) for tile, inside in zip(colour, valid, strict=True)])
    over_all = np.broadcast_to(np.stack([by_time[..., 0].min(1), by_time[..., 1].max(1)], 1)[:, None], by_time.shape)
    count = by_time.shape[1]
    if count == 1:
        return _encoded(page, colour, valid, by_time, quality, speed), by_time
    trial = max(speed, TRIAL_SPEED)

    def tried(ranges: np.ndarray, quality: int) -> tuple[float, float, bytes]:
        """Octaves of the size, PSNR and stream of a trial."""
        stream = _encoded(page, colour, valid, ranges, quality, trial)
        levels = decode_levels(stream, count, *page.shape)
        return float(np.log2(len(stream))), _psnr(page, colour, valid, ranges, levels, gamma), stream

    both = [(*tried(ranges, quality), ranges) for ranges in (by_time, over_all)]
    small, large = sorted(both, key=lambda result: result[0])
    other = tried(small[3], quality + (_STEP if quality + _STEP <= 100 else -_STEP))
    octaves = other[0] - small[0]
    slope = (other[1] - small[1]) / octaves if octaves else 0.0
    _, _, stream, ranges = small if small[1] + slope * (large[0] - small[0]) > large[1] else large
    return stream if trial == speed else _encoded(page, colour, valid, ranges, quality, speed), ranges


def _range_of(texels: np.ndarray) -> np.ndarray:
    """Least and greatest of texels [T, K, 3] at each time, half [T, 2]."""
    least, greatest = texels.min((1, 2)), texels.max((1, 2))
    return np.stack([round_half(least, -np.inf), round_half(greatest, np.inf)], 1)


def _encoded(
    page: Page,
    colour: Sequence[np.ndarray],
    valid: Sequence[np.ndarray],
    ranges: np.ndarray,
    quality: int,
    speed: int,
) -> bytes:
    """The stream of a page, relative to ranges [n, T, 2]."""
    levels = np.zeros((ranges.shape[1], *page.shape, 3), np.float32)
    inside = np.zeros(page.shape, bool)
    for tile, mask, (low, high), window in zip(
        colour, valid, ranges.astype(np.float32).transpose(0, 2, 1), page.windows(), strict=True
    ):
        span = np.where(high > low, high - low, np.float32(1.0))
        inside[window] = mask
        levels[:, *window] = np.clip((tile - low[:, None, None, None]) / span[:, None, None, None], 0.0, 1.0)
    for picture in levels:
        picture[...] = fill_smoothly(picture, inside)
    return encode_levels(levels, quality, speed)


def _decoded(page: Page, ranges: np.ndarray, levels: np.ndarray) -> Iterator[np.ndarray]:
    """The colours of a page's tiles, float32 [T, 128, 128, 3] each."""
    for bounds, window in zip(ranges.astype(np.float32), page.windows(), strict=True):
        low, span = bounds[:, 0], (bounds[:, 1] - bounds[:, 0]) / np.float32(WHITE)
        yield low[:, None, None, None] + levels[:, *window] * span[:, None, None, None]


def _psnr(
    page: Page,
    colour: Sequence[np.ndarray],
    valid: Sequence[np.ndarray],
    ranges: np.ndarray,
    levels: np.ndarray,
    gamma: float,
) -> float:
    """PSNR of a decoded page by the tiled protocol, dB; 0 where no tile has a score."""
    tiles = zip(colour, _decoded(page, ranges, levels), valid, strict=True)
    scores = [mean_psnr(*tile, gamma) for tile in tiles]
    return float(np.nanmean(scores)) if np.isfinite(scores).any() else 0.0
