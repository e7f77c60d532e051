"""Fits a compressed model to a lightmap set (neural-dynamic-gi, sections 3.4 and 4)."""

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from wlm.dispatch import CPU_LANES, Place, Task, gathered
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.formats.parts import Part
from wlm.lightmap.data import LightmapSet, SheetFrames
from wlm.lightmap.encodings.frames import choose_frames, encode_frames, missing_encoder
from wlm.lightmap.encodings.maps import check_packable
from wlm.lightmap.evaluation import lost_light
from wlm.lightmap.model import LightmapModel, SheetModel, decode_scale, encode_scale, part_table
from wlm.lightmap.profile import Profile
from wlm.lightmap.tiles import TILE, TileGrid, TileKind, check_index, classify, cut, split
from wlm.lightmap.trainer import Fitter, TileJob
from wlm.system import Meter, OnProgress
from wlm.workers import cores, each
from wlm_kernels.lightmap.matrix_step import WIDTHS

BATCH_TEXELS = 64 * 26 * TILE * TILE
"""Largest number of texels, counted at each time, in a batch: 64 tiles at 26 times, 330 MB of training data."""

CPU_TILES = 4
"""Largest number of tiles in a batch on a CPU: two cores gain nothing from more, and many cores want many batches."""

_LOOK = 32  # tiles that are classified between two looks at the clock: some seconds
_WORTHWHILE = 20_000_000  # samples that take two cores about 20 s: a process takes 3 s to start
_FITTED = ("net", "uv", "uvt", "ut", "vt")  # arrays that a trainer returns
_CONSTANT_ERROR = 0.01  # largest relative error of half floats of constant radiance; near 6e-8 they are further off

Parts = dict[str, np.ndarray]


@dataclass(frozen=True, eq=False)
class Batch:
    """Dynamic tiles of one sheet (three channels), which are fitted together; `rows` are theirs in the arrays of the
    sheet's model. Batches are numbered from 0."""

    number: int
    rows: range
    fit: "SheetFit"


