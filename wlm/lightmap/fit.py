"""Fitting a lightmap set: from checked input to a compressed model (neural-dynamic-gi, sections 3.4 and 4)."""

import math
import os
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from typing import Any

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint, CheckpointRange
from wlm.formats.parts import Part
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.dispatch import Batch, Dispatch
from wlm.lightmap.frame_packing import needed_blocks
from wlm.lightmap.frames import choose_frames, encode_frames, missing_encoder
from wlm.lightmap.level_packing import join_streams
from wlm.lightmap.model import LightmapModel, Profile, part_table
from wlm.lightmap.packing import check_packable, clear_unread
from wlm.lightmap.reads import Reads
from wlm.lightmap.survey import Facts, Survey
from wlm.lightmap.targets import Targets
from wlm.lightmap.tiles import (
    TILE,
    TileGrid,
    TileKind,
    cut,
    split,
    valid_texels,
)
from wlm.lightmap.trainer import CPU_LANES
from wlm.lightmap.video import encode_page
from wlm.lightmap.video_packing import pages
from wlm.lightmap.worker import Fitter, Piece
from wlm.system import Meter, OnProgress
from wlm.workers import Actors, Here, Processes, Workers, cores

BATCH_TEXELS = 64 * 26 * TILE * TILE  # texels times times in a batch: 64 tiles of 26 times, 330 MB of targets
CPU_TILES = 4  # in a batch on a CPU, at most: two cores gain nothing from more, and many want many batches

_WORTHWHILE = 20_000_000  # samples that two cores take some 20 s for: a process takes 3 s to start

_CONSTANT_ERROR = 0.01  # of a constant tile's radiance: half floats near their end, 6e-8, are further off


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
    checkpoint: Checkpoint | CheckpointRange | None = None,
    survey: Survey | None = None,
    **overrides: Any,
) -> LightmapModel:
    """Compresses a lightmap set.

    Args:
        lightmaps: The set.
        profile: The settings: a name, the path of a YAML file, or a `Profile`.
        tiles: Numbers of the tiles to compress; None: all. The others are stored as empty.
        seed: One seed gives one result on one device.
        device: "cpu", "cuda" or "cuda:N". Several workers on "cuda" are spread over the GPUs.
        workers: Processes that fit batches of tiles side by side; the result doesn't depend on it. 1: this process
            alone. None: on the CPU one for every two of its cores, since a batch keeps two busy, but fewer where they
            would end soon after they have started; 1 on a GPU; on a cluster as many as it has room for.
        cluster: Address of a cluster of Ray whose machines fit the tiles, as `ray.init` takes it ("auto",
            "ray://host:10001"); each worker takes two CPUs, or a GPU where the device is "cuda". None: this machine.
        progress: Called about twice a second; of the stage "fit" the figures are the loss and "PSNR dB", of the latest
            samples, by the tiled protocol. A large set has a stage "tiles" before it.
        checkpoint: From `open_checkpoint`: where a running fit is kept, and an interrupted one resumed.
        survey: Of all tiles of the set, from an earlier look at it (`wlm.lightmap.rate.Choice`).
        overrides: Settings in place of the profile's: `steps=500`.

    Returns:
        The model; its `warnings` say what could not be done as the settings ask.

    Raises:
        WlmError: No such profile, setting, device, tile or cluster; a checkpoint that isn't of this fit; the fit
            diverged; workers died again and again; or the settings ask for frames or video and the extra for it is
            missing.
        ValueError: A survey of another set, or `tiles` beside one.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written.
    """
    _devices(device, workers, cluster, 0)  # checked before the set is looked at
    if survey is not None and tiles is not None:
        raise ValueError("expected tiles or a survey of all")
    fit = _Fit(lightmaps, Profile.load(profile).override(overrides), tiles, progress, survey)
    fit.store_frames(progress)
    fit.store_video(progress)
    _run(fit, seed, device, workers, cluster, progress, checkpoint)
    return fit.model


