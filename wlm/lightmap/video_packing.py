"""Tiles of video as streams: the pages of a map that they lie in, and their levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wlm.formats.av1 import BITS, decode_av1
from wlm.formats.limits import VIDEO_BYTES, VIDEO_GROWTH, check_growth
from wlm.lightmap.tiles import TILE, TileKind

EXTRA = "video"
"""The extra with the encoder and the decoder."""

WHITE = (1 << BITS) - 1
"""The level of the greatest colour."""

MIDDLE = 1 << BITS - 1
"""What stands for a difference of 0."""

_SIDE = 8  # tiles along a page's side, at most
_PICTURES = 2048  # tiles of a page times times: 200 MB while it is coded


@dataclass(frozen=True, eq=False)
class Page:
    """A rectangle of a map's tiles that is one stream: no larger than the tiles of video in it ask for.

    Attributes:
        numbers: int [n], of these tiles in the grid, rising.
        places: int [n, 2], row and column of each in the page.
        shape: Height and width in texels.
    """

    numbers: np.ndarray
    places: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(cls, numbers: np.ndarray, places: np.ndarray) -> Page:
        """The smallest page of some tiles.

        Args:
            numbers: int [n], rising, one at least.
            places: int [n, 2], row and column of each in any rectangle.
        """
        first = places.min(0)
        height, width = ((places.max(0) - first + 1) * TILE).tolist()
        return cls(numbers, places - first, (height, width))

    def windows(self) -> list[tuple[slice, slice]]:
        """The texels of each tile."""
        return [tuple(slice(TILE * at, TILE * (at + 1)) for at in place) for place in self.places.tolist()]


def pages(kind: np.ndarray, columns: int, times: int) -> list[Page]:
    """The pages of a map, row by row; those without a tile of video are none.

    Args:
        kind: uint8 [tiles], `TileKind` of each tile of the grid.
        columns: Of the grid.
        times: T: of many the pages are small.
    """
    side = _SIDE
    while side > 1 and side * side * times > _PICTURES:
        side //= 2
    numbers = np.flatnonzero(kind == TileKind.VIDEO)
    places = np.stack(np.divmod(numbers, columns), 1)
    found, page_of = np.unique(places // side, axis=0, return_inverse=True)
    result = []
    for i in range(len(found)):
        chosen = page_of.ravel() == i
        result.append(Page.of(numbers[chosen], places[chosen]))
    return result


def decode_levels(stream: bytes, count: int, height: int, width: int, extra: str = EXTRA) -> np.ndarray:
    """Decodes a stream of levels to whole numbers, uint16 [count, H, W, 3], up to `WHITE`.

    Raises:
        ValueError, WlmError: As `wlm.formats.av1.decode_av1`.
    """
    levels = decode_av1(stream, count, height, width, extra)
    for picture in levels:
        luma, green, orange = np.moveaxis(picture.astype(np.int32), 2, 0)
        green, orange = green - MIDDLE, orange - MIDDLE
        rest = luma - green
        np.clip(np.stack([rest + orange, luma + green, rest - orange], 2), 0, WHITE, out=picture, casting="unsafe")
    return levels


def unpack_video(video: np.ndarray, sizes: np.ndarray, kind: np.ndarray, columns: int, times: int) -> np.ndarray:
    """Decodes the streams of a map.

    Args:
        video: uint8 [bytes], one after another.
        sizes: uint32 [pages], their bytes.
        kind, columns, times: As for `pages`.

    Returns:
        Words uint32 [N_v, T, 128, 128]: 10 bits each of red, green and blue from the lowest bit, the two above them set
        (DXGI_FORMAT_R10G10B10A2_UNORM).

    Raises:
        ValueError: The streams aren't those of these tiles.
        WlmError: They claim to become more than a file of their size may, or the decoder is missing.
    """
    laid = pages(kind, columns, times)
    if len(sizes) != len(laid) or int(sizes.sum(dtype=np.uint64)) != len(video):
        raise ValueError(f"part video_sizes: expected those of {len(laid)} pages and {len(video)} bytes, found others")
    texels = sum(page.shape[0] * page.shape[1] for page in laid)
    check_growth("part video", len(video), 6 * times * texels, VIDEO_GROWTH, VIDEO_BYTES)
    numbers = np.flatnonzero(kind == TileKind.VIDEO)
    words = np.empty((len(numbers), times, TILE, TILE), np.uint32)
    ends = np.cumsum(sizes.astype(np.int64))
    for i, (page, last, size) in enumerate(zip(laid, ends, sizes.astype(np.int64), strict=True)):
        try:
            levels = decode_levels(video[last - size : last].tobytes(), times, *page.shape)
        except ValueError as error:
            raise ValueError(f"part video: page {i}: {error}") from error
        for row, window in zip(np.searchsorted(numbers, page.numbers), page.windows(), strict=True):
            words[row] = words_of(levels[:, *window])
    return words


def words_of(levels: np.ndarray) -> np.ndarray:
    """Words uint32 [...] of red, green and blue, uint16 [..., 3]; see `unpack_video`."""
    red, green, blue = np.moveaxis(levels.astype(np.uint32), -1, 0)
    return red | green << 10 | blue << 20 | np.uint32(3 << 30)


def levels_of(words: np.ndarray) -> np.ndarray:
    """Red, green and blue of words [...], uint16 [..., 3]."""
    return np.stack([words >> shift & WHITE for shift in (0, 10, 20)], -1).astype(np.uint16)
