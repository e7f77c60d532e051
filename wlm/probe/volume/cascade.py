"""The cascaded lighting volume: nested grids of blocks around the viewer, filled from the probes as the viewer moves.

It implements gaussian-probe-compression, section 3.4; docs/probe-volume.md lists the departures. Blocks are stored in
the rows of one array, the pool, which is also a cache: a block that left its window stays until its row is needed. A
block without a probe near it is never decoded, takes no memory and is missing when light is read. Where light changes
over the day, blocks of another hour are decoded again. A window covers no more blocks than the scene has along each
axis, and stays on the scene. Light is read from the finest level that has a block there, as
`wlm_kernels.probe.volume.read` describes; `wlm_kernels.probe.volume_weights` describes the light of a block.

Everything except the windows' origins is computed on the device in launches of fixed sizes: on CUDA a frame is one
CUDA graph.
"""

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.hours import DAY
from wlm.probe.sphere import unit_or_zero
from wlm.probe.volume.index import BlockIndex, finest_side
from wlm.probe.volume.light import Light
from wlm_kernels.probe import volume as kernels
from wlm_kernels.probe import volume_frame as frame_kernels
from wlm_kernels.probe import volume_weights

RATIOS = (1, 2, 4, 16)
"""Side of the blocks of each level, divided by the side of the finest blocks."""

SIDE = 32
"""Most blocks along an axis of a window, the box of blocks around the viewer at each level."""

BUDGET = 64
"""Largest number of blocks decoded per frame."""

ROWS = 32768
"""Largest number of blocks that memory is allocated for: rows of the pool have 16-bit numbers."""

TOLERANCE = 0.1
"""Hours by which the light of a block may be off before it is decoded again."""

_LONGEST = 64  # largest side of a window: 262,144 blocks per level
_SMALLEST = 1e-30  # smallest side of a block: float32 holds it and its inverse
_FARTHEST = 2**30  # largest coordinate of a block: int32 on the device, with room for a window


@dataclass(frozen=True)
class FrameStats:
    """The work that one frame did, in numbers of blocks and probes.

    Attributes:
        entered: Blocks that entered a window, the box of blocks around the viewer at each level, empty ones included.
        queued: Entered blocks that have to be decoded.
        dropped: Queued blocks that left their window before they were decoded.
        updated: Blocks decoded and written, at most `Volume.budget`.
        cached: Blocks that entered a window and were still in memory from earlier frames.
        left: Blocks that still wait to be decoded, missing ones and those whose light is of another hour.
        probes: Probes decoded; a probe counts once for each block that it contributes to.
        seconds: Duration of the frame in seconds, until the device has finished.
    """

    entered: int
    queued: int
    dropped: int
    updated: int
    cached: int
    left: int
    probes: int
    seconds: float


@dataclass(frozen=True, eq=False)
class Reading:
    """The light that a volume returns at M points.

    Attributes:
        values: float32 [M, D], the light; 0 where no block covers the point.
        level: int32 [M], level with the largest weight in the value; -1 where no block covers the point.
        weight: float32 [M], fraction of the trilinear weights that blocks of any level cover; 1 if no block is missing.
    """

    values: np.ndarray
    level: np.ndarray
    weight: np.ndarray


class State(NamedTuple):
    """Copies in host memory of the arrays from which a shader reads a volume; see `wlm_kernels.probe.volume`."""

    pool: np.ndarray
    factor: np.ndarray
    pages: np.ndarray
    bases: np.ndarray
    before: np.ndarray
    views: np.ndarray


