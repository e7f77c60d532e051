"""Scoring a compressed lightmap set against its input: by the paper's protocol (neural-dynamic-gi, section 10.2), and
as it is seen (`wlm.lightmap.seen`)."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.lightmap.codec import encode
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.decode import Decoder
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.packing import STREAMS
from wlm.lightmap.seen import SeenScore, Tally
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.lightmap.views import VIEWS, views_of
from wlm.metrics import METRICS, FrameMetrics, LostLight, Summary, evaluate_frame, summarise
from wlm.metrics.contest import HOURS, ContestScore, block_scores, contest_points
from wlm.system import Meter, OnProgress

SCORES = (*METRICS, "seen")
"""What `evaluate` computes: the metrics of the paper's protocol, and the scores of `wlm.lightmap.seen`."""

_LOST = "texel", "their tile"
_FEW_TEXELS = 16  # of a tile's 16,384

# Stored times are float32 where that keeps them apart; see `wlm.lightmap.codec`.
_TIME_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Report(SeenScore):
    """Size and error of a compressed set. A mean over nothing, and a metric that was not computed, is NaN.

    The scores of `SeenScore` and `ViewScore` are attributes too.

    Attributes:
        psnr, ssim, flip: Means over every scored tile at every time; decibels (120 for an exact tile), in [-1, 1], in
            [0, 1].
        psnr_unlimited: The mean of PSNR without the tiles of `format_limited`.
        bpp: Bits per texel and time of the file, see `bits_per_texel`.
        bytes: Size of the file on disk.
        memory_bpp: Bits per texel and time in a GPU's memory, see `memory_bytes`.
        tiles, times: Tiles that the file holds, and times.
        device: Where it was decoded.
        seconds: Wall-clock time to decode and score all times; scoring takes most of it.
        psnr_by_tile, ssim_by_tile, flip_by_tile: float64 [rows, columns] of the grid, means over the times.
        psnr_by_time, ssim_by_time, flip_by_time: float64 [T], means over the tiles.
        time_values: float64 [T], the stored times.
        worst_psnr: Lowest PSNR of any tile at any time.
        worst_tile: Where that is: `time`, `tile` (its number), `row`, `column`; None without a score.
        max_abs_error: Largest absolute error of a valid texel, scored or not, in the input's units.
        max_abs_error_unscored: The same over what has no score.
        scored: Tiles times times that count in the means.
        not_scored: The rest, by reason: `empty` (no valid texel), `not_held` (valid texels, but not in the
            file), `few_texels`, `zero_range` (see `wlm.metrics`).
        no_ssim: Scored ones without an SSIM.
        format_limited: `time`, `tile` of the scored ones that span only a few steps of half float.
        parts: Bytes of the file by part, see `part_bytes`.
        profile: Name of the settings.
        kinds: Tiles of the grid by kind: `empty`, `constant`, `static`, `dynamic`, `frames`, `video`.
        warnings: Tiles that were not scored, another input than the file's, or light that was lost and that the means
            hide.
    """

    psnr: float
    ssim: float
    flip: float
    psnr_unlimited: float
    bpp: float
    bytes: int
    memory_bpp: float
    tiles: int
    times: int
    device: str
    seconds: float
    psnr_by_tile: np.ndarray
    ssim_by_tile: np.ndarray
    flip_by_tile: np.ndarray
    psnr_by_time: np.ndarray
    ssim_by_time: np.ndarray
    flip_by_time: np.ndarray
    time_values: np.ndarray
    worst_psnr: float
    worst_tile: dict[str, float | int] | None
    max_abs_error: float
    max_abs_error_unscored: float
    scored: int
    not_scored: dict[str, int]
    no_ssim: int
    format_limited: list[dict[str, float | int]]
    parts: dict[str, int]
    profile: str
    kinds: dict[str, int]
    warnings: list[str]