class Trials:
    """Fits of one set with maps of several sizes, or of several lengths.

    Attributes:
        survey: Of the set, for further fits.
    """

    def __init__(
        self,
        lightmaps: LightmapSet,
        profile: Profile,
        *,
        seed: int,
        device: str,
        workers: int | None,
        cluster: str | None,
        progress: OnProgress | None,
    ) -> None:
        """Looks at the set, once for all fits.

        Args:
            lightmaps: The set.
            profile: The settings; no tile is stored as frames.
            seed, device, workers, cluster, progress: As for `compress`.
        """
        _devices(device, workers, cluster, 0)
        self._lightmaps, self._profile, self._progress = lightmaps, profile.override({"frames": "never"}), progress
        self._options = seed, device, workers, cluster
        self.survey = Survey(lightmaps, self._profile, None, progress)

    def fit(self, **changes: Any) -> tuple[LightmapModel, float]:
        """Compresses the set.

        Args:
            changes: Settings in place of the profile's, of the maps' sizes and of the training.

        Returns:
            The model, and the PSNR of its dynamic tiles by the tiled protocol in the fit's last samples; NaN without
            such a tile.
        """
        fit = _Fit(self._lightmaps, self._profile.override(changes), survey=self.survey)
        return fit.model, _run(fit, *self._options, self._progress, None, track=True)


def _run(
    fit: "_Fit",
    seed: int,
    device: str,
    workers: int | None,
    cluster: str | None,
    progress: OnProgress | None,
    checkpoint: Checkpoint | CheckpointRange | None,
    track: bool = False,
) -> float:
    """Fits the tiles that have maps, and puts them into the model; returns the PSNR of dynamic ones, where tracked."""
    batches = fit.batches(CPU_TILES if device == "cpu" else None)
    waiting = []
    for batch in batches:
        parts = checkpoint.finished(batch.number, fit.table(batch)) if checkpoint is not None else None
        if parts is None:
            waiting.append(batch)
            continue
        try:
            check_packable(parts, fit.profile, batch.kind == TileKind.DYNAMIC)
        except WlmError as error:
            raise WlmError(f"{checkpoint.path}: finished batch {batch.number}: {error}") from error
        fit.store(batch, parts)
    if not waiting:
        return math.nan
    steps = fit.profile.steps
    meter = Meter(progress, "fit", steps * len(batches))
    samples = steps * fit.profile.samples * sum(len(batch.rows) for batch in waiting)
    devices = _devices(device, workers, cluster, samples)[: len(waiting)]
    shared = (fit.profile, fit.model.axis, seed), track or progress is not None
    scores = []
    try:
        with closing(_workers(*shared, devices, workers, cluster, len(waiting))) as at:
            dispatch = Dispatch(at, fit.piece, steps, len(batches) - len(waiting), meter, checkpoint)
            for batch, parts, psnr in dispatch.run(waiting):
                fit.store(batch, parts)
                if batch.kind == TileKind.DYNAMIC and not math.isnan(psnr):
                    scores.append((psnr, len(batch.rows)))
    except (WlmError, KeyboardInterrupt):
        if checkpoint is not None:
            checkpoint.flush()
        raise
    psnr, tiles = np.array(scores).reshape(-1, 2).T
    return float(np.average(psnr, weights=tiles)) if scores else math.nan


