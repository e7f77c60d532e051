"""Error of a decoded lightmap as a renderer shows it: filtered, between stored hours, over time, in views of a mesh.

The paper's protocol (`wlm.metrics`) compares the centres of valid texels at the stored times. A renderer reads
filtered light at any hour, so that texels of gaps between charts and of neighbouring tiles matter too. The scores of
this module cover the same tiles and times, and errors are relative to a tile's range at a time, too. The scores are
described in docs/lightmap.md and at `ShownScore`. Random points and times are the same in every run, and reads are
clamped at the edges of the map.

`flicker` takes two steps of 3 minutes (1/480 of the period) at a random time in each of 12 intervals between stored
times. With D the decoded and R the original light, it is the mean over valid texels, tiles and steps of

    max(|D(t + step) - D(t)| - |R(t + step) - R(t)|, 0) / range

Views: cameras are spread evenly on a sphere around the set's mesh (`wlm.ops.views`); each draws one stored time, in
turn. Back faces are not drawn, so that a room is visible through its walls. A pixel is the light of the lightmap at its
surface point, read bilinearly, displayed with that time's exposure (`wlm.texels.exposure`), Reinhard's curve and sRGB.
Pixels without a surface do not count.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from scipy.sparse import csr_array

from wlm import system
from wlm.errors import WlmError
from wlm.formats.geometry import Geometry, read_geometry
from wlm.interop import check_device
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.tiles import TILE, TileGrid, valid_texels
from wlm.metrics import MIN_VALID_TEXELS, FrameMetrics, Pictures, evaluate_frame, lowest, nanmean, psnr_from_mse
from wlm.ops import raster
from wlm.ops.views import sphere_views, visible_points
from wlm.texels import exposure, filmic, nearest_valid, to_srgb

VIEWS, RESOLUTION = 50, 512
"""Number of cameras, and pixels along a side of a view."""


@dataclass(frozen=True)
class ViewScore(system.Report):
    """The error in rendered views. If no view shows the mesh, its fields are NaN or None.

    Attributes:
        views: Number of views that show the mesh.
        view_psnr: PSNR of the displayed colours in [0, 1], over the covered pixels of all views, dB.
        view_flip: FLIP, mean over the covered pixels of all views, in [0, 1].
        worst_view: The view with the lowest PSNR: `view` (its number), `time`, `psnr`, `flip`.
    """

    views: int
    view_psnr: float
    view_flip: float
    worst_view: dict[str, float | int] | None


NO_VIEWS = ViewScore(0, math.nan, math.nan, None)
"""The score of a set without a mesh."""


class Views:
    """Renders the views and accumulates their error, time by time."""

    def __init__(self, lightmaps: SheetFrames, geometry: Geometry, count: int, device: str = "cpu") -> None:
        """Places `count` cameras for the times of a sheet; `geometry` has UVs."""
        self._lightmaps, self._geometry, self._device = lightmaps, geometry, check_device(device)
        low, high = geometry.box
        if not (high > low).any():
            raise WlmError("expected a mesh with an extent, found all vertices at one point")
        self._cameras: dict[int, list[int]] = {index: [] for index in range(len(lightmaps.times))}
        for number in range(count):
            self._cameras[number % len(lightmaps.times)].append(number)
        self._views = sphere_views(count)
        self._rows: list[dict[str, float | int]] = []
        self._pictures = Pictures()

    def add(self, index: int, original: np.ndarray, decoded: np.ndarray) -> None:
        """Draws the views of the time of an index from the original and the decoded map, linear radiance float32 [H, W,
        3] with gaps filled, and adds their errors."""
        numbers = self._cameras[index]
        if not numbers:
            return
        gain = np.float32(exposure(self._lightmaps.frames[index][self._lightmaps.mask]))
        images = [torch.tensor(image, device=self._device) for image in (original, decoded)]
        mesh, cameras = self._geometry, [self._views[number] for number in numbers]
        drawn = visible_points(mesh.position, mesh.triangle, mesh.uv, cameras, RESOLUTION, self._device, cull=True)
        for number, (visible, _, uv) in zip(numbers, drawn, strict=True):
            hit = (visible >= 0).cpu().numpy()
            pictures = []
            for image in images:
                light = raster.texture(image, uv).cpu().numpy() * gain
                pictures.append(to_srgb(filmic(np.maximum(light, 0.0))) * hit[..., None])
            figures = self._pictures.add(*pictures, hit)
            if figures is not None:
                self._rows.append({"view": number, "time": float(self._lightmaps.times[index])} | figures)

    def score(self) -> ViewScore:
        """Returns the score of the added times."""
        if not self._rows:
            return NO_VIEWS
        worst = min(self._rows, key=lambda row: row["psnr"])
        return ViewScore(len(self._rows), self._pictures.psnr, self._pictures.flip, worst)


def views_of(lightmaps: SheetFrames, count: int, device: str = "cpu") -> tuple[Views | None, list[str]]:
    """Makes the `Views` of a sheet, from the mesh that the sheet names. Returns None without a mesh that can be read or
    with a count of 0; and the warnings: one line if the mesh cannot be read, else none."""
    if count < 0:
        raise WlmError(f"views: expected at least 0, got {count}")
    if lightmaps.mesh is None or count == 0:
        return None, []
    device = check_device(device)
    try:
        return Views(lightmaps, read_geometry(lightmaps.mesh), count, device), []
    except WlmError as error:
        return None, [f"{lightmaps.name}: no views are scored: {error}"]


POINTS = 4
"""Number of random points of each valid texel."""

_SEED = 0
_INTERVALS, _STEPS = 12, 2  # intervals of `flicker`, and steps in each
_STEPS_OF_PERIOD, _STEP = 480, 0.05  # a step of `flicker` as a share of the period, or without one in hours


@dataclass(frozen=True)
class ShownScore(ViewScore):
    """The error of light as a renderer shows it, see the module. Scores without anything to measure are NaN or None.

    Attributes:
        seen: PSNR of bilinear reads at random points, dB, mean over tiles and times.
        seen_by_tile: float64 [rows, columns] of the grid, means over the times.
        seen_by_time: float64 [T], means over the tiles.
        worst_seen: The tile and time with the lowest `seen`, as `wlm.metrics.lowest` returns them.
        ring: PSNR of the texels of gaps that touch a chart, dB, mean over tiles and times.
        between: PSNR half-way between stored times, dB, mean over tiles and intervals.
        worst_between: The tile and interval with the lowest `between`, as in `worst_seen`; `time` is the half-way time.
        border: RMS error of reads across tile borders divided by the RMS error of reads within tiles, relative to the
            range of each texel's tile; at 1, borders are invisible.
        flicker: Mean change in a step of 3 minutes beyond the change of the original, as a share of the range.
    """

    seen: float
    seen_by_tile: np.ndarray
    seen_by_time: np.ndarray
    worst_seen: dict[str, float | int] | None
    ring: float
    between: float
    worst_between: dict[str, float | int] | None
    border: float
    flicker: float


class Tally:
    """Accumulates the scores of this module for one decoder, time by time."""

    def __init__(
        self,
        lightmaps: SheetFrames,
        mask: np.ndarray,
        decode: Callable[[float], np.ndarray] | None = None,
        views: Views | None = None,
        name: str = "lightmap",
        peak: float | None = None,
    ) -> None:
        """Prepares the scoring of one sheet.

        Args:
            lightmaps: The input.
            mask: bool [H, W], the valid texels that are scored. In tiles without any such texel, such as tiles that are
                not in the file, the decoded light counts as correct.
            decode: Returns linear radiance [H, W, 3] for any time, also between two stored ones; None: light between
                stored times is interpolated from the two decoded maps that were added (eq. 2).
            views: Views of the mesh; None for none.
            name: Name of the decoder in messages.
            peak: Fixed range that errors are relative to, as in `wlm.metrics.evaluate_frame`.
        """
        self._lightmaps, self._mask, self._decode, self._views, self._name = lightmaps, mask, decode, views, name
        self._peak = peak
        self._grid = grid = TileGrid.of(*mask.shape)
        self._count = count = len(lightmaps.times)
        # Lengths of the intervals between stored times, including the one from the last to the first.
        again = [] if lightmaps.period is None else [lightmaps.times[0] + lightmaps.period]
        self._gaps = np.diff([*lightmaps.times, *again] if count > 1 else [])
        self._middles = lightmaps.times[: len(self._gaps)] + self._gaps / 2.0
        if lightmaps.period is not None:
            self._middles %= lightmaps.period
        shape = (grid.rows, grid.cols)
        self._seen, self._rings = (np.full((count, *shape), math.nan) for _ in range(2))
        self._between = np.full((len(self._gaps), *shape), math.nan)
        chosen = np.linspace(0, len(self._gaps) - 1, min(_INTERVALS, len(self._gaps)))
        self._moving = set(chosen.round().astype(int).tolist())
        self._flicker: list[np.ndarray] = []
        self._border = np.zeros(2)
        # The decoded maps of the first and of the last added time; None if `decode` returns them again.
        self._added: dict[int, np.ndarray | None] = {}

    def add(self, index: int, decoded: np.ndarray, metrics: FrameMetrics) -> None:
        """Adds the decoded map of a stored time, linear radiance [H, W, 3]; an interval is scored once both of its ends
        are added.

        `index` rises from call to call. `metrics` are from `evaluate_frame` with the same mask: the scored tiles and
        their ranges.
        """
        filled = self._lightmaps.frames[index][self._nearest]
        decoded = np.asarray(decoded, np.float32)
        if self._left_out is not None:
            decoded = np.where(self._left_out[..., None], filled, decoded)
        with np.errstate(invalid="ignore"):
            error = decoded - filled
        ring = error[self._ring.at]
        if not np.isfinite(ring).all():
            y, x = (int(at[np.argmin(np.isfinite(ring).all(1))]) for at in self._ring.at)
            raise WlmError(f"{self._name}: a texel beside a chart decodes to NaN or infinity: row {y}, column {x}")
        self._add_points(index, error, metrics)
        squared = self._ring.sums(np.square(ring, dtype=np.float64))
        counted = metrics.scored & (self._ring.count >= MIN_VALID_TEXELS)
        for at in zip(*np.nonzero(counted), strict=True):
            self._rings[index][at] = psnr_from_mse(squared[at] / (3 * self._ring.count[at]), metrics.range[at])
        if self._views is not None:
            self._views.add(index, filled, decoded)

        self._added[index] = decoded if self._decode is None else None
        if index - 1 in self._added:
            self._add_interval(index - 1)
        if len(self._gaps) == self._count == index + 1 and 0 in self._added:
            self._add_interval(index)
        self._added = {kept: self._added[kept] for kept in (0, index) if kept in self._added}

    def score(self) -> ShownScore:
        """Returns the scores of the added times."""
        by_time, by_tile = nanmean(self._seen, axis=(1, 2)), nanmean(self._seen, axis=0)
        across, inside = self._border
        border = math.sqrt(across / inside) if inside > 0 else (math.inf if across > 0 else math.nan)
        return ShownScore(
            **vars(NO_VIEWS if self._views is None else self._views.score()),
            seen=float(nanmean(self._seen)),
            seen_by_tile=by_tile,
            seen_by_time=by_time,
            worst_seen=lowest(self._seen, self._lightmaps.times),
            ring=float(nanmean(self._rings)),
            between=float(nanmean(self._between)),
            worst_between=lowest(self._between, self._middles),
            border=border,
            flicker=float(nanmean(np.array(self._flicker))),
        )

    @functools.cached_property
    def _nearest(self) -> tuple[np.ndarray, np.ndarray]:
        return nearest_valid(self._lightmaps.mask)

    @functools.cached_property
    def _ring(self) -> _Texels:
        mask = self._lightmaps.mask
        return _Texels(binary_dilation(mask, np.ones((3, 3))) & ~mask, self._grid)

    @functools.cached_property
    def _valid(self) -> _Texels:
        return _Texels(self._mask, self._grid)

    @functools.cached_property
    def _left_out(self) -> np.ndarray | None:
        """Texels of the tiles that have valid texels but none that is scored, bool [H, W]; None without such tiles."""
        grid = self._grid
        tiles = grid.tiles_with(self._lightmaps.mask) & ~grid.tiles_with(self._mask)
        return grid.texels_of(tiles) if tiles.any() else None

    def _add_points(self, index: int, error: np.ndarray, metrics: FrameMetrics) -> None:
        """Scores `seen` and `border`. Reads are linear, so only the error map (decoded - original) has to be read."""
        grid, (read, sides) = self._grid, _points()
        ends = ((1, grid.rows * TILE + 1 - grid.height), (1, grid.cols * TILE + 1 - grid.width))
        padded = np.pad(error, (*ends, (0, 0)), mode="edge")
        spans = np.where(metrics.scored, metrics.range, math.nan).astype(np.float32).repeat(TILE, 0).repeat(TILE, 1)
        spans = np.pad(spans[: grid.height, : grid.width], ends, mode="edge")
        for row, column in np.argwhere(metrics.scored):
            y, x = row * TILE, column * TILE
            own = valid_texels(self._mask, row * grid.cols + column).ravel().repeat(POINTS)
            box = np.s_[y : y + TILE + 2, x : x + TILE + 2]
            reads = read @ padded[box].reshape(-1, 3)
            squared = np.square(reads[own], dtype=np.float64).mean(1)
            span = metrics.range[row, column]
            self._seen[index, row, column] = psnr_from_mse(squared.mean(), span)
            # At the map's ends reads are clamped.
            neighbours = np.array([row > 0, row + 1 < grid.rows, column > 0, column + 1 < grid.cols])
            two = sides[neighbours].any(0)
            crossing, inner = np.flatnonzero(two & own), squared[~two[own]]
            if len(crossing) and len(inner):
                # A neighbour without a score has no range of its own.
                relative = padded[box] / np.where(np.isnan(spans[box]), span, spans[box])[..., None]
                across = np.square(read[crossing] @ relative.reshape(-1, 3), dtype=np.float64).mean()
                self._border += len(crossing) * np.array([across, inner.mean() / span**2])

    def _add_interval(self, index: int) -> None:
        after = (index + 1) % self._count
        first, second = self._lightmaps.frames[index], self._lightmaps.frames[after]
        middle = float(self._middles[index])
        light = 0.5 * (self._added[index] + self._added[after]) if self._decode is None else self._decode(middle)
        name = f"{self._name} at {middle:g}"
        metrics = evaluate_frame(0.5 * (first + second), light, self._mask, TILE, ("psnr",), name=name, peak=self._peak)
        self._between[index] = metrics.psnr
        if index not in self._moving:
            return
        gap, period = self._gaps[index], self._lightmaps.period
        step = min(_STEP if period is None else period / _STEPS_OF_PERIOD, gap / _STEPS)
        share, at = np.float32(step / gap), self._valid.at
        allowed = share * np.abs(second[at] - first[at])
        if self._decode is None:
            changes = [share * np.abs(self._added[after][at] - self._added[index][at])]  # equal in every step
        else:
            start = np.random.default_rng((_SEED, index)).random() * (gap - _STEPS * step)
            times = self._lightmaps.times[index] + start + step * np.arange(_STEPS + 1)
            lights = [self._decode(float(time))[at] for time in (times if period is None else times % period)]
            changes = [np.abs(b - a) for a, b in pairwise(lights)]
        for change in changes:
            beyond = self._valid.sums(np.maximum(change - allowed, 0.0, dtype=np.float64))
            scale = 3 * self._valid.count * metrics.range
            self._flicker.append(np.divide(beyond, scale, out=np.full(scale.shape, math.nan), where=metrics.scored))


class _Texels:
    def __init__(self, mask: np.ndarray, grid: TileGrid) -> None:
        self.at = np.nonzero(mask)
        self._tile = self.at[0] // TILE * grid.cols + self.at[1] // TILE
        self._shape = grid.rows, grid.cols
        self.count = np.bincount(self._tile, minlength=grid.count).reshape(self._shape)

    def sums(self, values: np.ndarray) -> np.ndarray:
        """Sums values, float64 [K, 3], of the K selected texels over texels and channels by tile: [rows, columns]."""
        rows, columns = self._shape
        return np.bincount(self._tile, values.sum(1), rows * columns).reshape(self._shape)


@functools.cache
def _points() -> tuple[csr_array, np.ndarray]:
    """Returns the random points at which each tile is read, `POINTS` for each texel, row by row.

    Returns:
        The sparse matrix [16384 POINTS, 130 x 130] of bilinear weights, for a tile with one more texel on each side;
        and bool [4, 16384 POINTS]: whether a read includes texels above, below, left or right of the tile.
    """
    side = TILE + 2
    place = np.random.default_rng(_SEED).random((2, TILE, TILE, POINTS)) - 0.5
    y, x = (place + np.mgrid[:TILE, :TILE][..., None]).reshape(2, -1)
    top, left = np.floor(y).astype(np.int32), np.floor(x).astype(np.int32)
    below, right = (y - top)[:, None], (x - left)[:, None]
    texel = ((top + 1) * side + left + 1)[:, None] + np.array([0, 1, side, side + 1], np.int32)
    weight = np.concatenate([1.0 - below, below], 1)[:, [0, 0, 1, 1]]
    weight *= np.concatenate([1.0 - right, right], 1)[:, [0, 1, 0, 1]]
    read = (weight.astype(np.float32).ravel(), texel.ravel(), np.arange(0, texel.size + 1, 4))
    sides = np.stack([top < 0, top + 1 == TILE, left < 0, left + 1 == TILE])
    return csr_array(read, shape=(len(texel), side * side)), sides
