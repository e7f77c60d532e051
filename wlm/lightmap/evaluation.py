"""Scores a compressed lightmap set against its input: by the paper's protocol (neural-dynamic-gi, section 10.2), and by
the light that a renderer would show (`wlm.lightmap.view_scores`).

Errors of light are relative to the range of values of each tile at each time. Errors of directions, ratios and masks
are relative to the fixed range of their layer, [0, 1] or [-1, 1]. FLIP and views are only computed for light.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wlm import interop, system
from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet, SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.group_scores import SumScore, score_sums
from wlm.lightmap.held_out import HeldOut, score_held_out, stored_part
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.sheet import Sheet, first_light
from wlm.lightmap.tiles import TILE, TileKind
from wlm.lightmap.view_scores import VIEWS, ShownScore, Tally, views_of
from wlm.metrics import BRIGHTER, METRICS, FrameMetrics, LostLight, Summary, evaluate_frame, summarise
from wlm.system import Meter, OnProgress
from wlm.workers import each

SCORES = (*METRICS, "seen")
"""Scores that `evaluate` can compute: the metrics of the paper's protocol, and those of `wlm.lightmap.view_scores`."""

MEANS = ("psnr", "ssim", "flip", "seen", "ring", "between", "border", "flicker")
"""Scores of a sheet that `Report` has as means over the sheets."""

_LOST = "texel", "their tile"
_THREADS = {"cpu": 16, "cuda": 2}
_FEW_TEXELS = 16  # of the 16,384 texels of a tile
_TILES_AT_ONCE = 16  # 3 MiB of decoded light in each thread, which stay in its cache


@dataclass(frozen=True)
class SheetReport(ShownScore, Summary):
    """Error and size of one sheet (up to three channels of a layer). Scores that were not computed are NaN.

    The scores of `wlm.metrics.Summary`, over tiles and times, and those of `ShownScore` and `ViewScore` are attributes
    too. PSNR is in dB, 120 for an exact tile; SSIM is in [-1, 1] and FLIP in [0, 1].

    Attributes:
        memory_bpp: Bits per texel and time in the memory of a GPU, see `SheetModel.memory_bytes`.
        tiles: Number of tiles that are not empty.
        not_scored: Number of pairs that are not scored, by reason: `empty` (no valid texel), `not_held` (valid texels,
            but not in the file), `few_texels`, `zero_range` (see `wlm.metrics`).
        kinds: Number of tiles of each kind: `empty`, `constant`, `dynamic`, `frames`.
        warnings: Lines about tiles that were not scored, and about lost light of few very bright texels.
        held_out: Scores at the times of the input that the model does not store; None if it stores all.
    """

    memory_bpp: float
    tiles: int
    not_scored: dict[str, int]
    kinds: dict[str, int]
    warnings: list[str]
    held_out: HeldOut | None


@dataclass(frozen=True)
class Report(system.Report):
    """Error and size of a compressed set.

    Attributes:
        psnr, ssim, flip, seen, ring, between, border, flicker: Means of the scores of the sheets, weighted by their
            numbers of channels; see `SheetReport` and `ShownScore`. NaN if no sheet has the score.
        bytes: Size of the file on disk.
        bpp: Bits in the file per texel and time, all layers together.
        memory_bpp: Bits in the memory of a GPU per texel and time, all layers together.
        times: float64 [T], the stored times of the first sheet of light.
        device: Device on which the model was decoded.
        seconds: Wall-clock time to decode and score everything; scoring takes most of it.
        profile: Name of the settings.
        sheets: The report of each sheet, so also of each light group.
        sums: Scores of the sums of light groups, see `wlm.lightmap.group_scores.score_sums`; empty without groups.
        warnings: Warnings of all sheets, and one if the file was made from another input.
    """

    psnr: float
    ssim: float
    flip: float
    seen: float
    ring: float
    between: float
    border: float
    flicker: float
    bytes: int
    bpp: float
    memory_bpp: float
    times: np.ndarray
    device: str
    seconds: float
    profile: str
    sheets: dict[Sheet, SheetReport]
    sums: list[SumScore]
    warnings: list[str]

    @property
    def light(self) -> SheetReport:
        """The report of the first sheet of radiance, or of the first sheet if no sheet is radiance."""
        return self.sheets[first_light(self.sheets)]

    def to_json(self) -> dict[str, Any]:
        """Returns the report as JSON values; `sheets` is a list."""
        sheets = [vars(sheet) | report.to_json() for sheet, report in self.sheets.items()]
        return system.plain(vars(self) | {"sheets": sheets})


