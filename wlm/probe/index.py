"""Which probes lie in a box: an octree kept as a sorted list of Morton keys.

Positions are put on a grid of cubic cells, and the probes sorted by the Morton key of their cell, so that every cell
of the octree above the grid is one range of the list and two binary searches find it (the octree of
gaussian-probe-compression, section 3.4). A box is covered by at most 8 cells of the depth at which it spans no more
than two along an axis; what they hold is then compared with the box itself, in float64.
"""

import math

import numpy as np

_BITS = 21  # of a Morton key for each axis: three of them fill 63 bits
# The grid starts at a multiple of so many cells: boxes of 2, 4 ... 1024 cells that are aligned to the origin of the
# positions are then cells of the octree themselves, and need one range instead of 8.
_ALIGNED = 1024
_CELLS = 2**_BITS - 2 * _ALIGNED  # that the probes may span along an axis, wherever the grid starts
_FARTHEST = 1e100  # no length overflows below it
# Steps that spread 21 bits out to every third one.
_SPREAD = (
    (32, 0x001F00000000FFFF),
    (16, 0x001F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
_CORNERS = np.array([[i & 1, i >> 1 & 1, i >> 2 & 1] for i in range(8)], bool)


class ProbeIndex:
    """The probes by place. Coincident probes, one probe and none at all are fine.

    Attributes:
        count: N, number of probes.
        low, high: float64 [3], corners of the probes' box; infinite, and low above high, without a probe.
    """

    def __init__(self, position: np.ndarray, cell: float | None = None):
        """Sorts the probes.

        Args:
            position: [N, 3], in any unit; N may be 0.
            cell: Side of the grid's cells. Queries are fastest where boxes are this large or a power of two larger,
                with corners at multiples of their size. Doubled until 2 million of them span the probes. None: the
                longest side of the probes' box over 256.

        Raises:
            ValueError: A wrong shape, a position that is NaN or above 1e100, or a cell that isn't a positive finite
                number.
        """
        position = np.asarray(position, np.float64)
        if position.ndim != 2 or position.shape[1] != 3:
            raise ValueError(f"position: expected [N, 3], got {position.shape}")
        if not (np.abs(position) <= _FARTHEST).all():
            raise ValueError(f"position: expected numbers of at most {_FARTHEST:g}, got NaN or more")
        if cell is not None and not 0.0 < cell < np.inf:
            raise ValueError(f"cell: expected a positive number, got {cell}")
        self.count = len(position)
        self.low = position.min(0, initial=np.inf)
        self.high = position.max(0, initial=-np.inf)
        size = float((self.high - self.low).max()) if self.count else 0.0
        self._cell = float(cell or size / 256.0 or 1.0)
        # Nor is a cell smaller than what float64 can tell apart out there.
        least = max(size / _CELLS, float(np.abs(position).max(initial=0.0)) * 2.0**-52)
        if self._cell < least:
            self._cell = math.ldexp(self._cell, math.ceil(math.log2(least) - math.log2(self._cell)))
        start = self.low if self.count else np.zeros(3)
        self._start = np.floor(start / self._cell / _ALIGNED) * _ALIGNED
        key = morton_keys(self._cells(position))
        self._order = np.argsort(key, kind="stable")
        self._key = key[self._order]
        self._position = position[self._order]

    @property
    def memory_bytes(self) -> int:
        """Bytes of the sorted list: 40 a probe."""
        return self._order.nbytes + self._key.nbytes + self._position.nbytes

    def query(self, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The probes in each of many boxes.

        Args:
            low: [B, 3], lowest corners; may be infinite.
            high: [B, 3], highest corners, not part of the boxes. A box whose high isn't above its low is empty.

        Returns:
            int64 [M], numbers of probes, box after box, within a box in Morton order; and int64 [B + 1], where the
            probes of each box start, ending with M.

        Raises:
            ValueError: Wrong shapes, or a NaN.
        """
        low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
        if low.ndim != 2 or low.shape[1] != 3 or high.shape != low.shape:
            raise ValueError(f"boxes: expected two arrays [B, 3], got {low.shape} and {high.shape}")
        if np.isnan(low).any() or np.isnan(high).any():
            raise ValueError("boxes: expected numbers, got NaN")
        some = ((high > low) & (high > self.low) & (low <= self.high)).all(1)
        boxes = np.flatnonzero(some)
        owner, begin, end = self._ranges(boxes, low[boxes], high[boxes])
        count = end - begin
        row = np.repeat(begin - (np.cumsum(count) - count), count) + np.arange(count.sum())
        owner = np.repeat(owner, count)
        place = self._position[row]
        inside = ((place >= low[owner]) & (place < high[owner])).all(1)
        offsets = np.zeros(len(low) + 1, np.int64)
        np.cumsum(np.bincount(owner[inside], minlength=len(low)), out=offsets[1:])
        return self._order[row[inside]], offsets

    def _ranges(self, boxes: np.ndarray, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, ...]:
        """The ranges of the sorted list that cover each box: box, begin and end, ordered by box."""
        first = self._cells(low)
        # Not the cell of the upper corner itself, which is not part of the box.
        last = self._cells(np.nextafter(high, -np.inf))
        # The bit length of the widest side: a cell of so many levels up is longer than it.
        depth = np.frexp((last - first).max(1, initial=0).astype(np.float64))[1].astype(np.int64)[:, None]
        near, far = first >> depth, last >> depth
        # A corner that lies in the same cell as another one is left out.
        distinct = (~_CORNERS | (far > near)[:, None]).all(2)
        corner = np.where(_CORNERS, far[:, None], near[:, None])[distinct]
        shift = (3 * np.broadcast_to(depth, distinct.shape)[distinct]).astype(np.uint64)
        code = morton_keys(corner)
        begin = np.searchsorted(self._key, code << shift)
        end = np.searchsorted(self._key, (code + np.uint64(1)) << shift)
        return np.broadcast_to(boxes[:, None], distinct.shape)[distinct], begin, end

    def _cells(self, position: np.ndarray) -> np.ndarray:
        """int64 [M, 3], the cell of each position, or the nearest cell of the grid.

        Every step is monotone, rounding included: a probe between two corners lies in a cell between theirs, which
        is all that a query asks for.
        """
        with np.errstate(over="ignore"):
            cell = np.floor(position / self._cell) - self._start
        return np.clip(cell, 0, 2**_BITS - 1).astype(np.int64)


def morton_keys(cell: np.ndarray) -> np.ndarray:
    """uint64 [M], bits of x, y and z in turn, for cells int64 [M, 3] below 2 ** 21."""
    bits = cell.astype(np.uint64)
    for shift, mask in _SPREAD:
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits[:, 0] | bits[:, 1] << np.uint64(1) | bits[:, 2] << np.uint64(2)