def _devices(device: str, workers: int | None, cluster: str | None, samples: int) -> list[str]:
    """The device of each worker, of a fit that takes so many samples.

    Raises:
        WlmError: No such device, or a number of workers that is none.
    """
    if workers is not None and workers < 1:
        raise WlmError(f"workers: expected at least 1, got {workers}")
    if cluster is not None:
        if device not in ("cpu", "cuda"):
            raise WlmError(f"device '{device}': expected cpu or cuda, whichever the machines of a cluster have")
        return [device]
    checked = interop.check_device(device)
    if device == "cpu":
        return ["cpu"] * (workers or max(1, min(cores() // CPU_LANES, samples // _WORTHWHILE)))
    gpus = interop.available_devices()[1:] if device == "cuda" else [checked]
    return [gpus[i % len(gpus)] for i in range(workers or 1)]


def _workers(
    shared: tuple[Any, ...], track: bool, devices: list[str], workers: int | None, cluster: str | None, batches: int
) -> Workers:
    """What fits the batches, see `compress`."""
    if cluster is not None:
        share = {"CPU": float(CPU_LANES)} if devices[0] == "cpu" else {"GPU": 1.0}
        return Actors(Fitter, (*shared, devices[0], track), workers, batches, cluster, share)
    if len(devices) == 1:
        return Here(Fitter(*shared, devices[0], track))
    return Processes(Fitter, [(*shared, device, track) for device in devices])


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
    **overrides: Any,
) -> Checkpoint:
    """Opens the checkpoint of a fit: the file `OUTPUT.partial`, which names everything that the fit depends on.

    Args:
        output: The file that the fit is for.
        lightmaps, profile, tiles, seed, overrides: As for `compress`.
        device: Only its kind matters: a fit may go on on another GPU.
        resume: Whether to go on from the file, if there is one. Otherwise it is ignored, and replaced at the first
            save.
        every: Seconds between two saves of a running fit; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged, or of another fit; the line names what differs.
    """
    profile = Profile.load(profile).override(overrides)
    if profile.frames == "auto" and missing_encoder(0):
        profile = profile.override({"frames": "never"})
    fit = {
        "input": lightmaps.source,
        # Not in the input's hash, and yet the time axis wraps by it.
        "period": lightmaps.period,
        "profile": profile.model_dump(mode="json"),
        "tiles": None if tiles is None else sorted(int(tile) for tile in tiles),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(output, "lightmap", fit, lightmaps.source, resume=resume, every=every)


def dynamic_targets(lightmaps: LightmapSet, profile: Profile) -> Targets | None:
    """What the dynamic tiles of a set are fitted to, for peers of the trainer; None where there are none."""
    fit = _Fit(lightmaps, profile)
    rows = np.flatnonzero(fit.kinds == TileKind.DYNAMIC)
    return fit.piece(rows).targets() if len(rows) else None


class _Fit:
    """The tiles of a set, and the model that a fit fills with them.

    Tiles are cut out of the set as they are needed, some at a time: all of a large set don't fit in memory.

    Attributes:
        profile: The settings.
        index: int [N], numbers of the tiles in their grid, rising.
        kinds: int [N], `TileKind` of each.
        model: Complete but for the maps and networks of the batches that have not been stored.
    """

    def __init__(
        self,
        lightmaps: LightmapSet,
        profile: Profile,
        tiles: Sequence[int] | None = None,
        progress: OnProgress | None = None,
        survey: Survey | None = None,
    ) -> None:
        # What is stored as frames is told by the sizes that the profile has, so that two states stay frames.
        named, profile = profile, profile.for_times(len(lightmaps.times))
        self.profile, self._lightmaps = profile, lightmaps
        grid = TileGrid.of(*lightmaps.mask.shape)
        self._survey = survey
        if survey is None:
            survey = Survey(lightmaps, profile, tiles, progress)
        else:
            survey.check(lightmaps, profile)
        self.index, facts = survey.index, survey.facts
        self.kinds = np.array([tile.kind for tile in facts])
        framed = choose_frames(self.kinds, self.index, lightmaps.mask, len(lightmaps.times), named)
        warnings = ()
        if profile.frames == "auto" and framed.any() and (warning := missing_encoder(int(framed.sum()))):
            warnings, framed[:] = (f"{lightmaps.name}: {warning}",), False
        self.kinds[framed] = TileKind.VIDEO if profile.frames == "video" else TileKind.FRAMES
        kind = np.zeros(grid.count, np.uint8)
        kind[self.index] = self.kinds
        table = part_table(profile, kind, len(lightmaps.times))
        self.model = LightmapModel(
            name=lightmaps.name,
            width=grid.width,
            height=grid.height,
            times=lightmaps.times,
            period=lightmaps.period,
            source=lightmaps.source,
            profile=profile,
            mask=lightmaps.mask,
            kind=kind,
            constant=_constants(facts, len(lightmaps.times)),
            warnings=warnings,
            **{
                # Those of any size are known when they are made.
                name: np.zeros([size or 0 for size in part.shape], part.dtype)
                for name, part in table.items()
                if name != "constant"
            },
        )
        self._mapped = np.flatnonzero(np.isin(self.kinds, (TileKind.STATIC, TileKind.DYNAMIC)))
        for name, kind in (("scale", TileKind.DYNAMIC), ("scale_static", TileKind.STATIC)):
            stored = [facts[row].scale for row in np.flatnonzero(self.kinds == kind)]
            if stored:
                getattr(self.model, name)[:] = stored
        for i, row in enumerate(self._mapped):
            self.model.peak[i], self.model.affine[i] = facts[row].peak, facts[row].affine
        self._scale = self.model.scales

    def store_frames(self, progress: OnProgress | None) -> None:
        """Encodes the tiles that are stored as frames, and puts them into the model."""
        rows = np.flatnonzero(self.kinds == TileKind.FRAMES)
        meter = Meter(progress, "frames", len(rows))
        for i, row in enumerate(rows):
            number = int(self.index[row])
            tile, needed = split(self._lightmaps, self.profile.gamma, [number]), needed_blocks(self.model.mask, number)
            parts = encode_frames(tile.colour[0], tile.mask[0], needed, self.profile.frames_loss)
            self.model.frames[i], self.model.ranges[i] = parts
            if meter.due(i + 1):
                meter.report(i + 1)

    def store_video(self, progress: OnProgress | None) -> None:
        """Encodes the tiles that are stored as video, or as levels instead, and puts them into the model."""
        model, profile = self.model, self.profile
        settings = profile.gamma, profile.video_quality, profile.video_speed
        numbers = np.flatnonzero(model.kind == TileKind.VIDEO)
        streams, ranges, levels = [], np.empty(model.video_ranges.shape, np.float16), {}
        meter = Meter(progress, "video", len(numbers))
        done = 0
        for page in pages(model.kind, model.tile_columns, len(model.times)):
            tiles = split(self._lightmaps, profile.gamma, page.numbers)
            encoded = encode_page(page, tiles.colour, tiles.mask, *settings)
            levels |= {int(page.numbers[place]): own for place, own in encoded.levels.items()}
            if len(encoded.video):
                streams.append(encoded.stream)
                ranges[np.searchsorted(numbers, page.numbers[encoded.video])] = encoded.ranges
            done += len(page.numbers)
            if meter.due(done):
                meter.report(done)
        model.kind[list(levels)] = TileKind.LEVELS
        model.video, model.video_sizes = join_streams(streams)
        model.video_ranges = ranges[model.kind[numbers] == TileKind.VIDEO]
        if levels:
            model.levels, model.level_sizes = join_streams([levels[number][0] for number in sorted(levels)])
            model.level_ranges = np.stack([levels[number][1] for number in sorted(levels)])

    def batches(self, most: int | None = None) -> list[Batch]:
        """Batches of `BATCH_TEXELS`, of so many tiles at most and at least one; dynamic tiles first."""
        size = max(1, BATCH_TEXELS // (len(self.model.times) * TILE * TILE))
        size = size if most is None else min(size, most)
        result = []
        for kind in (TileKind.DYNAMIC, TileKind.STATIC):
            rows = np.flatnonzero(self.kinds == kind)
            for first in range(0, len(rows), size):
                result.append(Batch(len(result), kind, rows[first : first + size], first))
        return result

    def piece(self, rows: np.ndarray) -> Piece:
        """Some tiles as they are sent to a worker."""
        # Where other fits follow, and memory for all tiles is needed anyway.
        kept = self._survey if len(rows) == len(self._mapped) else None
        # With other frames other tiles have maps.
        if kept is not None and kept.piece is not None and np.array_equal(kept.piece.tiles.index, self.index[rows]):
            return kept.piece
        slots = np.searchsorted(self._mapped, rows)
        piece = Piece(
            cut(self._lightmaps, self.index[rows]),
            self._scale[slots],
            self.model.affine[slots].astype(np.float32),
            self.profile.gamma,
            self.profile.metric_weight,
            self.profile.peak,
        )
        if kept is not None:
            kept.piece = replace(piece, keep=True)
            return kept.piece
        return piece

    def table(self, batch: Batch) -> dict[str, Part]:
        """The parts of a batch that is finished, as the trainer gives them."""
        kind = np.full(len(batch.rows), batch.kind, np.uint8)
        table = part_table(self.profile, kind, len(self.model.times))
        if batch.kind == TileKind.STATIC:
            return {"net": table["net_static"], "uv": table["uv"]}
        return {name: table[name] for name in ("net", "uv", "uvt", "ut", "vt")}

    def store(self, batch: Batch, parts: dict[str, np.ndarray]) -> None:
        """Puts the maps and networks of a batch into the model."""
        dynamic = batch.kind == TileKind.DYNAMIC
        maps = ("uv", "uvt", "ut", "vt") if dynamic else ("uv",)
        for i, row in enumerate(batch.rows):
            used = valid_texels(self.model.mask, int(self.index[row]))
            reads = Reads.of(used, self.profile, self.model.axis) if dynamic else None
            cleared = clear_unread({name: parts[name][i] for name in maps}, used, reads)
            self.model.uv[np.searchsorted(self._mapped, row)] = cleared.pop("uv")
            for name, values in cleared.items():
                getattr(self.model, name)[batch.first + i] = values
        nets = self.model.net if dynamic else self.model.net_static
        nets[batch.first : batch.first + len(batch.rows)] = parts["net"]


def _constants(facts: Sequence[Facts], times: int) -> np.ndarray:
    """Radiance of the constant tiles, [N_c, T, 3]: half floats, or float32 where one would be over 1% off."""
    values = np.array([tile.constant for tile in facts if tile.kind == TileKind.CONSTANT]).reshape(-1, times, 3)
    half = values.astype(np.float16)
    return half if (np.abs(half - values) <= _CONSTANT_ERROR * values).all() else values.astype(np.float32)