def compress(
    lightmaps: LightmapSet,
    profile: str | os.PathLike[str] | Profile = "M",
    *,
    tiles: Sequence[int] | None = None,
    seed: int = 0,
    device: str = "cpu",
    workers: int | None = None,
    cluster: str | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    **settings: Any,
) -> LightmapModel:
    """Compresses a lightmap set: fits feature maps and a small network to each tile of 128 x 128 texels.

    Args:
        lightmaps: The set.
        profile: The settings: a name, the path of a YAML file, or a `Profile`.
        tiles: Numbers of the tiles to compress, only for a set with one sheet; None: all. Other tiles are stored as
            empty.
        seed: One seed gives one result on one device.
        device: "cpu", "cuda" or "cuda:N".
        workers, cluster: Where batches of tiles are fitted side by side, with the same result: see
            `wlm.dispatch.Place`. On a CPU there is usually one worker for two cores, fewer for short fits.
        progress: Called about twice a second; in the stage "fit" with the loss and "PSNR dB" of the latest samples,
            relative to each tile's range. The stages "tiles" and "frames" may come before it.
        checkpoint: From `open_checkpoint`: keeps a running fit, and resumes an interrupted one.
        settings: Values that replace fields of the profile, such as `steps=500`.

    Returns:
        The model; its `warnings` name the settings that could not be followed, and light that was lost although the
        PSNR is high, see `wlm.lightmap.evaluation.lost_light`.

    Raises:
        WlmError: There is no such profile, setting, device, tile or cluster; the checkpoint is of another fit; the fit
            diverged; workers died again and again; or the settings ask for frames without a BC7 encoder.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written.
    """
    place = Place(device, workers, cluster)
    here = place.here  # an error before the set is classified
    profile = Profile.load(profile).override(settings)
    if device != "cpu" and profile.hidden not in WIDTHS:
        raise WlmError(f"hidden: expected {', '.join(map(str, WIDTHS))} on a GPU, got {profile.hidden}")
    if tiles is not None and len(lightmaps.sheets) > 1:
        raise WlmError(f"{lightmaps.name}: tiles: expected a set with one sheet, found {len(lightmaps.sheets)}")
    fits = {sheet: SheetFit(own, profile.for_sheet(sheet), tiles, progress) for sheet, own in lightmaps.sheets.items()}
    # Several GPUs get equal work; a resumed fit has the batches that it began with.
    split = (checkpoint and checkpoint.split) or (len(set(place.devices())) if cluster is None else workers or 1)
    if checkpoint is not None:
        checkpoint.split = split
    whole = sum(fit.whole_batches for fit in fits.values())
    share = whole / (split * max(1, math.ceil(whole / split)))
    batches: list[Batch] = []
    for fit in fits.values():
        batches += fit.batches(len(batches), share, CPU_TILES if device == "cpu" else None)
    sheets = {sheet: fit.model for sheet, fit in fits.items()}
    if place == Place():
        samples = profile.steps * profile.samples * sum(len(batch.rows) for batch in batches)
        place = Place(workers=max(1, min(cores() // CPU_LANES, samples // _WORTHWHILE)))
    tasks = [
        Task((each.number,), profile.steps, partial(each.fit.job, each), "tiles", each.fit.table(each))
        for each in batches
    ]
    meter, worker = Meter(progress, "fit", profile.steps * len(batches)), (Fitter, seed, progress is not None)
    for number, parts in gathered(worker, tasks, meter, place, checkpoint).items():
        batches[number].fit.store(batches[number], parts, checkpoint)
    # Sheets of an atlas and a size share one mask.
    masks = {(sheet.atlas, own.mask.shape): own.mask for sheet, own in reversed(sheets.items())}
    for sheet, own in sheets.items():
        own.mask = masks[sheet.atlas, own.mask.shape]
    warnings = tuple(dict.fromkeys(fit.warning for fit in fits.values() if fit.warning))
    counts = {len(own.times) for own in lightmaps.sheets.values()}
    # Groups with other numbers of times have maps of other sizes.
    stored = profile.for_times(*counts) if len(counts) == 1 else profile
    model = LightmapModel(lightmaps.name, lightmaps.source, stored, sheets, warnings)
    model.warnings += tuple(lost_light(model, lightmaps, here))
    return model


def open_checkpoint(
    output: str | os.PathLike[str],
    lightmaps: LightmapSet,
    profile: str | os.PathLike[str] | Profile = "M",
    *,
    tiles: Sequence[int] | None = None,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
    **settings: Any,
) -> Checkpoint:
    """Opens the checkpoint of a fit: the file `OUTPUT.partial`, which names everything that the fit depends on.

    Args:
        output: The `.wlm` that the fit will be saved to.
        lightmaps, profile, tiles, seed, settings: As for `compress`.
        device: Device of the fit. It can only be resumed on the same kind of device: CPU, or any GPU.
        resume: Whether to continue from the file, if there is one. Otherwise it is ignored, and replaced at the first
            save.
        every: Seconds between two saves of a running fit; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged, or of another fit; the line names the difference.
    """
    profile = Profile.load(profile).override(settings)
    if profile.frames == "auto" and missing_encoder(0):
        profile = profile.override({"frames": "never"})
    fit = {
        "input": lightmaps.source,
        # The period is not part of the input's hash, but the time axis wraps by it.
        "period": lightmaps.period,
        "profile": profile.model_dump(mode="json"),
        "tiles": None if tiles is None else sorted(int(tile) for tile in tiles),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(output, "lightmap", fit, lightmaps.source, resume=resume, every=every)


@dataclass(frozen=True, eq=False)
class _Facts:
    """Numbers of one tile that the file stores beside its maps and network, rounded as in the file (section 4)."""

    kind: TileKind
    scale: np.ndarray | None = None  # uint8 [T, 3] of a dynamic tile, codes of the channel means
    peak: np.ndarray | None = None  # uint8 [T] of a dynamic tile, codes of the largest colour
    affine: np.ndarray | None = None  # [2, 3] of a dynamic tile, shift and spread
    constant: np.ndarray | None = None  # float64 [T, 3], radiance of a constant tile


class SheetFit:
    """The tiles of a sheet to be fitted, by rising number, int [N], with their kinds, and the model that receives their
    maps and networks; those of batches that are not stored yet are still missing. `warning` is a setting that could not
    be followed, or None; `whole_batches` is the number of dynamic tiles over that of the largest batch.

    Tiles are cut out of the sheet as they are needed, a few at a time: all tiles of a large set do not fit in memory.
    """

    def __init__(
        self,
        lightmaps: SheetFrames,
        profile: Profile,
        tiles: Sequence[int] | None = None,
        progress: OnProgress | None = None,
    ) -> None:
        """Classifies the tiles, all or those of the given numbers, and encodes those that are stored as frames."""
        # Frames are chosen by the sizes that the profile names, so that two states stay frames.
        fitted, self._lightmaps = profile.for_times(len(lightmaps.times)), lightmaps
        grid, times = TileGrid.of(*lightmaps.mask.shape), len(lightmaps.times)
        self.index = np.arange(grid.count) if tiles is None else np.array(sorted(tiles), np.int64)
        check_index(self.index, grid)
        meter = Meter(progress, "tiles", len(self.index))
        facts = _classify(lightmaps, self.index, meter, profile.gamma, profile.peak)
        self.kinds = np.array([tile.kind for tile in facts])
        framed = choose_frames(self.kinds, times, profile)
        self.warning = None
        if profile.frames == "auto" and framed.any() and (warning := missing_encoder(int(framed.sum()))):
            self.warning, framed[:] = f"{lightmaps.name}: {warning}", False
        self.kinds[framed] = TileKind.FRAMES
        kind = np.zeros(grid.count, np.uint8)
        kind[self.index] = self.kinds
        table = part_table(fitted, kind, times)
        arrays = {name: np.zeros(part.shape, part.dtype) for name, part in table.items() if name != "constant"}
        values = np.array([tile.constant for tile in facts if tile.kind == TileKind.CONSTANT]).reshape(-1, times, 3)
        half = values.astype(np.float16)
        self.model = SheetModel(
            name=lightmaps.name,
            width=grid.width,
            height=grid.height,
            times=lightmaps.times,
            period=lightmaps.period,
            profile=fitted,
            mask=lightmaps.mask,
            kind=kind,
            constant=half if (np.abs(half - values) <= _CONSTANT_ERROR * values).all() else values.astype(np.float32),
            **arrays,
        )
        self._dynamic = np.flatnonzero(self.kinds == TileKind.DYNAMIC)
        self._largest = max(1, BATCH_TEXELS // (times * TILE * TILE))
        self.whole_batches = len(self._dynamic) / self._largest
        for i, row in enumerate(self._dynamic):
            fact = facts[row]
            self.model.scale[i], self.model.peak[i], self.model.affine[i] = fact.scale, fact.peak, fact.affine
        # The axis and the scales of a sheet do not change during a fit.
        self._axis, self._scale = self.model.axis, self.model.scales
        framed_rows = np.flatnonzero(self.kinds == TileKind.FRAMES)
        meter = Meter(progress, "frames", len(framed_rows))
        for i, number in enumerate(self.index[framed_rows].tolist()):
            tile = split(lightmaps, profile.gamma, [number])
            self.model.frames[i], self.model.ranges[i] = encode_frames(tile.colour[0], tile.mask[0])
            if meter.due(i + 1):
                meter.report(i + 1)

    def batches(self, first: int, share: float = 1.0, most: int | None = None) -> list[Batch]:
        """Splits the dynamic tiles into batches, numbered from `first`: equal ones of about a share of the largest
        batch, or if it is given of `most` tiles."""
        rows, size = range(len(self._dynamic)), min(most or self._largest, self._largest)
        if rows and most is None:
            size = math.ceil(len(rows) / math.ceil(len(rows) / math.ceil(share * size)))
        starts = enumerate(rows[::size], first)
        return [Batch(number, rows[start : start + size], self) for number, start in starts]

    def job(self, batch: Batch) -> TileJob:
        """Returns the data of a batch that is sent to a worker."""
        return TileJob(
            cut(self._lightmaps, self.index[self._dynamic[batch.rows]]),
            self._scale[batch.rows],
            self.model.affine[batch.rows].astype(np.float32),
            self.model.profile,
            self._axis,
        )

    def table(self, batch: Batch) -> dict[str, Part]:
        """Returns the types and shapes of the arrays that the trainer returns for a finished batch, by name."""
        kind = np.full(len(batch.rows), TileKind.DYNAMIC, np.uint8)
        table = part_table(self.model.profile, kind, len(self.model.times))
        return {name: table[name] for name in _FITTED}

    def store(self, batch: Batch, parts: Parts, checkpoint: Checkpoint | None = None) -> None:
        """Copies the maps and networks of a finished batch, which may come from a checkpoint, into the model."""
        try:
            check_packable(parts, self.model.profile)
        except WlmError as error:
            raise WlmError(f"{checkpoint and checkpoint.path}: finished batch {batch.number}: {error}") from error
        for name in _FITTED:
            getattr(self.model, name)[batch.rows] = parts[name]


def _classify(
    lightmaps: SheetFrames, numbers: np.ndarray, meter: Meter, gamma: float, peak: float | None
) -> list[_Facts]:
    """Classifies tiles and computes the numbers that normalise each (section 4); for the settings see `Profile`."""

    def look(number: int) -> _Facts:
        tile = cut(lightmaps, np.array([number]))
        colour = np.power(tile.light[0][:, tile.mask[0]], np.float32(1.0 / gamma))  # [T, K, 3], the valid texels
        kind = classify(colour, gamma, peak)
        if kind == TileKind.EMPTY:
            return _Facts(kind)
        if kind == TileKind.CONSTANT:
            radiance = colour.astype(np.float64) ** gamma
            # The middle of the range is at most half a step of half float off.
            middle = 0.5 * (radiance.min(1) + radiance.max(1)) if peak is None else radiance.mean(1)
            return _Facts(kind, constant=middle)
        stored = encode_scale(colour.mean(1, dtype=np.float64), gamma)
        scale = decode_scale(stored, gamma)
        lit = scale > 0
        values = colour * np.divide(1.0, scale, out=np.zeros_like(scale), where=lit)[:, None]
        affine = np.empty((2, 3))
        for c in range(3):
            chosen = values[lit[:, c], :, c]
            shift, spread = (chosen.mean(), chosen.std()) if chosen.size else (0.0, 1.0)
            # Half floats end at 6e-8; a channel that is the same everywhere has no spread.
            affine[:, c] = shift, max(spread, 1e-4)
        largest = encode_scale(colour.max(1).max(1).astype(np.float64), gamma, up=True)
        return _Facts(kind, scale=stored, peak=largest, affine=affine)

    facts: list[_Facts] = []
    for fact in each(look, numbers.tolist()):
        facts.append(fact)
        if len(facts) % _LOOK == 0 and meter.due(len(facts)):
            meter.report(len(facts))
    return facts