def evaluate(
    model: LightmapModel,
    lightmaps: LightmapSet,
    *,
    device: str = "cpu",
    metrics: Sequence[str] = SCORES,
    views: int = VIEWS,
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
) -> Report:
    """Decodes every stored time, and times between them, from the stored bytes and compares them with the input.

    Where the profile has a `peak`, errors are relative to that, and no light is looked for that was lost.

    Only what the model holds is scored: where it was made of some tiles, the texels of the others are masked out.

    Args:
        model: The model.
        lightmaps: The input. Another set of the same size and times is scored too, with a warning.
        device: Where it is decoded: "cpu", "cuda" or "cuda:N".
        metrics: Any of "psnr", "ssim", "flip" and "seen"; FLIP takes most of the time.
        views: Views of the set's mesh, of "seen"; 0 for none. Without a mesh there are none.
        progress: Called about twice a second.
        file_bytes: Size of the model's file; None: that of the file that it would be saved to.

    Returns:
        The report.

    Raises:
        WlmError: The set's size or times are not the model's, no tile of the model has a valid texel, the device
            isn't there, a metric is unknown, or the number of views is negative.
        ValueError: `file_bytes` is less than the model's parts take.
    """
    start = time.perf_counter()
    device = interop.check_device(device)
    mask = scored_mask(model, lightmaps)
    decoder = Decoder(model, device)
    meter = Meter(progress, "score", len(model.times))
    peak = model.profile.peak
    plain = [metric for metric in metrics if metric != "seen"]
    drawn, warnings = views_of(lightmaps, views if "seen" in metrics else 0, device=device)
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
        if meter.due(i + 1):
            meter.report(i + 1)
    file_bytes = model.file_bytes() if file_bytes is None else file_bytes
    seconds = time.perf_counter() - start
    report = _report(model, lightmaps, file_bytes, device, frames, tally.score(), seconds)
    return replace(report, warnings=report.warnings + warnings + lost.warnings(model.name, *_LOST))


def psnr_of(model: LightmapModel, lightmaps: LightmapSet, number: int, decoded: np.ndarray) -> float:
    """PSNR of one lightmap of a set, dB: `Report.psnr_by_time` of its hour, without the hours beside it.

    Args:
        model: The model.
        lightmaps: The input, of the model's size.
        number: Of the lightmap in the set.
        decoded: float32 [H, W, 3], what the model decodes to at its hour.

    Returns:
        The mean over the tiles; NaN where none has a score.
    """
    mask, name = lightmaps.mask & _held(model), f"{model.name} at {lightmaps.times[number]:g}"
    options = {"name": name, "peak": model.profile.peak}
    return float(summarise([evaluate_frame(lightmaps.frames[number], decoded, mask, TILE, ("psnr",), **options)]).psnr)


def contest_score(
    model: LightmapModel, lightmaps: LightmapSet, *, device: str = "cpu", progress: OnProgress | None = None
) -> ContestScore:
    """Scores a model as the contest of `wlm.metrics.contest` does.

    The clock runs while `Decoder.frame` makes a lightmap of float32 from the stored bytes, with the copy to the host,
    after a first decode that isn't timed. The ratio is that of the bytes in memory, since the contest allows no packed
    files, to `HOURS` lightmaps at most.

    Args:
        model: The model.
        lightmaps: The input.
        device: Where it is decoded.
        progress: Called about twice a second.

    Raises:
        WlmError: As `evaluate`.
    """
    device = interop.check_device(device)
    mask, decoder, times = scored_mask(model, lightmaps), Decoder(model, device), len(model.times)
    meter, seconds, psnrs, ssims = Meter(progress, "contest", times), 0.0, [], []
    decoder.frame(model.times[0])
    for i, stamp in enumerate(model.times):
        start = time.perf_counter()
        decoded = decoder.frame(stamp)
        seconds += time.perf_counter() - start
        blocks = block_scores(lightmaps.frames[i], decoded, mask & lightmaps.valid(i))
        psnrs += blocks[0]
        ssims += [value for value in blocks[1] if np.isfinite(value)]
        if meter.due(i + 1):
            meter.report(i + 1)
    bpp = bits_per_texel(model, lightmaps.mask, memory_bytes(model))
    ratio = bpp * times / (min(times, HOURS) * 3 * 32)
    means = (float(np.mean(values)) if values else float("nan") for values in (psnrs, ssims))
    return contest_points(ratio, *means, seconds, times, device)