def evaluate(
    model: LightmapModel,
    lightmaps: LightmapSet,
    *,
    device: str = "cpu",
    metrics: Sequence[str] = SCORES,
    views: int = VIEWS,
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
    all_lights: LightmapSet | None = None,
) -> Report:
    """Decodes every stored time, and times between them, from the stored bytes and compares them with the input.

    Only tiles that the model holds are scored; if it was made from a selection of tiles, all other tiles are masked
    out.

    Args:
        model: The model.
        lightmaps: The input. Another set with the same sheets, sizes and times is scored too, with a warning. Times
            that the model does not store, as after a fit of `LightmapSet.without`, are scored as
            `SheetReport.held_out`.
        device: Device that decodes: "cpu", "cuda" or "cuda:N".
        metrics: Any of "psnr", "ssim", "flip", and "seen" for `ShownScore` and views; FLIP takes most of the time.
        views: Number of rendered views of the set's mesh, scored with "seen"; 0: none. A set without a mesh has none.
        progress: Called about twice a second.
        file_bytes: Size of the model's file; None: the size that the model would have as a file.
        all_lights: A bake of all lights together, at any times, to compare the sum of the light groups with.

    Returns:
        The report.

    Raises:
        WlmError: The set and the model differ in sheets or size, the set lacks a time of the model, no tile of the
            model has a valid texel, there is no such device, a metric is unknown, the number of views is negative, or
            `all_lights` has other sheets.
    """
    start = time.perf_counter()
    for sheet in lightmaps.sheets.keys() ^ model.sheets.keys():
        owner = lightmaps.name if sheet in lightmaps.sheets else f"the file {model.name}"
        raise WlmError(
            f"{lightmaps.name}: expected the same sheets as in the file {model.name}; only {owner} has {sheet.label}"
        )
    whole, lightmaps = lightmaps, stored_part(model, lightmaps)
    reports, warnings = {}, []
    if lightmaps.source != model.source:
        warnings.append(
            f"{lightmaps.name}: not the input of the file: its source is {model.source}, this is {lightmaps.source}"
        )
    meter, done = Meter(progress, "score", sum(len(own.times) for own in model.sheets.values())), 0
    for sheet, own in model.sheets.items():
        chosen = [metric for metric in metrics if not (sheet.linear and metric == "flip")]
        count = 0 if sheet.linear or "seen" not in metrics else views
        report = _score(own, lightmaps.sheets[sheet], device, chosen, count, meter, done)
        done += len(own.times)
        plain = [metric for metric in chosen if metric != "seen"]
        held_out = score_held_out(own, lightmaps.sheets[sheet], whole.sheets[sheet], device, plain)
        reports[sheet] = replace(report, max_abs_error=report.max_abs_error * sheet.span, held_out=held_out)
        warnings += report.warnings
    file_bytes = model.file_bytes() if file_bytes is None else file_bytes
    # Texels of one sheet of each atlas: layers share an area.
    areas = {sheet.atlas: _area(own, lightmaps.sheets[sheet].mask) for sheet, own in reversed(model.sheets.items())}
    texels = sum(areas.values()) * len(model.times)
    weights = [len(sheet.channels) for sheet in reports]
    return Report(
        **{name: _mean([getattr(report, name) for report in reports.values()], weights) for name in MEANS},
        bytes=file_bytes,
        bpp=8 * file_bytes / texels,
        memory_bpp=8 * model.memory_bytes / texels,
        times=model.light.times,
        device=device,
        seconds=time.perf_counter() - start,
        profile=model.profile.name,
        sheets=reports,
        sums=score_sums(model, lightmaps, all_lights, device, [each for each in metrics if each in ("psnr", "ssim")]),
        warnings=list(dict.fromkeys(warnings)),
    )


