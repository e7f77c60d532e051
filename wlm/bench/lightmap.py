"""The lightmap system against itself and against block codecs: size, speed and error in one run.

Four kinds of rows:

- method "ours", a profile each: the file, the fit, the errors of the float decode against the input, and the decode
  time of the whole map to 8 bits on the fast path.
- methods "exact" (a texel a thread) and "strip" (the fast path), a GELU each, of profile M: the 8-bit output against
  the input, and its largest error against the float64 path. Half a level of 8 bits, 0.00196, is the rounding itself.
- the block codecs of ``wlm.baselines``, on the same lightmaps.
- method "fit", a profile each: the speed of the fit alone; and the same fit in plain torch, all of it on CUDA in a
  full run, else a few steps.

A decode on CUDA is timed as the replay of a graph, so that gaps between launches do not count; block codecs decode on
the CPU alone, and in a texture unit on a GPU, so that they have a decode time on the CPU alone.
"""

import os
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import wlm
from wlm import interop
from wlm.baselines import BASELINES
from wlm.baselines.lightmap_torch import PlainFit
from wlm.bench.runner import Row, run_peers
from wlm.errors import WlmError
from wlm.lightmap.data import LightmapSet, load
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import bits_per_texel
from wlm.lightmap.exact import bound64, colour_tile64, decode_tile64
from wlm.lightmap.fit import compress, dynamic_targets
from wlm.lightmap.model import TILE, LightmapModel, Profile, TimeAxis, encode_time
from wlm.lightmap.runtime import ExactDecoder, StripDecoder
from wlm.lightmap.tiles import TileGrid, TileKind, assemble
from wlm.metrics import METRICS, Summary, evaluate_frame, summarise

__all__ = ["PROFILES", "QUICK_PROFILES", "run", "run_rows"]

PROFILES = ("L", "M", "H", "M64", "M-paper")
"""Profiles of a full run: the paper's table 3, and M as the paper fits it."""

QUICK_PROFILES = ("L", "M", "M-paper")
"""Profiles of a quick run."""

# A quick fit is worth this many steps of one tile, however many tiles there are: under a minute on two CPU cores.
_QUICK_TILE_STEPS = 8_000
_QUICK_SAMPLES = 2048
_QUICK_HOURS = (9.0, 12.0, 21.0)  # morning, noon and lamps
_FULL_TILES = 64  # of 1024 x 1024
_PLAIN_STEPS = 10  # of the fit in plain torch, where it isn't run to its end
_ERROR_TIMES = 3  # the float64 path takes 30 ms a tile and time

# GELU by its gate, which is shorter to read in a plot.
_GELUS = {"exact": "erf", "tanh": "tanh", "fast": "fast tanh"}

# Method and option of each codec.
_CODECS = {
    "bc6h": ("BC6H", ""),
    "bc7": ("BC7", ""),
    "astc12": ("ASTC", "12x12"),
    "astc10": ("ASTC", "10x10"),
    "8bit": ("8 bits", ""),
}

Report = Callable[[str], None]