def lost_light(model: LightmapModel, lightmaps: LightmapSet, device: str = "cpu") -> list[str]:
    """Looks for fireflies that a fit lost: tiles whose light is in few texels are decoded at their times alone.

    `evaluate` looks at all tiles. A light of more texels than these can't vanish unseen: PSNR would be below 30 dB.

    Args:
        model: The model.
        lightmaps: The input.
        device: Where it is decoded.

    Returns:
        Lines with the texels and the largest loss.

    Raises:
        WlmError: As `evaluate`.
    """
    mask, lost = scored_mask(model, lightmaps), LostLight()
    decoder = None
    for i, (frame, stamp) in enumerate(zip(lightmaps.frames, model.times, strict=True)):
        inside = mask & lightmaps.valid(i)
        for tile, window in _windows(model):
            valid, texels = inside[window], frame[window]
            light = texels.max(2, where=valid[..., None], initial=0.0)
            if not 0 < np.count_nonzero(2.0 * light >= light.max()) <= _FEW_TEXELS < np.count_nonzero(valid):
                continue
            decoder = decoder or Decoder(model, device)
            decoded = decoder.tile(tile, stamp)[: valid.shape[0], : valid.shape[1]]
            lost.add(texels[valid], decoded[valid], _place(tile, stamp))
    return lost.warnings(model.name, *_LOST)


def _windows(model: LightmapModel) -> Iterator[tuple[int, tuple[slice, slice]]]:
    """The tiles that a model holds, each with its place in the map."""
    grid = TileGrid.of(model.height, model.width)
    for tile in np.flatnonzero(model.kind != TileKind.EMPTY).tolist():
        y, x = grid.origin(tile)
        yield tile, (slice(y, min(y + TILE, grid.height)), slice(x, min(x + TILE, grid.width)))


def _place(tile: int, stamp: float) -> str:
    return f"tile {tile} at {stamp:g}"


def bits_per_texel(model: LightmapModel, mask: np.ndarray, file_bytes: int) -> float:
    """Bits per texel and time: `file_bytes * 8 / (area * times)`.

    The area is the whole map with the gaps between charts, as the file replaces textures of that size. Where the model
    holds only some of the tiles with a valid texel, it is the part of the map that these cover.

    Args:
        model: The model.
        mask: The input's, bool [H, W].
        file_bytes: Size of the model's file.

    Raises:
        WlmError: The model holds no tile.
    """
    held = _held(model)
    area = mask.size if not (mask & ~held).any() else int(held.sum())
    if area == 0:
        raise WlmError(f"{model.name}: the file holds no tile")
    return file_bytes * 8 / (area * len(model.times))


def memory_bytes(model: LightmapModel) -> int:
    """Bytes of a model's maps, networks and scales as a GPU holds them.

    Blocks are as they are, networks in half floats, video and levels are unpacked.
    """
    streams = "video", "video_sizes", "levels", "level_sizes"
    held = [value for name, value in model.parts.items() if name not in streams]
    if len(model.unpacked):
        held.append(model.words)
    return sum(value.nbytes for value in held)


def count_kinds(model: LightmapModel) -> dict[str, int]:
    """Number of tiles of the grid by kind, in small letters; "empty" are those that weren't compressed as well."""
    return {kind.name.lower(): int((model.kind == kind).sum()) for kind in TileKind}


def part_bytes(model: LightmapModel, file_bytes: int) -> dict[str, int]:
    """Bytes of a model's file by part, the largest first; `header` is the rest: the header and the sizes of streams.

    What is packed by tile is told by stream, see `wlm.lightmap.packing`.

    Raises:
        ValueError: `file_bytes` is less than the parts take.
    """
    stored, unnamed = encode(model)[1], ("streams", "stream_sizes", "frame_sizes", "video_sizes", "level_sizes")
    parts = {name: value.nbytes for name, value in stored.items() if name not in unnamed}
    if "stream_sizes" in stored:
        parts |= zip(STREAMS, stored["stream_sizes"].sum(0, dtype=int).tolist(), strict=True)
    parts["header"] = file_bytes - sum(parts.values())
    if parts["header"] < 0:
        raise ValueError(f"file_bytes: expected at least {file_bytes - parts['header']}, got {file_bytes}")
    return dict(sorted(((k, v) for k, v in parts.items() if v), key=lambda part: -part[1]))


def _held(model: LightmapModel) -> np.ndarray:
    """bool [H, W]: texels of the tiles that the model holds."""
    grid = TileGrid.of(model.height, model.width)
    tiles = (model.kind != TileKind.EMPTY).reshape(grid.rows, grid.cols)
    return tiles.repeat(TILE, axis=0).repeat(TILE, axis=1)[: grid.height, : grid.width]