class Volume:
    """A cascaded lighting volume on a device. Call `update` once per frame, then `read`.

    Attributes:
        index: The live probes sorted by cell, and the blocks near them.
        light: Source of the probes' light.
        position: float64 [N, 3], positions of all probes.
        numbers: int64 [V], indices of the live probes.
        normal: float32 [N, 3], unit surface normals of all probes, 0 for a probe on no surface; None if unknown.
        sizes: Side of a block at each level, in the unit of the positions.
        sides: int64 [L, 3], blocks along the axes of each level's window.
        budget: Largest number of blocks decoded per frame.
        tolerance: Hours by which the light of a block may be off before it is decoded again.
        rows: Number of blocks that have memory.
        frame: Number of updates so far.
        channels: Numbers per probe, D.
        device: "cpu" or "cuda:N".
    """

    def __init__(
        self,
        position: np.ndarray,
        light: Light,
        *,
        live: np.ndarray | None = None,
        normal: np.ndarray | None = None,
        block: float | None = None,
        ratios: Sequence[int] = RATIOS,
        side: int = SIDE,
        budget: int = BUDGET,
        rows: int = ROWS,
        tolerance: float = TOLERANCE,
    ) -> None:
        """Builds an empty volume on the device of the light.

        Args:
            position: [N, 3], positions of all probes.
            light: Light of the N probes.
            live: bool [N], false for probes to leave out; None: all are live.
            normal: [N, 3], normal of each probe's surface, of any length; 0 for a probe on no surface. Blocks behind a
                probe's surface then take less of its light. None: no normal is known.
            block: Side of the finest blocks, in the unit of the positions; None: derived from the probes' spacing.
            ratios: Side of each level's blocks divided by the finest side: rising powers of two from 1, at most 8
                levels.
            side: Most blocks along an axis of a window, even, 2 to 64; a smaller scene has smaller windows.
            budget: Largest number of blocks decoded per frame, 1 to 1024.
            rows: Most blocks that memory is allocated for, from the budget to 32,768. If the windows have more blocks
                near probes, the farthest ones are never decoded.
            tolerance: Hours by which the light of a block may be off before it is decoded again, 0 to 12. Missing
                blocks come first, except in every fourth frame; a block that is twice as far away is decoded again when
                it is twice as many hours off.

        Raises:
            WlmError: A setting is out of its range.
            ValueError: `position`, `light` or `live` has a wrong shape, or a position is not finite.
        """
        position = np.asarray(position, np.float64)
        if position.shape != (light.count, 3):
            raise ValueError(f"position: expected [{light.count}, 3] for the light's probes, got {position.shape}")
        self.numbers = np.arange(len(position))
        if live is not None:
            live = np.asarray(live)
            if live.shape != position.shape[:1] or live.dtype != bool:
                raise ValueError(f"live: expected bool {list(position.shape[:1])}, got {live.dtype} {list(live.shape)}")
            self.numbers = np.flatnonzero(live)
        _check(block, ratios, side, budget, rows, tolerance)
        lit = position[self.numbers]
        self.index = BlockIndex(lit, finest_side(lit) if block is None else block, ratios)
        self.sizes = self.index.sizes
        if not _SMALLEST <= self.sizes[0] <= self.sizes[-1] <= 1.0 / _SMALLEST:
            limits = f"{_SMALLEST:g} to {1.0 / _SMALLEST:g}"
            raise WlmError(f"volume block: expected sides of all levels from {limits}, got {list(self.sizes)}")
        self.position, self.light = position, light
        self.sides = np.minimum(side, self.index.high - self.index.low + 1)
        self._half, self._last, self._slots = (
            self.sides // 2,
            self.index.high + 1 - self.sides,
            int(self.sides.prod(1).sum()),
        )
        self.budget, self.channels, self.tolerance = budget, light.channels, tolerance
        self.device = light.device
        self._size = np.array(self.sizes)
        self._viewpoint: np.ndarray | None = None
        self._base = np.zeros((len(ratios), 3), np.int64)
        self.frame, self._left, self._lacking, self._hour = 0, 0, 0, 0.0
        self.normal = None if normal is None else _unit(normal, position.shape)
        self._make(rows, self.normal)
        self._step = interop.LaunchGraph(self._work, self.device)

    def _make(self, rows: int, normal: np.ndarray | None) -> None:
        """Allocates all arrays on the device."""
        host, probes = self.index, max(1, min(frame_kernels.PROBES, self.index.count))
        slots, blocks = self.sides.prod(1), max(1, len(host.block))
        self.rows, self.budget = rows, budget = min(rows, blocks), min(self.budget, blocks)
        self._bytes: dict[str, int] = {}

        def struct(part: str, kind: Any, value: int, **contents: Any) -> Any:
            """Makes a Warp struct of copies of NumPy arrays, or of arrays of given shapes, filled with a value."""
            made = kind()
            for name, content in contents.items():
                if not isinstance(content, wp.array):
                    dtype = kind.vars[name].type.dtype
                    allocate = wp.array if isinstance(content, np.ndarray) else partial(wp.full, value=value)
                    content = allocate(content, dtype=dtype, device=self.device)
                    self._bytes[part] = self._bytes.get(part, 0) + content.capacity
                setattr(made, name, content)
            return made

        self._index = struct(
            "index",
            frame_kernels.Index,
            0,
            **{name: getattr(host, name) for name in ("key", "place", "block", "level_start")},
            number=self.numbers[host.number].astype(np.int32),
            normal=np.zeros((0, 3), np.float32) if normal is None else normal[self.numbers][host.number],
            ratios=np.array(host.ratios, np.int32),
        )
        self._windows = struct(
            "page table",
            frame_kernels.Windows,
            -1,
            starts=(np.cumsum(slots) - slots).astype(np.int32),
            sides=self.sides.astype(np.int32),
            **dict.fromkeys(("bases", "before", "views"), len(slots)),
            pages=int(slots.sum()),
        )
        given = 0 if rows == blocks else rows
        dated = 0 if self.light.time is None else rows
        tables = {"rows": blocks, "stamp": given, "owner": given, "hour": dated}
        self._pool = struct("pool", frame_kernels.Pool, -1, light=(rows, self.channels), factor=rows, **tables)
        # The light of the probes takes the place of their covariances, which are not used any more.
        shared = wp.zeros(budget * probes * max(self.channels, frame_kernels.PROBES), dtype=float, device=self.device)

        def view(shape: tuple[int, ...], dtype: Any) -> wp.array:
            return wp.array(ptr=shared.ptr, shape=shape, dtype=dtype, device=self.device)

        self._read_light = view((budget * probes, self.channels), float)
        frame = {"clock": 1, "hour": 1, "counters": 8, "histogram": frame_kernels.TOTALS, "numbers": budget * probes}
        ranked = dict.fromkeys(("gathered", "distance"), min(frame_kernels.MOST, blocks))
        ranges = dict.fromkeys(("begin", "count"), (budget, frame_kernels.HALVES))
        by_block = dict.fromkeys(("chosen", "taken", "blocks", "picked", "noise"), budget)
        by_probe = dict.fromkeys(("places", "hats", "weights"), (budget, probes))
        covariances = view((budget, probes), frame_kernels.Row)
        contents = {**frame, **ranked, **ranges, **by_block, **by_probe, "rows": covariances}
        self._frame_work = struct("work", frame_kernels.Work, 0, **contents)
        self._bytes["work"] += shared.capacity
        self._counts = counters = self._frame_work.counters
        if self.device != "cpu":
            self._counts = wp.zeros(counters.shape, dtype=int, device="cpu", pinned=True)  # quick to read
        self._look = frame_kernels.Look(self._windows, self._frame_work, 1.0 / self._size)
        self._nowhere = wp.zeros(0, dtype=wp.vec3, device=self.device)
        self._shared = shared  # the views of it do not keep it alive

    @property
    def memory(self) -> dict[str, int]:
        """The bytes of device memory of the index, the page table, the pool and the work of a frame, by part. They
        never change; the light source is not included."""
        return dict(self._bytes)

    @property
    def memory_bytes(self) -> int:
        """The bytes of device memory of the volume and its index, without its light source."""
        return sum(self._bytes.values())

    @property
    def viewpoint(self) -> np.ndarray:
        """The viewpoint of the last update, float64 [3].

        Raises:
            ValueError: There was no update.
        """
        if self._viewpoint is None:
            raise ValueError("viewpoint: there is none before the first call of `update`")
        return self._viewpoint.copy()

    @property
    def base(self) -> np.ndarray:
        """The coordinates of the first block of each level's window, int64 [L, 3]; block b spans [b, b + 1) times its
        side."""
        return self._base + self.index.start.astype(np.int64)

    def update(self, viewpoint: np.ndarray) -> FrameStats:
        """Moves the windows to a viewpoint, fills up to `budget` of the missing blocks, and waits until the device is
        done.

        Args:
            viewpoint: [3], in the unit of the positions.

        Returns:
            The work of the frame: numbers of blocks and probes, and its duration.

        Raises:
            WlmError: The viewpoint is not three finite numbers, or is so far away that the coordinates of its block
                overflow; or the light of a part of the model is damaged, which is told once: it is dark from then on.
        """
        start = time.perf_counter()
        viewpoint = np.array(viewpoint, np.float64)
        if viewpoint.shape != (3,) or not np.isfinite(viewpoint).all():
            raise WlmError(f"viewpoint: expected three finite numbers, got {viewpoint.tolist()}")
        at = viewpoint / self._size[:, None] - self.index.start
        if np.abs(at).max() > _FARTHEST:
            limit = _FARTHEST * self.sizes[0]
            raise WlmError(f"viewpoint: expected a point within {limit:g} of the probes, got {viewpoint.tolist()}")
        base = np.floor(at + 0.5).astype(np.int64) - self._half
        base = np.minimum(np.maximum(base, self.index.low), self._last)
        # Before the first frame the windows are where they share no block with those of the frame.
        before = self._base if self._viewpoint is not None else base + self.sides
        hour = self.light.time or 0.0
        # Where no window moves and no block waits, the launches would change nothing, not even which row is the oldest.
        still = self._left == 0 and hour == self._hour and np.array_equal(base, before)
        self._viewpoint, self._base, self._hour = viewpoint, base, hour
        self.frame += 1
        if self._lacking or self.light.waiting:
            self.light.prepare()
        self._look(base, before, at - base - 0.5, self.frame, hour)
        entered = queued = dropped = cached = updated = probes = 0
        if not still:
            self._step()
            entered = self._slots - int(np.maximum(self.sides - np.abs(base - before), 0).prod(1).sum())
        wp.synchronize_stream(self.device)
        if not still:
            queued, dropped, cached, self._left, updated, probes, _, self._lacking = self._counts.numpy().tolist()
        seconds = time.perf_counter() - start
        return FrameStats(entered, queued, dropped, updated, cached, self._left, probes, seconds)

    def _work(self) -> None:
        """Chooses missing blocks, finds and weights the probes near them, and writes the blocks' light to the pool."""
        work, windows = self._frame_work, self._windows
        frame_kernels.select(self._index, windows, self._pool, self.tolerance, int(self.sides.max()), work)
        if self.index.count and (self.device != "cpu" or (work.taken.numpy() >= 0).any()):
            frame_kernels.search(self._index, work)
            volume_weights.weigh(self._index, work)
            self.light.read(work.numbers, self._read_light)
            frame_kernels.combine(work, self._read_light, windows, self._pool)
        if self._counts is not work.counters:
            wp.copy(self._counts, work.counters)

    def read(self, points: np.ndarray, normals: np.ndarray | None = None) -> Reading:
        """Interpolates the light at points in float32 relative to the viewer, see `wlm_kernels.probe.volume.read`.

        Args:
            points: [M, 3], in the unit of the positions. No block covers a point that is NaN or infinite.
            normals: [M, 3], normals of the points' surfaces, of any length: the light is read half a block in front of
                the surface. None: the light is read at the points.

        Returns:
            The light at the points.

        Raises:
            ValueError: There was no update, or the shape is different.
        """
        points = np.asarray(points, np.float64)
        if self._viewpoint is None or points.ndim != 2 or points.shape[1] != 3:
            raise ValueError(f"read: expected points [M, 3] and a call of `update` before, got points {points.shape}")
        # The difference is computed in float64, so that a viewer far from the origin loses nothing.
        with np.errstate(over="ignore"):
            relative = (points - self._viewpoint).astype(np.float32)
        with interop.stream(self.device):
            on_device = wp.array(relative, dtype=wp.vec3, device=self.device)
            values = wp.empty((len(points), self.channels), dtype=float, device=self.device)
            level = wp.empty(len(points), dtype=int, device=self.device)
            weight = wp.empty(len(points), dtype=float, device=self.device)
            ahead = self._nowhere
            if normals is not None:
                ahead = wp.array(_unit(normals, points.shape), dtype=wp.vec3, device=self.device)
            windows, pool = self._windows, self._pool
            where = (windows.pages, windows.starts, windows.sides, windows.bases, windows.views)
            kernels.read(pool.light, pool.factor, *where, on_device, ahead, values, level, weight)
            return Reading(values.numpy(), level.numpy(), weight.numpy())

    def state(self) -> State:
        """Copies the arrays that a shader reads from the device to the host."""
        windows, pool = self._windows, self._pool
        parts = (pool.light, pool.factor, windows.pages, windows.bases, windows.before, windows.views)
        with interop.stream(self.device):
            return State(*(part.numpy() for part in parts))