def run(
    *,
    quick: bool,
    device: str,
    set_path: str | os.PathLike[str] | None = None,
    progress: Report | None = None,
) -> list[Row]:
    """Measures the lightmap system on one set.

    Args:
        quick: Three profiles with short fits, scored at three times (9, 12 and 21 h if the set has them): four
            minutes on two CPU cores for 16 tiles. Its errors are those of unfinished fits.
        device: "cpu" or "cuda:0", for fits and decodes.
        set_path: A set as ``wlm.lightmap.load`` reads it; None: the checkout's ``demos/data/city``, two
            tiles of the city.
        progress: Called with a line before each part of the work.

    Returns:
        The rows, in the order of the module's list.

    Raises:
        WlmError: The set or the device isn't there, or a fit diverged.
    """
    if set_path is None:
        set_path = Path(wlm.__file__).resolve().parents[1] / "demos" / "data" / "city"
        if not set_path.is_dir():
            raise WlmError("bench lightmap: the demo's set comes with a checkout alone; expected --set PATH")
    lightmaps = load(set_path)
    profiles = [Profile.load(name) for name in (QUICK_PROFILES if quick else PROFILES)]
    chosen = np.arange(len(lightmaps.times))
    if quick:
        tiles = TileGrid.of(*lightmaps.mask.shape).count
        steps = max(200, _QUICK_TILE_STEPS // tiles)
        profiles = [
            profile.model_copy(update={"steps": min(steps, profile.steps), "samples": _QUICK_SAMPLES})
            for profile in profiles
        ]
        chosen = _quick_times(lightmaps.times)
    return run_rows(lightmaps, profiles, device=device, chosen=chosen, progress=progress)


def run_rows(
    lightmaps: LightmapSet,
    profiles: Sequence[Profile],
    *,
    device: str,
    chosen: Sequence[int] | np.ndarray,
    repeats: int | None = None,
    progress: Report | None = None,
) -> list[Row]:
    """Measures given profiles on a given set.

    Args:
        lightmaps: The set.
        profiles: At least one. The rows of decode options are of the one named "M", else of the first.
        device: "cpu" or "cuda:0".
        chosen: Places of the times that are scored, int [K].
        repeats: Samples of each decode time; None: 30 on CUDA, 5 on the CPU, where a sample is a whole map.
        progress: As for ``run``.

    Returns:
        The rows.

    Raises:
        WlmError: As ``run``.
        ValueError: No profile, or no time.
    """
    if not profiles or len(chosen) == 0:
        raise ValueError("expected at least one profile and one time")
    device = interop.check_device(device)
    report = progress or (lambda line: None)
    bench = _Bench(lightmaps, device, np.asarray(chosen), report)
    with tempfile.TemporaryDirectory() as folder:
        fits = [bench.fit(profile, Path(folder)) for profile in profiles]
    peers = [bench.profile_row(fit) for fit in fits]
    best = next((fit for fit in fits if fit.profile.name == "M"), fits[0])
    if (best.model.kind >= TileKind.STATIC).any():
        # On the CPU "fast" is "tanh".
        gelus = [gelu for gelu in _GELUS if device != "cpu" or gelu != "fast"]
        for path in ("exact", "strip"):
            peers += [bench.option_row(best, path, gelu) for gelu in gelus]
    report("timing the decoders, in turns")
    few = device == "cpu"
    rows = run_peers(
        peers, device, warmup=1 if few else 5, repeats=repeats if repeats is not None else 5 if few else 30
    )
    rows += [bench.codec_row(name) for name in _CODECS]
    rows += [bench.fit_row(fit) for fit in fits]
    plain = bench.plain_row(best, whole=device != "cpu" and len(chosen) == len(lightmaps.times))
    return rows + ([plain] if plain else [])


def _quick_times(times: np.ndarray) -> np.ndarray:
    """Places of the three hours, or of three times spread evenly."""
    if np.isin(_QUICK_HOURS, times).all():
        return np.searchsorted(times, _QUICK_HOURS)
    return np.unique(np.linspace(0, len(times) - 1, 3).round().astype(int))


def _hours(times: Sequence[float]) -> str:
    return ", ".join(f"{t:g}" for t in times)


def _repeated(model: LightmapModel, count: int) -> LightmapModel:
    """The model of a map that holds the tiles of this one several times over."""
    parts = (
        "kind",
        "uv",
        "uvt",
        "ut",
        "vt",
        "net",
        "net_static",
        "scale",
        "scale_static",
        "peak",
        "affine",
        "constant",
    )
    arrays = {part: np.concatenate([getattr(model, part)] * count) for part in parts}
    return replace(model, width=TILE * len(model.kind), height=TILE * count, **arrays)


@dataclass(frozen=True)
class _Fit:
    profile: Profile
    model: LightmapModel  # as read back from the file
    bytes: int
    fit_seconds: float
    write_seconds: float


class _Bench:
    """A set, where it is decoded, and the times that are scored."""

    def __init__(self, lightmaps: LightmapSet, device: str, chosen: np.ndarray, report: Report):
        self.lightmaps, self.device, self.chosen, self.report = lightmaps, device, chosen, report
        self.times = [float(t) for t in lightmaps.times[chosen]]
        self.grid = TileGrid.of(*lightmaps.mask.shape)
        count = len(lightmaps.times)
        if len(chosen) == count:
            self.scored = f"scored at all {count} times"
        else:
            self.scored = f"scored at {_hours(self.times)} of {count} times"

    def fit(self, profile: Profile, folder: Path) -> _Fit:
        """Fits and writes a profile; compiling its kernels is no part of either time."""
        self.report(f"{profile.name}: fitting {self.grid.count} tiles, {profile.steps:,} steps")
        compress(self.lightmaps, profile.model_copy(update={"steps": 10}), device=self.device)
        start = time.perf_counter()
        model = compress(self.lightmaps, profile, device=self.device)
        fitted = time.perf_counter()
        path = folder / f"{profile.name}.wlm"
        size = model.save(path)
        written = time.perf_counter()
        return _Fit(profile, wlm.load(path), size, fitted - start, written - fitted)

    def profile_row(self, fit: _Fit) -> tuple[Row, Callable[[], object]]:
        """What a profile costs and gives, but for the time of its decode, which is the function's."""
        self.report(f"{fit.profile.name}: scoring")
        model = fit.model
        decoder = Decoder(model, self.device)
        frames = {t: decoder.frame(t) for t in self.times}
        error = 0.0
        for t in self._error_times():
            tiles = np.stack([decode_tile64(model, number, t) for number in range(self.grid.count)])
            exact = assemble(tiles, np.arange(self.grid.count), self.grid)
            error = max(error, float(np.abs(frames[t] - exact).max()))
        row = self._row(
            "ours",
            fit.profile.name,
            self._score(frames.values(), fit.profile.name),
            bytes=fit.bytes,
            bpp=bits_per_texel(model, self.lightmaps.mask, fit.bytes),
            encode_seconds=fit.fit_seconds + fit.write_seconds,
            max_error=error,
            notes=f"{self._kinds(model)}; {fit.profile.steps:,} steps; {self.scored}; errors of the float decode, "
            f"max error in radiance; {self._timed('the whole map to 8 bits')}",
        )
        return row, self._decode(self._decoders(model, "strip", None))

    def option_row(self, fit: _Fit, path: str, gelu: str) -> tuple[Row, Callable[[], object]]:
        """One way to decode a profile to 8 bits."""
        self.report(f"{fit.profile.name}: {path} decode with {gelu} GELU")
        model = fit.model
        decoders = self._decoders(model, path, gelu)
        # A small map leaves most of a GPU idle: there the time is that of 1024 x 1024, the same tiles repeated.
        repeat = 1 if self.device == "cpu" else max(1, _FULL_TILES // self.grid.count)
        timed = _repeated(model, repeat)
        what = "the whole map" if repeat == 1 else f"{len(timed.kind)} tiles, the map's {repeat} times over"
        frames, error, few = [], 0.0, self._error_times()
        for t in self.times:
            tiles, worst = self._tiles_8bit(model, decoders, t, compare=t in few)
            frames.append(assemble(tiles, np.arange(self.grid.count), self.grid))
            error = max(error, worst)
        own = ", the model's own" if gelu == model.profile.gelu else ""
        row = self._row(
            path,
            _GELUS[gelu],
            # What an option costs shows in PSNR and in its largest error; FLIP would take most of the run.
            self._score(frames, path, ("psnr",)),
            max_error=error,
            notes=f"profile {fit.profile.name}, GELU by {_GELUS[gelu]}{own}; {self.scored}, float64 at {_hours(few)}; "
            f"errors of the 8-bit output, max error as a share of 255; {self._timed(what)}",
        )
        return row, self._decode(self._decoders(timed, path, gelu))

    def codec_row(self, name: str) -> Row:
        """A block codec on the same lightmaps, each time on its own."""
        method, option = _CODECS[name]
        self.report(f"{method} {option}".strip())
        encode = BASELINES[name]
        try:
            results = [encode(self.lightmaps.frames[i], self.lightmaps.mask) for i in self.chosen]
        except WlmError as error:  # a codec's package is missing, or one that it needs
            return Row("lightmap", self.lightmaps.name, method, option, notes=f"not measured: {error}")
        count, used = len(self.lightmaps.times), len(results)
        p10, median, p90 = np.percentile([1e3 * result.decode_seconds for result in results], [10, 50, 90])
        size = count * results[0].bytes  # a fixed rate: every time weighs the same
        row = self._row(
            method,
            option,
            self._score([result.decoded for result in results], method),
            bytes=size,
            bpp=size * 8 / (self.lightmaps.mask.size * count),
            encode_seconds=sum(result.encode_seconds for result in results) * count / used,
            notes=f"{self.scored}, sizes of all {count}; one CPU thread"
            + ("" if used == count else f"; encode time of {used} scaled to {count}"),
        )
        if self.device == "cpu":
            row = replace(row, decode_ms=float(median), decode_ms_spread=float(p90 - p10))
        return row

    def fit_row(self, fit: _Fit) -> Row:
        """The speed of a fit."""
        profile = fit.profile
        step_ms = 1e3 * fit.fit_seconds / profile.steps
        return Row(
            "lightmap",
            self.lightmaps.name,
            "fit",
            f"{profile.name} {profile.steps:,} steps",
            encode_seconds=fit.fit_seconds,
            notes=f"{self._kinds(fit.model)} together, {profile.samples:,} samples each: {step_ms:.3g} ms a step",
        )

    def plain_row(self, fit: _Fit, whole: bool) -> Row | None:
        """The same fit in plain torch, all of its steps or a few; None where no tile is dynamic."""
        profile = fit.profile.model_copy(update={"metric_weight": 0.0})
        targets = dynamic_targets(self.lightmaps, profile)
        if targets is None:
            return None
        self.report(f"{profile.name}: the fit in plain torch")
        tau, encoding = encode_time(TimeAxis(self.lightmaps.times, self.lightmaps.period, profile.time_axis))
        peer = PlainFit(
            tau=tau,
            encoding=encoding,
            colour=targets.colour,
            texels=targets.texels,
            count=targets.count,
            weight=targets.weight,
            sizes=(
                profile.hidden,
                profile.uvt_resolution,
                profile.uvt_slices,
                profile.plane_columns,
                profile.plane_rows,
            ),
            rates=(profile.samples, profile.steps, profile.map_rate, profile.net_rate, profile.final_rate),
            seed=0,
            device=self.device,
        )
        peer.step().item()
        steps = profile.steps if whole else min(profile.steps, _PLAIN_STEPS)
        start = time.perf_counter()
        for _ in range(steps):
            loss = peer.step()
        loss.item()  # waits for the device
        seconds = time.perf_counter() - start
        ours = fit.fit_seconds / fit.profile.steps
        return Row(
            "lightmap",
            self.lightmaps.name,
            "fit in plain torch",
            f"{profile.name} {steps:,} steps",
            encode_seconds=seconds,
            notes=f"maps stay continuous, no file; {1e3 * seconds / steps:.3g} ms a step, {seconds / steps / ours:.3g} "
            f"times ours",
        )

    def _row(self, method: str, option: str, summary: Summary, **values) -> Row:
        scores = {"psnr": summary.psnr, "ssim": summary.ssim, "flip": summary.flip}
        scores = {name: value if np.isfinite(value) else None for name, value in scores.items()}
        return Row("lightmap", self.lightmaps.name, method, option, **scores, **values)

    def _kinds(self, model: LightmapModel) -> str:
        kinds = [
            (int((model.kind == kind).sum()), kind.name.lower())
            for kind in reversed(TileKind)
            if kind != TileKind.EMPTY
        ]
        return ", ".join(f"{count} {name}" for count, name in kinds if count) + " tiles"

    def _timed(self, what: str) -> str:
        return f"time of {what}, {'one thread' if self.device == 'cpu' else 'replayed as a graph'}"

    def _error_times(self) -> list[float]:
        places = np.linspace(0, len(self.times) - 1, min(_ERROR_TIMES, len(self.times))).round().astype(int)
        return [self.times[i] for i in places]

    def _score(self, frames: Iterable[np.ndarray], name: str, metrics: Sequence[str] = METRICS) -> Summary:
        return summarise(
            [
                evaluate_frame(self.lightmaps.frames[i], frame, self.lightmaps.mask, TILE, metrics, name=name)
                for i, frame in zip(self.chosen, frames, strict=True)
            ]
        )

    def _decoders(self, model: LightmapModel, path: str, gelu: str | None) -> list[StripDecoder | ExactDecoder]:
        """What decodes the tiles with maps; a constant tile needs no launch."""
        decoders: list[StripDecoder | ExactDecoder] = []
        if (model.kind == TileKind.DYNAMIC).any():
            make = StripDecoder if path == "strip" else ExactDecoder
            decoders.append(make(model, self.device, gelu))
        if (model.kind == TileKind.STATIC).any():
            decoders.append(ExactDecoder(model, self.device, gelu, TileKind.STATIC))
        for decoder in decoders:
            decoder.set_time(self.times[0])
        return decoders

    def _decode(self, decoders: Sequence[StripDecoder | ExactDecoder]) -> Callable[[], object]:
        def decode() -> None:
            for decoder in decoders:
                decoder.decode()

        # Without any launch there is nothing to capture.
        return interop.StepGraph(decode, self.device, warmup=1) if decoders else decode

    def _tiles_8bit(
        self, model: LightmapModel, decoders: Sequence[StripDecoder | ExactDecoder], t: float, compare: bool
    ) -> tuple[np.ndarray, float]:
        """Radiance of all tiles through 8 bits, and the largest error of a byte over 255 if it is to be compared."""
        tiles = np.zeros((self.grid.count, TILE, TILE, 3))
        worst = 0.0
        for number in np.flatnonzero(model.kind == TileKind.CONSTANT).tolist():
            tiles[number] = decode_tile64(model, number, t)
        for decoder in decoders:
            decoder.set_time(t)
            decoder.decode()
            shares = decoder.numpy()[..., :3] / 255.0
            for number, share, bound in zip(decoder.numbers.tolist(), shares, decoder.bounds, strict=True):
                tiles[number] = (share * bound) ** model.profile.gamma
                peak = bound64(model, number, t)
                if compare and peak > 0:
                    exact = np.minimum(colour_tile64(model, number, t) / peak, 1.0)
                    worst = max(worst, float(np.abs(share - exact).max()))
        return tiles, worst
