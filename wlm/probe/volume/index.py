"""An index of probes for a device: the probes sorted by cell, and the blocks near a probe.

Positions are put on a grid of cubic cells and sorted by the Morton key of their cell, so that every cell of the octree
above the grid is one range of the list, and two binary searches find it (the octree of gaussian-probe-compression,
section 3.4). A cell is half a side of the finest block. A block of a coarser level is larger by a power of two, so that
its octants are cells of the octree.

A point reads the eight blocks whose centres surround it. Only blocks with at least a tenth of the weight at one of the
probes take memory; the index lists these for each level.
"""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.probe.morton import morton_keys, spread_bits

_BITS = 21  # bits of a Morton key for each axis: three of them fill 63 bits
_FARTHEST = 1e100  # no length overflows below it
_LEAST = 0.1  # smallest weight at a probe for which a block is listed
_SHARE = 1.25  # side of the finest blocks over the probes' spacing: see `finest_side`
_EACH = 2  # least blocks per probe
_SHRINKS = 8


class BlockIndex:
    """The probes sorted by cell, and the blocks of each level that are read at a probe.

    Block b of a level spans [b, b + 1) times its side, in the unit of the positions. Blocks are numbered from `start`,
    and cells from `2 * start` of the finest level.

    Attributes:
        count: Number of probes, N.
        sizes: Side of a block at each level, rising.
        ratios: Side of each level divided by the finest side, powers of two.
        start: float64 [L, 3], coordinates of the first block of each level, whole numbers.
        key: int64 [N], Morton keys of the cells, rising.
        number: int32 [N], index of each probe in the input.
        place: float32 [N, 3], position within the cell, 0 to 1.
        block: int64 [W], Morton keys of the blocks near probes, level after level, rising within each.
        level_start: int32 [L + 1], index in `block` at which each level begins.
        low, high: int64 [L, 3], least and greatest coordinates of the blocks of each level, counted from `start`.
    """

    def __init__(self, position: np.ndarray, side: float, ratios: Sequence[int]) -> None:
        """Sorts the probes and lists the blocks.

        Args:
            position: [N, 3], in any unit; N may be 0.
            side: Side of a block of the finest level, positive. It is doubled until the keys hold all cells and float64
                separates neighbouring cells.
            ratios: Side of each level divided by the finest side: rising powers of two from 1.

        Raises:
            ValueError: A position is NaN or above 1e100.
        """
        position = np.asarray(position, np.float64)
        if not (np.abs(position) <= _FARTHEST).all():
            raise ValueError(f"position: expected probes within {_FARTHEST:g} of the origin, got NaN or one beyond")
        self.count = len(position)
        self.ratios = tuple(ratios)
        widest = 2 * self.ratios[-1]  # cells along a side of the coarsest block
        low, high = position.min(0, initial=np.inf), position.max(0, initial=-np.inf)
        cell_side = float(side) / 2
        if self.count:
            # One coarsest block stays free on both sides, so that no block near a probe has a negative index.
            least = float((high - low).max()) / (2**_BITS - 4 * widest)
            least = max(least, float(np.abs(position).max()) * 2.0**-48)
            if cell_side < least:
                cell_side = math.ldexp(cell_side, math.ceil(math.log2(least) - math.log2(cell_side)))
        else:
            low = np.zeros(3)
        self.sizes = tuple(2 * cell_side * ratio for ratio in self.ratios)
        first = (np.floor(low / cell_side / widest) - 1) * widest
        self.start = first / 2 / np.array(self.ratios)[:, None]
        place = position / cell_side
        whole = np.floor(place)
        cell = (whole - first).astype(np.int64)
        key = morton_keys(cell).astype(np.int64)
        order = np.argsort(key, kind="stable")
        self.key = key[order]
        self.number = order.astype(np.int32)
        self.place = (place - whole)[order].astype(np.float32)
        along, rest = cell[order].T.copy(), (place - whole)[order].T.copy()
        levels = [_near(along, rest, ratio) for ratio in self.ratios]
        self.block = np.concatenate([keys for keys, _, _ in levels])
        self.level_start = np.cumsum([0, *(len(keys) for keys, _, _ in levels)]).astype(np.int32)
        self.low, self.high = (np.stack([level[i] for level in levels]) for i in (1, 2))


def finest_side(position: np.ndarray) -> float:
    """Returns a side for the finest blocks: at most 1.25 times the median distance of probes to their nearest
    neighbours.

    The light is linear between blocks, so more blocks than probes are needed to reproduce the probes. Probes scattered
    over surfaces have at least two blocks each at this side. Probes on a lattice have fewer; for them the side is
    reduced in steps of a fifth until there are two blocks per probe. The side is in the unit of the positions, [N, 3];
    it is 1 if there are fewer than two distinct positions. Raises a WlmError if the positions are so far apart, or so
    close, that float64 does not hold their distances."""
    places = np.asarray(position, np.float64)
    places = places[np.lexsort(places.T)]
    places = places[np.append(True, (places[1:] != places[:-1]).any(1))[: len(places)]]
    if len(places) < 2:
        return 1.0
    with np.errstate(over="ignore", under="ignore"):
        tree = cKDTree(places, balanced_tree=False, compact_nodes=False)  # built in half the time
        side = _SHARE * float(np.median(tree.query(places, k=2)[0][:, 1]))
    if not 0.0 < side < np.inf:
        raise WlmError(f"positions: expected distances within the range of float64, got a median of {side:g}")
    for _ in range(_SHRINKS):
        index = BlockIndex(places, side, (1,))
        if len(index.block) >= _EACH * len(places):
            break
        side *= 0.8
    return side


def _near(cell: np.ndarray, place: np.ndarray, ratio: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns the Morton keys of a level's blocks whose weight at some probe is at least `_LEAST`, and the least and
    greatest of their coordinates, [3]; 0 where there is no probe. `cell` and `place` of the probes are [3, N], best in
    the order of the cells' keys."""
    # Distances in sides from the centre of block 0, as integer and fraction; the index of a cell is exact.
    half = cell // ratio - 1
    whole = half >> 1
    rest = ((half & 1) + (cell % ratio + place) / ratio) / 2
    shares, axes = (1.0 - rest, rest), np.arange(3, dtype=np.uint64)[:, None]
    bits = [spread_bits(whole + corner) << axes for corner in (0, 1)]
    near = []
    for x, y, z in itertools.product((0, 1), repeat=3):
        read = shares[x][0] * shares[y][1] * shares[z][2] >= _LEAST
        keys = (bits[x][0] | bits[y][1] | bits[z][2])[read].astype(np.int64)
        near.append(keys[np.diff(keys, prepend=-1) != 0])
    # Several times as fast as `np.unique`, which makes a hash table.
    keys = np.sort(np.concatenate(near))
    keys = keys[np.diff(keys, prepend=-1) != 0]
    if not len(keys):
        return keys, np.zeros(3, np.int64), np.zeros(3, np.int64)
    # A block at one side of an axis is read if it is with the larger shares of the other axes.
    most, bounds = np.maximum(*shares), []
    for axis in range(3):
        sides = []
        for corner, share in enumerate(shares):
            x, y, z = (share[each] if each == axis else most[each] for each in range(3))
            sides.append(whole[axis][x * y * z >= _LEAST] + corner)
        both = np.concatenate(sides)
        bounds.append((both.min(), both.max()))
    low, high = np.array(bounds).T
    return keys, low, high
