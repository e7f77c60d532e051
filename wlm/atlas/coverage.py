"""Finds the texels of a lightmap that a mesh's UV triangles touch or cover, exactly and in bounded memory.

In UVs times width and height of the lightmap, texel (row, column) is the square from (column, row) to (column + 1, row
+ 1). Each triangle is cut into the rows of texels that it meets, with one span of texels per row. All devices give the
same result, since each operation rounds by itself.
"""

from collections.abc import Iterator

import numpy as np
import torch

_SPANS_AT_ONCE = 1 << 20  # about 200 bytes each while they are worked on


def touched_texels(uv: np.ndarray, triangle: np.ndarray, height: int, width: int) -> np.ndarray:
    """Finds the texels whose square overlaps a triangle, bool [height, width]. UVs are float64 [V, 2] in [0, 1]; each
    triangle has an area above 0. A triangle that ends exactly at a texel's side doesn't touch that texel."""
    return (_counts(uv, triangle, height, width, "cpu", centres=False) > 0).numpy()


def covered_texels(uv: np.ndarray, triangle: np.ndarray, height: int, width: int, device: str = "cpu") -> torch.Tensor:
    """Counts for every texel the triangles that contain its centre, int32 [height, width] on the device. A centre on an
    edge that two triangles share counts for exactly one of them."""
    return _counts(uv, triangle, height, width, device, centres=True)


def _counts(uv: np.ndarray, triangle: np.ndarray, height: int, width: int, device: str, centres: bool) -> torch.Tensor:
    """Counts the spans of triangles at each texel, int32 [height, width]. A span has the texels whose square overlaps
    the triangle or, if `centres`, those with their centre in it."""
    stride = width + 1
    change = torch.zeros(height * stride, dtype=torch.int32, device=device)  # the differences of counts along a row
    texel = torch.from_numpy(uv * (width, height)).to(device)
    triangle = torch.from_numpy(triangle.astype(np.int64)).to(device)
    for corner, row in _rows(texel, triangle, height, centres):
        low = torch.full((len(row),), torch.inf, dtype=torch.float64, device=device)
        high = -low
        for k in range(3):
            start, end = _directed(corner[:, k], corner[:, (k + 1) % 3])
            if centres:
                lines = (row + 0.5,)
                meets = (start[:, 1] <= lines[0]) & (lines[0] < end[:, 1])
            else:
                # This is the edge's part within the row. Both ends of a horizontal edge are also ends of the other two
                # edges.
                lines = torch.maximum(start[:, 1], row), torch.minimum(end[:, 1], row + 1)
                meets = lines[0] <= lines[1]
            for y in lines:
                x = _crossing(start, end, y)
                low = torch.where(meets, torch.minimum(low, x), low)
                high = torch.where(meets, torch.maximum(high, x), high)
        if centres:
            hit = low <= high
            row, low, high = row[hit], low[hit], high[hit]
            first, stop = ((x - 0.5).ceil().long().clamp(0, width) for x in (low, high))
        else:
            # Rounding may leave a span without width; it lies in the texel of its left end.
            first = low.floor().long().clamp(0, width - 1)
            stop = torch.maximum(high.ceil().long(), first + 1).clamp(max=width)
        one = torch.ones(len(row), dtype=torch.int32, device=device)
        change.index_add_(0, row * stride + first, one).index_add_(0, row * stride + stop, -one)
    return change.reshape(height, stride).cumsum(1, dtype=torch.int32)[:, :width]


def _rows(
    texel: torch.Tensor, triangle: torch.Tensor, height: int, centres: bool
) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Yields, in pieces of bounded size, the corners of triangles, [N, 3, 2] in texels, and a row of texels that each
    may meet, [N]. `texel`, float64 [V, 2], has the UVs in texels."""
    v = texel[:, 1][triangle]  # [F, 3]
    least, most = (v.amin(1), v.amax(1)) if len(v) else (v[:, 0], v[:, 0])
    if centres:
        first, stop = (least - 0.5).ceil(), (most - 0.5).floor() + 1
    else:
        # Rounding may leave a triangle without height.
        first, stop = least.floor().clamp(0, height - 1), most.ceil()
        stop = torch.maximum(stop, first + 1)
    first = first.long().clamp(0, height)
    count = (stop.long().clamp(0, height) - first).clamp(min=0)
    ends = count.cumsum(0)
    total = int(ends[-1]) if len(ends) else 0
    for at in range(0, total, _SPANS_AT_ONCE):
        item = torch.arange(at, min(at + _SPANS_AT_ONCE, total), device=texel.device)
        owner = torch.searchsorted(ends, item, right=True)
        yield texel[triangle[owner]], first[owner] + item - (ends[owner] - count[owner])


def _directed(a: torch.Tensor, b: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Orders each edge's ends, upper end (or left end) first, so that both triangles of an edge get equal results."""
    swap = ((a[:, 1] > b[:, 1]) | ((a[:, 1] == b[:, 1]) & (a[:, 0] > b[:, 0])))[:, None]
    return torch.where(swap, b, a), torch.where(swap, a, b)


def _crossing(start: torch.Tensor, end: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Returns the x at which edges cross height y, never beyond their ends; the start's x for a horizontal edge."""
    drop = end[:, 1] - start[:, 1]
    share = torch.where(drop > 0, (y - start[:, 1]) / drop, 0.0).clamp(0.0, 1.0)
    return start[:, 0] + share * (end[:, 0] - start[:, 0])
