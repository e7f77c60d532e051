"""Finds the texels of a lightmap that a mesh's UV triangles touch or cover, exactly and in bounded memory.

In UVs times width and height of the lightmap, texel (row, column) is the square from (column, row) to (column + 1, row
+ 1). Each triangle is cut into the rows of texels that it meets, with one span of texels per row.
"""

from collections.abc import Iterator

import numpy as np

_SPANS_AT_ONCE = 1 << 20  # about 200 bytes each while they are worked on


def touched_texels(uv: np.ndarray, triangle: np.ndarray, height: int, width: int) -> np.ndarray:
    """Finds the texels whose square overlaps a triangle, bool [height, width]. UVs are float64 [V, 2] in [0, 1]; each
    triangle has an area above 0. A triangle that ends exactly at a texel's side doesn't touch that texel."""
    return _counts(uv, triangle, height, width, centres=False) > 0


def covered_texels(uv: np.ndarray, triangle: np.ndarray, height: int, width: int) -> np.ndarray:
    """Counts for every texel the triangles that contain its centre, int32 [height, width]. A centre on an edge that two
    triangles share counts for exactly one of them."""
    return _counts(uv, triangle, height, width, centres=True)


def _counts(uv: np.ndarray, triangle: np.ndarray, height: int, width: int, centres: bool) -> np.ndarray:
    """Counts the spans of triangles at each texel, int32 [height, width]. A span has the texels whose square overlaps
    the triangle or, if `centres`, those with their centre in it."""
    change = np.zeros((height, width + 1), np.int32)  # the differences of counts along a row
    for corner, row in _rows(uv, triangle, height, width, centres):
        low, high = np.full(len(row), np.inf), np.full(len(row), -np.inf)
        for k in range(3):
            start, end = _directed(corner[:, k], corner[:, (k + 1) % 3])
            if centres:
                lines = (row + 0.5,)
                meets = (start[:, 1] <= lines[0]) & (lines[0] < end[:, 1])
            else:
                # This is the edge's part within the row. Both ends of a horizontal edge are also ends of the other two
                # edges.
                lines = np.maximum(start[:, 1], row), np.minimum(end[:, 1], row + 1)
                meets = lines[0] <= lines[1]
            for y in lines:
                x = _crossing(start, end, y)
                np.minimum(low, x, out=low, where=meets)
                np.maximum(high, x, out=high, where=meets)
        if centres:
            hit = low <= high
            row, low, high = row[hit], low[hit], high[hit]
            first, stop = (np.ceil(x - 0.5).astype(np.int64).clip(0, width) for x in (low, high))
        else:
            # Rounding may leave a span without width; it lies in the texel of its left end.
            first = np.clip(np.floor(low).astype(np.int64), 0, width - 1)
            stop = np.clip(np.ceil(high).astype(np.int64), first + 1, width)
        np.add.at(change, (row, first), 1)
        np.subtract.at(change, (row, stop), 1)
    return np.cumsum(change, axis=1, dtype=np.int32)[:, :width]


def _rows(
    uv: np.ndarray, triangle: np.ndarray, height: int, width: int, centres: bool
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields, in pieces of bounded size, the corners of triangles, [N, 3, 2] in texels, and a row of texels that each
    may meet, [N]."""
    texel = uv * (width, height)
    v = texel[:, 1][triangle]  # [F, 3]
    if centres:
        first, stop = np.ceil(v.min(axis=1) - 0.5), np.floor(v.max(axis=1) - 0.5) + 1
    else:
        # Rounding may leave a triangle without height.
        first, stop = np.floor(v.min(axis=1)).clip(0, height - 1), np.ceil(v.max(axis=1))
        stop = np.maximum(stop, first + 1)
    first = first.astype(np.int64).clip(0, height)
    count = (stop.astype(np.int64).clip(0, height) - first).clip(0)
    ends = np.cumsum(count)
    total = int(ends[-1]) if len(ends) else 0
    for at in range(0, total, _SPANS_AT_ONCE):
        item = np.arange(at, min(at + _SPANS_AT_ONCE, total))
        owner = np.searchsorted(ends, item, side="right")
        yield texel[triangle[owner]], first[owner] + item - (ends[owner] - count[owner])


def _directed(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orders each edge's ends, upper end (or left end) first, so that both triangles of an edge get equal results."""
    swap = (a[:, 1] > b[:, 1]) | ((a[:, 1] == b[:, 1]) & (a[:, 0] > b[:, 0]))
    return np.where(swap[:, None], b, a), np.where(swap[:, None], a, b)


def _crossing(start: np.ndarray, end: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the x at which edges cross height y, never beyond their ends; the start's x for a horizontal edge."""
    drop = end[:, 1] - start[:, 1]
    share = np.divide(y - start[:, 1], drop, out=np.zeros_like(drop), where=drop > 0).clip(0.0, 1.0)
    return start[:, 0] + share * (end[:, 0] - start[:, 0])