def scored_mask(model: LightmapModel, lightmaps: LightmapSet) -> np.ndarray:
    """Checks that a set fits a model.

    Returns:
        bool [H, W], the valid texels that the model holds: those that are scored.

    Raises:
        WlmError: As `evaluate`.
    """
    count, height, width = lightmaps.frames.shape[:3]
    if (height, width) != (model.height, model.width):
        raise WlmError(
            f"{lightmaps.name}: is {width}x{height}, but the file {model.name} holds {model.width}x{model.height}"
        )
    if count != len(model.times):
        raise WlmError(f"{lightmaps.name}: has {count} times, but the file {model.name} holds {len(model.times)}")
    close = np.isclose(lightmaps.times, model.times, rtol=_TIME_TOLERANCE, atol=_TIME_TOLERANCE)
    if not close.all():
        i = int(np.argmin(close))
        raise WlmError(
            f"{lightmaps.name}: time {i} is {lightmaps.times[i]:g}, but in the file {model.name} it is "
            f"{model.times[i]:g}"
        )
    mask = lightmaps.mask & _held(model)
    if not mask.any():
        raise WlmError(f"{lightmaps.name}: no tile of the file {model.name} has a valid texel")
    return mask


def _report(
    model: LightmapModel,
    lightmaps: LightmapSet,
    file_bytes: int,
    device: str,
    frames: Sequence[FrameMetrics],
    seen: SeenScore,
    seconds: float,
) -> Report:
    summary = summarise(frames)
    columns = model.tile_columns
    warnings = []
    if lightmaps.source != model.source:
        warnings.append(
            f"{lightmaps.name}: not what the file was made from: its source is {model.source}, "
            f"this is {lightmaps.source}"
        )
    left_out = _left_out(model, lightmaps, summary)
    if left_out["not_held"]:
        missing = left_out["not_held"] // len(model.times)
        warnings.append(f"{model.name}: {missing} tiles with valid texels are not in the file, and not scored")

    def place(where: tuple[int, int, int]) -> dict[str, float | int]:
        i, row, column = where
        return {"time": float(model.times[i]), "tile": row * columns + column, "row": row, "column": column}

    scores = (f"{name}{suffix}" for name in METRICS for suffix in ("", "_by_tile", "_by_time"))
    return Report(
        **{name: getattr(summary, name) for name in scores},
        **vars(seen),
        psnr_unlimited=summary.psnr_unlimited,
        bpp=bits_per_texel(model, lightmaps.mask, file_bytes),
        bytes=file_bytes,
        memory_bpp=bits_per_texel(model, lightmaps.mask, memory_bytes(model)),
        tiles=int((model.kind != TileKind.EMPTY).sum()),
        times=len(model.times),
        device=device,
        seconds=seconds,
        time_values=model.times,
        worst_psnr=summary.worst_psnr,
        worst_tile=None if summary.worst_tile is None else place(summary.worst_tile),
        max_abs_error=summary.max_abs_error,
        max_abs_error_unscored=summary.max_abs_error_unscored,
        scored=summary.scored,
        not_scored=left_out,
        no_ssim=summary.no_ssim,
        format_limited=[place(where) for where in summary.format_limited],
        parts=part_bytes(model, file_bytes),
        profile=model.profile.name,
        kinds=count_kinds(model),
        warnings=warnings,
    )


def _left_out(model: LightmapModel, lightmaps: LightmapSet, summary: Summary) -> dict[str, int]:
    """Counts tiles times times without a score by reason; the metrics count a tile masked out as of few texels."""
    grid = TileGrid.of(model.height, model.width)
    valid = np.zeros((grid.rows * TILE, grid.cols * TILE), bool)
    valid[: grid.height, : grid.width] = lightmaps.mask
    valid = valid.reshape(grid.rows, TILE, grid.cols, TILE).any(axis=(1, 3)).ravel()
    times = len(model.times)
    empty = int((~valid).sum()) * times
    not_held = int((valid & (model.kind == TileKind.EMPTY)).sum()) * times
    return {
        "empty": empty,
        "not_held": not_held,
        "few_texels": summary.few_texels - empty - not_held,
        "zero_range": summary.zero_range,
    }