def _unit(normal: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
    """Normalises vectors and returns them in float32; vectors of length 0 stay 0. Raises a ValueError if the shape is
    different, or a number is not finite."""
    if normal is None:
        return np.zeros(shape, np.float32)
    normal = np.asarray(normal, np.float64)
    if normal.shape != shape:
        raise ValueError(f"normal: expected the shape {list(shape)}, got {list(normal.shape)}")
    if not np.isfinite(normal).all():
        raise ValueError("normal: expected finite numbers, got NaN or infinity")
    return unit_or_zero(normal).astype(np.float32)


def _check(block: float | None, ratios: Sequence[int], side: int, budget: int, rows: int, tolerance: float) -> None:
    """Checks that the settings are in their ranges."""
    if block is not None and not _SMALLEST <= block <= 1.0 / _SMALLEST:
        raise WlmError(f"volume block: expected a side from {_SMALLEST:g} to {1.0 / _SMALLEST:g}, got {block:g}")
    rising = list(ratios[:1]) == [1] and all(a < b for a, b in itertools.pairwise(ratios))
    if not rising or len(ratios) > frame_kernels.LEVELS or any(r & (r - 1) or r > 1024 for r in ratios):
        raise WlmError(
            f"volume ratios: expected up to 8 rising powers of two, from 1 to 1024 at most, got {list(ratios)}"
        )
    if not 2 <= side <= _LONGEST or side % 2:
        raise WlmError(f"volume side: expected an even number of blocks from 2 to {_LONGEST}, got {side}")
    if not 1 <= budget <= 1024:
        raise WlmError(f"volume budget: expected 1 to 1024 blocks a frame, got {budget}")
    if not budget <= rows <= ROWS:
        raise WlmError(f"volume rows: expected from the budget of {budget} to {ROWS} blocks, got {rows}")
    if not 0 <= tolerance <= DAY / 2:
        raise WlmError(f"volume tolerance: expected 0 to {DAY / 2:g} hours, got {tolerance}")