def _score(
    model: SheetModel,
    lightmaps: SheetFrames,
    device: str,
    metrics: Sequence[str],
    views: int,
    meter: Meter,
    before: int,
) -> SheetReport:
    """Scores a sheet; `before` is the number of lightmaps already scored, for the progress."""
    mask, decoder, peak = scored_mask(model, lightmaps), SheetDecoder(model, device), model.profile.peak
    plain = [metric for metric in metrics if metric != "seen"]
    drawn, warnings = views_of(lightmaps, views, device=device)
    tally = Tally(lightmaps, mask, decoder.frame, drawn, model.name, peak)
    frames, lost = [], LostLight()
    for i, stamp in enumerate(model.times):
        name, decoded = f"{model.name} at {stamp:g}", decoder.frame(stamp)
        inside = mask & lightmaps.valid(i)
        frames.append(evaluate_frame(lightmaps.frames[i], decoded, inside, TILE, plain, name=name, peak=peak))
        if "seen" in metrics:
            tally.add(i, decoded, frames[i])
        for tile, window in _windows(model) if peak is None else ():
            valid = inside[window]
            lost.add(lightmaps.frames[i][window][valid], decoded[window][valid], _place(tile, stamp))
        if meter.due(done := before + i + 1):
            meter.report(done)
    report = _sheet_report(model, lightmaps, frames, tally.score())
    return replace(report, warnings=report.warnings + warnings + lost.warnings(model.name, *_LOST))


def _mean(values: Sequence[float], weights: Sequence[int]) -> float:
    counted = np.array([(v, w) for v, w in zip(values, weights, strict=True) if not np.isnan(v)]).reshape(-1, 2)
    return float(np.average(*counted.T[:1], weights=counted[:, 1])) if len(counted) else float("nan")


def psnr_of(model: SheetModel, lightmaps: SheetFrames, number: int, decoded: np.ndarray) -> float:
    """Returns the mean PSNR in dB over the tiles of a decoded map [H, W, 3], compared with input lightmap `number`."""
    mask, name = lightmaps.mask & model.stored_texels, f"{model.name} at {lightmaps.times[number]:g}"
    options = {"name": name, "peak": model.profile.peak}
    return float(summarise([evaluate_frame(lightmaps.frames[number], decoded, mask, TILE, ("psnr",), **options)]).psnr)


def lost_light(model: LightmapModel, lightmaps: LightmapSet, device: str = "cpu") -> list[str]:
    """Returns warnings about light that a fit lost though its PSNR is high, one line for each kind of loss and sheet.

    Only tiles are decoded in which few texels are the brightest (fireflies), or the brightest are over ten times as
    bright as the others; in all other tiles such a loss shows in the PSNR, which is then below 30 dB. `evaluate` checks
    all tiles.
    """
    lit = [sheet for sheet, own in model.sheets.items() if not sheet.linear and own.kind.any()]
    return [line for sheet in lit for line in _lost_light(model.sheets[sheet], lightmaps.sheets[sheet], device)]


def _lost_light(model: SheetModel, lightmaps: SheetFrames, device: str) -> list[str]:
    mask, lost, decoder = scored_mask(model, lightmaps), LostLight(), SheetDecoder(model, device)

    def look(i: int) -> LostLight:
        own, frame, inside, stamp = LostLight(), lightmaps.frames[i], mask & lightmaps.valid(i), model.times[i]
        doubtful = [at for at in _windows(model) if _may_hide_loss(frame[at[1]], inside[at[1]])]
        for start in range(0, len(doubtful), _TILES_AT_ONCE):
            some = doubtful[start : start + _TILES_AT_ONCE]
            decoded = decoder.tiles([tile for tile, _ in some], stamp)
            reference, valid = np.zeros_like(decoded), np.zeros(decoded.shape[:3], bool)
            for k, (_, window) in enumerate(some):
                height, width = inside[window].shape
                reference[k, :height, :width], valid[k, :height, :width] = frame[window], inside[window]
            flat = [(light * valid[..., None]).reshape(len(some), -1, 3) for light in (reference, decoded)]
            # Many groups at once: single ones take longer, and threads would wait for Python's lock.
            for k in np.flatnonzero(LostLight.groups_to_add(*flat)):
                texels = np.flatnonzero(valid[k])
                own.add(*(light[k].take(texels, 0) for light in flat), _place(some[k][0], stamp))
        return own

    # Loads the kernel of each kind of tile: threads must not do it at once.
    decoder.tiles(np.unique(model.kind, return_index=True)[1], model.times[0])
    with interop.one_thread():
        # Beside a GPU, which decodes, short calls of torch remain, and more threads wait for Python's lock.
        for own in each(look, range(len(model.times)), _THREADS["cpu" if device == "cpu" else "cuda"]):
            lost.merge(own)
    return lost.warnings(model.name, *_LOST)


