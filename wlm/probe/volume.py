"""The cascaded lighting volume: nested grids of blocks round the viewer, filled from the probes as it moves.

Follows gaussian-probe-compression, section 3.4, with the settings of section 5. What the paper leaves open:

- A level's window is the 16 blocks along each axis whose middle lies nearest to the viewpoint, so the window depends
  on the viewpoint alone.
- A block's light is the mean of its probes, weighted by 1 / (d^2 + e^2), d being the distance to the block's centre
  and e a quarter of the block's side; the paper names no weights. From e = 0.1 to 1 side the error of what is read
  changes by less than 2%.
- Of a block with many probes, 64 decide, every n-th along the Morton order, which spreads them evenly: a block of 32 m
  may hold half of a scene, and a frame must not cost as much. On three scenes of 1,237 to 14,900 probes that changes
  the error of what is read by less than 0.2% and the most probes in a frame from up to 13,810 to 2,395.
- A block without a probe is empty: it is never queued, takes up no budget, and is not there for a read.
- The budget counts blocks that are decoded. One that comes from the cache costs an upload alone, and is back in the
  frame in which it comes into its window.
- Blocks wait in the order of their distance to the viewpoint in sides of their own, so that all levels grow outwards
  together: after a teleport the first frame already covers what is near, if coarsely, where the finest level first
  would leave the rest of the scene black until that level was done.
- Which level answers a point follows from the windows and from the blocks that are there: the finest that has it, as
  `wlm_kernels.probe.volume.read` says. With every block there that is the paper's choice by the distance to the
  viewer.
"""

import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.probe.index import ProbeIndex
from wlm_kernels.probe import volume as kernels

SIZES = (2.0, 4.0, 8.0, 32.0)  # sides of a block, in metres
SIDE = 16  # blocks along an axis of a window
BUDGET = 64  # blocks decoded in a frame
PROBES = 64  # decoded for a block
CACHE = 16384  # blocks: as many as the windows have, so that one teleport back finds all it left

_SOFTENING = 0.25  # e over the block's side: a probe at the centre doesn't drown out the rest
_LONGEST = 128  # side of a window: 2 million blocks a level
_SMALLEST = 1e-30  # side of a block, so that float32 holds it and its inverse
_FARTHEST = 2**30  # coordinate of a block: int32 on the device, with room for a window


@dataclass(frozen=True)
class FrameStats:
    """The work of one frame.

    Attributes:
        entered: Blocks that came into a window, empty ones included.
        queued: Of those, the ones that now wait for their turn.
        dropped: Blocks that left their window while they waited.
        updated: Blocks decoded and written, at most the budget.
        cached: Blocks written from the cache.
        left: Blocks that still wait.
        probes: Probes decoded; one that lies in blocks of several levels counts once.
        find_seconds: Finding what changed, what is cached, and the probes of the blocks.
        decode_seconds: Decoding the probes and weighting them.
        upload_seconds: Writing to the device, until it is done.
    """

    entered: int
    queued: int
    dropped: int
    updated: int
    cached: int
    left: int
    probes: int
    find_seconds: float
    decode_seconds: float
    upload_seconds: float


@dataclass(frozen=True, eq=False)
class Reading:
    """The light at M points.

    Attributes:
        values: float32 [M, D]; 0 where nothing covers the point.
        level: int32 [M], the level with the largest share in it, -1 where nothing covers the point.
        weight: float32 [M], the share of the trilinear weights that blocks of any level cover; 1 where none is missing.
    """

    values: np.ndarray
    level: np.ndarray
    weight: np.ndarray


class Volume:
    """A cascaded lighting volume on a device. Call `update` once a frame, then `read`.

    Attributes:
        index: The live probes by place.
        position: float64 [N, 3], of the live probes.
        sizes: Sides of a block at each level, scaled.
        side: Blocks along an axis of a window.
        budget: Blocks decoded in a frame.
        channels: D.
        device: "cpu" or "cuda:N".
    """

    def __init__(
        self,
        position: np.ndarray,
        decode: Callable[[np.ndarray], np.ndarray],
        channels: int,
        *,
        live: np.ndarray | None = None,
        sizes: Sequence[float] = SIZES,
        scale: float = 1.0,
        side: int = SIDE,
        budget: int = BUDGET,
        probes: int | None = PROBES,
        cache: int = CACHE,
        device: str = "cpu",
    ):
        """Makes an empty volume.

        Args:
            position: [N, 3], of all probes, in the unit of `sizes`.
            decode: From positions float64 [M, 3] to the probes' numbers, float32 [M, D].
            channels: D, 27 for L2 in RGB.
            live: bool [N], false for probes to leave out; None: all are live.
            sizes: Side of a block at each level, from the finest; the paper's are metres.
            scale: Factor on all sizes, for scenes in another unit or of another size.
            side: Blocks along an axis of a window, even, 2 to 128.
            budget: Most blocks to decode in a frame.
            probes: Most probes to decode for a block; None: all of them.
            cache: Most blocks to keep for their return, the least recently used ones giving way; 0: none.
            device: Where the volume lies.

        Raises:
            WlmError: A setting is out of its range, or the device isn't there.
            ValueError: `position` or `live` has a wrong shape, or a position isn't finite.
        """
        self.sizes = tuple(float(size) * float(scale) for size in sizes)
        rising = all(a < b for a, b in zip(self.sizes, self.sizes[1:], strict=False))
        if not self.sizes or not rising or not _SMALLEST <= self.sizes[0] or not self.sizes[-1] <= 1.0 / _SMALLEST:
            limits = f"{_SMALLEST:g} to {1.0 / _SMALLEST:g}"
            raise WlmError(f"volume sizes: expected rising numbers from {limits}, got {list(sizes)} times {scale:g}")
        if not 2 <= side <= _LONGEST or side % 2:
            raise WlmError(f"volume side: expected an even number of blocks from 2 to {_LONGEST}, got {side}")
        if budget < 1:
            raise WlmError(f"volume budget: expected at least 1 block a frame, got {budget}")
        if probes is not None and probes < 1:
            raise WlmError(f"volume probes: expected at least 1 probe a block, got {probes}")
        if cache < 0:
            raise WlmError(f"volume cache: expected 0 blocks or more, got {cache}")
        if channels < 1:
            raise ValueError(f"channels: expected at least 1, got {channels}")
        position = np.asarray(position, np.float64)
        if live is not None:
            live = np.asarray(live)
            if live.shape != position.shape[:1] or live.dtype != bool:
                raise ValueError(f"live: expected bool {list(position.shape[:1])}, got {live.dtype} {list(live.shape)}")
            position = position[live]
        self.index = ProbeIndex(position, self.sizes[0])
        self.position = position
        self.side, self.budget, self.channels = side, budget, channels
        self.device = interop.check_device(device)
        self._decode = decode
        self._probes = probes
        self._cache = _BlockCache(cache, channels)
        levels, slots = len(self.sizes), len(self.sizes) * side**3
        self._size = np.array(self.sizes)
        self._level = np.repeat(np.arange(levels), side**3)
        # Of each slot within its level's grid, along each axis.
        self._place = np.tile(np.indices((side,) * 3).reshape(3, -1).T, (levels, 1))
        self._viewpoint = None
        self._base = np.zeros((levels, 3), np.int64)
        self._block = np.full((slots, 3), kernels.NOTHING, np.int64)  # that the window wants in each slot
        self._held = self._block.copy()  # that each slot holds, as on the device
        self._waiting = np.zeros(slots, bool)
        self._values = wp.zeros((slots, channels), dtype=float, device=self.device)
        self._held_device = wp.full(slots, wp.vec3i(kernels.NOTHING), dtype=wp.vec3i, device=self.device)
        self._bases = wp.zeros(levels, dtype=wp.vec3i, device=self.device)
        self._views = wp.zeros(levels, dtype=wp.vec4, device=self.device)
        wp.load_module(kernels, device=self.device)  # compiled now, not in the first frame

    @property
    def memory_bytes(self) -> int:
        """Memory of the volume on its device, in bytes; constant."""
        return sum(array.capacity for array in (self._values, self._held_device, self._bases, self._views))

    @property
    def host_bytes(self) -> int:
        """Host memory of the index, the cache and the slot tables, in bytes."""
        tables = (self._level, self._place, self._block, self._held, self._waiting)
        return sum(array.nbytes for array in tables) + self.index.memory_bytes + self._cache.memory_bytes

    def update(self, viewpoint: np.ndarray) -> FrameStats:
        """Moves the windows to a viewpoint and fills up to `budget` of the blocks that are missing.

        Blocks wait in the order of the distance of their centre to the viewpoint over their side; of two alike, the
        finer goes first, then the one of the lower slot. Those that leave their window are dropped.

        Args:
            viewpoint: [3], in the unit of the positions.

        Returns:
            What was done.

        Raises:
            WlmError: The viewpoint isn't three finite numbers, or so far out that a block has no number.
            ValueError: `decode` gave another shape than [M, D], or a number that isn't finite.
        """
        clock = _Clock()
        viewpoint = np.array(viewpoint, np.float64)
        if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
            raise WlmError(f"viewpoint: expected three finite numbers, got {viewpoint.tolist()}")
        if np.abs(viewpoint).max() > _FARTHEST * self.sizes[0]:
            limit = _FARTHEST * self.sizes[0]
            raise WlmError(f"viewpoint: expected at most {limit:g} from the origin, got {viewpoint.tolist()}")
        entered, dropped = self._move(viewpoint)
        arrived = entered[self._waiting[entered]]
        hit, rows = self._cache.find(self._keys(arrived))
        cached = arrived[hit]
        clock.lap("find")
        self._views.assign(self._view(viewpoint))
        self._write(cached, rows)
        clock.lap("upload")

        chosen = self._next()
        probes, offsets = _thin(*self._find(chosen), self._probes)
        unique, which = np.unique(probes, return_inverse=True)
        clock.lap("find")
        decoded = self.decode(self.position[unique])
        values = self._combine(chosen, probes, offsets, decoded[which])
        clock.lap("decode")
        self._cache.put(self._keys(chosen), values)
        self._write(chosen, values)
        clock.lap("upload")
        return FrameStats(
            entered=len(entered),
            queued=len(arrived) - len(cached),
            dropped=dropped,
            updated=len(chosen),
            cached=len(cached),
            left=int(np.count_nonzero(self._waiting)),
            probes=len(unique),
            find_seconds=clock.seconds["find"],
            decode_seconds=clock.seconds["decode"],
            upload_seconds=clock.seconds["upload"],
        )

    def read(self, points: np.ndarray) -> Reading:
        """Reads the light at points, as `wlm_kernels.probe.volume.read` says; at float32's precision near the viewer.

        Args:
            points: [M, 3], in the unit of the positions. One that is NaN or infinite is covered by nothing.

        Returns:
            The light there.

        Raises:
            ValueError: Nothing has been updated yet, or a wrong shape.
        """
        points = np.asarray(points, np.float64)
        if self._viewpoint is None or points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"read: expected points [M, 3] after an update, got {points.shape}")
        # Taken from the viewpoint in float64, so that a viewer far from the origin loses nothing.
        with np.errstate(over="ignore"):
            relative = (points - self._viewpoint).astype(np.float32)
        on_device = wp.array(relative, dtype=wp.vec3, device=self.device)
        values = wp.empty((len(points), self.channels), dtype=float, device=self.device)
        level = wp.empty(len(points), dtype=int, device=self.device)
        weight = wp.empty(len(points), dtype=float, device=self.device)
        self.read_into(on_device, values, level, weight)
        return Reading(values.numpy(), level.numpy(), weight.numpy())

    def read_into(self, points: wp.array, values: wp.array, level: wp.array, weight: wp.array) -> None:
        """Reads the light at points that lie on the device, without a copy: the path of a renderer.

        Args:
            points: vec3 [M], relative to the viewpoint of the last update.
            values: float [M, D], written; this and the next two as in `Reading`.
            level: int [M], written.
            weight: float [M], written.
        """
        kernels.read(
            self._values, self._held_device, self._bases, self._views, self.side, points, values, level, weight
        )

    def unscroll(self) -> tuple[np.ndarray, np.ndarray]:
        """The windows in the order of space, as a texture for each level (the last step of section 3.4).

        Returns:
            float32 [L, side, side, side, D], by level, x, y and z, 0 where a block isn't there; and bool
            [L, side, side, side], true where it is. The first block of each level is that of `base`.
        """
        out = wp.empty(self._values.shape, dtype=float, device=self.device)
        valid = wp.empty(len(self._held_device), dtype=wp.uint8, device=self.device)
        kernels.unscroll(self._values, self._held_device, self._bases, self.side, out, valid)
        shape = (len(self.sizes), self.side, self.side, self.side)
        return out.numpy().reshape(*shape, self.channels), valid.numpy().astype(bool).reshape(shape)

    def decode(self, position: np.ndarray) -> np.ndarray:
        """The light at probes themselves, float32 [M, D], by the function that the volume was given.

        Args:
            position: float64 [M, 3].

        Raises:
            ValueError: It gave another shape, or a number that isn't finite.
        """
        if len(position) == 0:
            return np.zeros((0, self.channels), np.float32)
        values = np.asarray(self._decode(position), np.float32)
        if values.shape != (len(position), self.channels):
            raise ValueError(f"decode: expected {(len(position), self.channels)}, got {values.shape}")
        if not np.isfinite(values).all():
            raise ValueError("decode: expected finite numbers, got NaN or infinity")
        return values

    @property
    def base(self) -> np.ndarray:
        """int64 [L, 3], coordinates of the first block of each window; block b spans [b, b + 1) times its side."""
        return self._base.copy()

    def _move(self, viewpoint: np.ndarray) -> tuple[np.ndarray, int]:
        """Moves the windows; returns the slots whose block changed, and how many of them dropped one that waited."""
        base = np.floor(viewpoint / self._size[:, None] + 0.5).astype(np.int64) - self.side // 2
        moved = np.flatnonzero((base != self._base).any(1) | (self._viewpoint is None))
        self._viewpoint = viewpoint
        if len(moved) == 0:
            return moved, 0
        self._base = base
        self._bases.assign(base.astype(np.int32))
        count = self.side**3
        slots = (moved[:, None] * count + np.arange(count)).ravel()
        at = base[self._level[slots]]
        block = at + (self._place[slots] - at) % self.side
        new = (block != self._block[slots]).any(1)
        entered = slots[new]
        dropped = int(np.count_nonzero(self._waiting[entered]))
        # A block was in use as long as it was in its window, not only when it was decoded.
        self._cache.touch(self._keys(entered[(self._held[entered] == self._block[entered]).all(1)]))
        self._block[entered] = block[new]
        self._waiting[entered] = False
        absent = entered[(self._held[entered] != self._block[entered]).any(1)]
        _, offsets = self._find(absent)
        self._waiting[absent[np.diff(offsets) > 0]] = True
        return entered, dropped

    def _view(self, viewpoint: np.ndarray) -> np.ndarray:
        """float32 [L, 4], the kernels' views."""
        place = viewpoint / self._size[:, None] - (self._base + self.side // 2) - 0.5
        return np.concatenate([place, 1.0 / self._size[:, None]], 1).astype(np.float32)

    def _next(self) -> np.ndarray:
        """The slots to fill in this frame."""
        waiting = np.flatnonzero(self._waiting)
        level = self._level[waiting]
        away = self._block[waiting] + 0.5 - self._viewpoint / self._size[level, None]
        return waiting[np.argsort((away**2).sum(1), kind="stable")[: self.budget]]

    def _find(self, slots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The probes in the blocks of slots, as `ProbeIndex.query` gives them."""
        size = self._size[self._level[slots], None]
        # The upper corner as the next block computes its lower one: a probe lies in one of the two, rounding or not.
        return self.index.query(self._block[slots] * size, (self._block[slots] + 1) * size)

    def _combine(self, slots: np.ndarray, probes: np.ndarray, offsets: np.ndarray, values: np.ndarray) -> np.ndarray:
        """float32 [B, D], the light at the blocks' centres, of the values [M, D] of their probes."""
        if len(slots) == 0:
            return np.zeros((0, self.channels), np.float32)
        owner = np.repeat(np.arange(len(slots)), np.diff(offsets))
        # In sides of the block.
        away = self.position[probes] / self._size[self._level[slots], None][owner] - (self._block[slots][owner] + 0.5)
        weight = 1.0 / ((away**2).sum(1) + _SOFTENING**2)
        weight /= np.add.reduceat(weight, offsets[:-1])[owner]
        return np.add.reduceat(weight[:, None] * values, offsets[:-1]).astype(np.float32)

    def _write(self, slots: np.ndarray, values: np.ndarray) -> None:
        """Writes the blocks of slots to the device; they wait no longer."""
        if len(slots) == 0:
            return
        block = self._block[slots]
        kernels.scatter(
            wp.array(slots.astype(np.int32), dtype=int, device=self.device),
            wp.array(block.astype(np.int32), dtype=wp.vec3i, device=self.device),
            wp.array(values, dtype=float, device=self.device),
            self._values,
            self._held_device,
        )
        wp.synchronize_device(self.device)  # so that the clock shows what it costs
        self._held[slots] = block
        self._waiting[slots] = False

    def _keys(self, slots: np.ndarray) -> list[tuple[int, ...]]:
        """(level, x, y, z) of the blocks that the windows want in slots."""
        return list(map(tuple, np.column_stack([self._level[slots], self._block[slots]]).tolist()))


def _thin(probes: np.ndarray, offsets: np.ndarray, most: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Keeps at most so many probes of each block of `ProbeIndex.query`, evenly spaced in their order."""
    count = np.diff(offsets)
    if most is None or (count <= most).all():
        return probes, offsets
    owner = np.repeat(np.arange(len(count)), count)
    number, total = np.arange(len(probes)) - offsets[owner], count[owner]
    chosen = (total <= most) | (number * most // total != (number - 1) * most // total)
    return probes[chosen], np.concatenate([[0], np.cumsum(np.minimum(count, most))])


class _BlockCache:
    """Finished blocks by (level, x, y, z); the least recently used ones give way."""

    def __init__(self, capacity: int, channels: int):
        self._values = np.empty((capacity, channels), np.float32)  # takes up memory as it is filled
        self._row: OrderedDict[tuple[int, ...], int] = OrderedDict()  # the least recently used first

    @property
    def memory_bytes(self) -> int:
        """Bytes of the cached values."""
        return len(self._row) * self._values.itemsize * self._values.shape[1]

    def touch(self, keys: list[tuple[int, ...]]) -> None:
        """Marks blocks as used now; those that aren't there don't matter."""
        for key in keys:
            if key in self._row:
                self._row.move_to_end(key)

    def find(self, keys: list[tuple[int, ...]]) -> tuple[np.ndarray, np.ndarray]:
        """bool [B], which blocks are there; and their numbers, float32 [hits, D]. They are used now."""
        self.touch(keys)
        rows = np.array([self._row.get(key, -1) for key in keys], np.int64)
        return rows >= 0, self._values[rows[rows >= 0]]

    def put(self, keys: list[tuple[int, ...]], values: np.ndarray) -> None:
        """Keeps blocks [B, D]."""
        for key, value in zip(keys, values, strict=True):
            row = self._row.pop(key, None)
            if row is None:
                if len(self._values) == 0:
                    return
                full = len(self._row) == len(self._values)
                row = self._row.popitem(last=False)[1] if full else len(self._row)
            self._row[key] = row
            self._values[row] = value


class _Clock:
    """Seconds by stage."""

    def __init__(self):
        self.seconds = {"find": 0.0, "decode": 0.0, "upload": 0.0}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Counts the time since the last lap towards a stage."""
        now = time.perf_counter()
        self.seconds[stage] += now - self._last
        self._last = now