def _may_hide_loss(colour: np.ndarray, valid: np.ndarray) -> bool:
    """Returns whether PSNR may hide lost light in a tile, float32 [h, w, 3], among its valid texels, bool [h, w]."""
    light = np.maximum(np.maximum(colour[..., 0], colour[..., 1]), colour[..., 2])[valid]
    if not len(light) or not (largest := light.max()) > 0:
        return False
    few = np.count_nonzero(2.0 * light >= largest) <= _FEW_TEXELS < len(light)
    # A sixteenth of the texels is enough for a median that decides what is decoded.
    return few or largest > BRIGHTER * np.median(light[::16])


def _windows(model: SheetModel) -> Iterator[tuple[int, tuple[slice, slice]]]:
    for tile in np.flatnonzero(model.kind).tolist():
        yield tile, model.grid.window(tile)


def _place(tile: int, stamp: float) -> str:
    return f"tile {tile} at {stamp:g}"


def bits_per_texel(model: SheetModel, mask: np.ndarray, size: int) -> float:
    """Converts a size in bytes to bits per texel and time; `mask`, bool [H, W], has the valid texels of the input.

    The area is the whole map with the gaps between charts, since the file replaces textures of that size. If the model
    lacks some of the tiles that have valid texels, the area is the part of the map that its tiles cover.
    """
    return size * 8 / (_area(model, mask) * len(model.times))


def _area(model: SheetModel, mask: np.ndarray) -> int:
    stored = model.stored_texels
    area = mask.size if not (mask & ~stored).any() else int(stored.sum())
    if area == 0:
        raise WlmError(f"{model.name}: expected a file with tiles, found only empty tiles")
    return area


def count_kinds(model: SheetModel) -> dict[str, int]:
    """Returns the number of tiles by the kind's lower-case name; tiles that were not compressed are "empty"."""
    return {kind.name.lower(): int((model.kind == kind).sum()) for kind in TileKind}


def scored_mask(model: SheetModel, lightmaps: SheetFrames) -> np.ndarray:
    """Checks that a sheet fits a model; returns which texels are scored, bool [H, W]: valid ones in stored tiles."""
    height, width = lightmaps.mask.shape
    if (height, width) != (model.height, model.width):
        raise WlmError(
            f"{lightmaps.name}: has {width}x{height} texels, but the file {model.name} has {model.width}x{model.height}"
        )
    mask = lightmaps.mask & model.stored_texels
    if not mask.any():
        raise WlmError(f"{lightmaps.name}: no tile of the file {model.name} has a valid texel")
    return mask


def _sheet_report(
    model: SheetModel, lightmaps: SheetFrames, frames: Sequence[FrameMetrics], shown: ShownScore
) -> SheetReport:
    summary, warnings = summarise(frames, model.times), []
    left_out = _left_out(model, lightmaps, summary)
    if left_out["not_held"]:
        missing = left_out["not_held"] // len(model.times)
        warnings.append(f"{model.name}: {missing} tiles with valid texels are not in the file, and not scored")
    return SheetReport(
        **vars(summary),
        **vars(shown),
        memory_bpp=bits_per_texel(model, lightmaps.mask, model.memory_bytes),
        tiles=int(np.count_nonzero(model.kind)),
        not_scored=left_out,
        kinds=count_kinds(model),
        warnings=warnings,
        held_out=None,
    )


def _left_out(model: SheetModel, lightmaps: SheetFrames, summary: Summary) -> dict[str, int]:
    valid, times = model.grid.tiles_with(lightmaps.mask).ravel(), len(model.times)
    empty = int((~valid).sum()) * times
    not_held = int((valid & (model.kind == TileKind.EMPTY)).sum()) * times
    return {
        "empty": empty,
        "not_held": not_held,
        "few_texels": summary.few_texels - empty - not_held,
        "zero_range": summary.zero_range,
    }
