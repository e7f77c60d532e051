"""Size, speed and error of compressed lightmaps: each profile, each way to decode, and rival codecs, in one run.

The results table has these kinds of rows:

- method "ours", one row for each profile: file size, time of the fit, errors of the float decode against the input,
  time to decode all tiles to RGB9E5 by the fast kernel, and time to unpack one tile of the file. The largest error
  is in units of radiance, against a float64 decode.
- method "exact" (a kernel of one texel per thread), one row for each way to compute the network's GELU, and on CUDA
  "matrix" (the fast kernel on matrix units), all of profile M: error of the RGB9E5 output against the input, and
  largest error against a float64 decode in gamma space, relative to the largest colour that the tile can have.
- method "texture", one row for each profile: the map as a renderer samples it, one RGB9E5 texture with all mips
  (`benchmarks.rivals.whole_tiles`): its errors, and the time to decode it.
- method "pages", one row for each profile with networks: all pages of all mips as a virtual texture holds them, RGB9E5
  with a border of 4 texels, from one list (`wlm.lightmap.virtual`): errors of the texels of the map, the largest as for
  "exact", and the time to decode all pages.
- the rivals of `benchmarks.rivals.lightmap`, on the same lightmaps: block codecs, temporal PCA, a neural texture codec
  and a video codec; between stored times their lightmaps are interpolated linearly.
- method "fit", one row for each profile: the speed of the fit alone. Method "fit in plain torch" has the speed of the
  same fit in torch, over some steps.

Profiles and rivals also have the errors of `wlm.lightmap.view_scores`: at times half-way between two scored times, and
in a full run also in rendered views.

A decode on CUDA is timed as the replay of a CUDA graph, so that gaps between launches do not count. Rivals are decoded
and timed on the CPU alone. `bytes` and `bpp` are sizes in memory, `disk_bytes` and `disk_bpp` sizes after lossless
compression; methods without random access only have sizes on disk.
"""

import functools
import os
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from benchmarks.lightmap_exact import bound64, colour_tile64, decode_tile64
from benchmarks.plot import Panel
from benchmarks.rivals.lightmap import RIVALS, check_rival, encode_set, usual
from benchmarks.rivals.lightmap_torch import PlainFit, dynamic_targets
from benchmarks.rivals.whole_map import WholeMap
from benchmarks.rivals.whole_tiles import (
    ExactDecoder,
    FrameDecoder,
    MatrixDecoder,
    TileDecoder,
    fast_decoder,
)
from benchmarks.rows import Row
from benchmarks.runner import Bench, Fit, Note, demo_data, expect_alone
from wlm.errors import WlmError
from wlm.formats import zstd
from wlm.lightmap.data import LightmapSet, load
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.encodings import encoding_of
from wlm.lightmap.evaluation import bits_per_texel, count_kinds
from wlm.lightmap.fit import compress
from wlm.lightmap.model import PACKED_KINDS, SheetModel
from wlm.lightmap.profile import Profile, TimeAxis
from wlm.lightmap.tiles import TILE, TileGrid, TileKind, place
from wlm.lightmap.view_scores import VIEWS, Tally, views_of
from wlm.lightmap.virtual.texture import STRIDE, VirtualTexture
from wlm.metrics import METRICS, FrameMetrics, evaluate_frame, summarise

PROFILES = ("L", "M", "H", "M64", "standard", "fine", "M-paper")
"""Profiles of a full run: the paper's table 3, ours, and M as the paper fits it."""

QUICK_PROFILES = ("L", "M", "M-paper")
"""Profiles of a quick run."""

PANELS = (Panel("decode_ms"), Panel("bpp"), Panel("disk_bpp"))
"""Panels of a plot of the rows: quality against time and size."""

# A quick fit is worth this many steps of one tile, however many tiles there are: under a minute on two CPU cores.
_QUICK_TILE_STEPS = 8_000
_QUICK_SAMPLES = 2048
_QUICK_HOURS = (9.0, 12.0, 21.0)  # morning, noon and lamps
_FULL_TILES = 64  # tiles of a lightmap of 1024 x 1024
_PLAIN_STEPS = {"cpu": 10, "cuda": 1000}  # steps of the fit in plain torch that are timed
ALL, PAGES = 1 << 40, 1024  # bytes of a virtual texture that holds all pages; most pages that it decodes at once
PAGE_FRAMES = 2  # frames after which all pages of a time are there
_LOADS = 50  # tiles that are unpacked for the time of one
_ERROR_TIMES = 3  # the float64 path takes 30 ms for one tile at one time

_SEEN = ("seen", "ring", "between", "border", "view_psnr", "view_flip")  # scores that are figures by their names

# GELU by its gate, which is shorter to read in a plot.
_GELUS = {"exact": "erf", "tanh": "tanh", "fast": "fast tanh"}


def run(
    *,
    quick: bool,
    device: str,
    set_path: str | os.PathLike[str] | None = None,
    profiles: Sequence[str] | None = None,
    rivals: bool = True,
    rivals_only: bool = False,
    rival_names: Sequence[str] | None = None,
    progress: Note | None = None,
) -> list[Row]:
    """Measures the compression of one set of lightmaps over time.

    Args:
        quick: Whether to fit three profiles for few steps, measure a third of the rivals, and measure errors at three
            times only. This takes five minutes on two CPU cores for 16 tiles; the unfinished fits have large errors.
        device: "cpu" or "cuda:0", for fits and decodes.
        set_path: A lightmap set; None: the checkout's `demos/data/city`, two tiles of the city.
        profiles: Names or YAML files of profiles; None: `QUICK_PROFILES` if `quick`, else `PROFILES`.
        rivals: Whether to measure the rivals too.
        rivals_only: Whether to measure only the rivals. They need no GPU, except neural texture compression.
        rival_names: Keys of `benchmarks.rivals.lightmap.RIVALS`. If given, only these rivals are measured.
        progress: Called with a line before each part of the work.

    Returns:
        The rows, in the order in which the module's docstring lists them.

    Raises:
        WlmError: The set, the device or a rival does not exist, options contradict each other, or a fit diverged.
    """
    for name in rival_names or ():
        check_rival(name)
    if rivals_only or rival_names:
        expect_alone("--rivals-only", {"--no-rivals": not rivals, "--profile": profiles})
    lightmaps = load(demo_data("city", "--set PATH") if set_path is None else set_path)
    chosen = _quick_times(lightmaps.times) if quick else np.arange(len(lightmaps.times))
    if rivals_only or rival_names:
        bench = _LightmapBench(lightmaps, chosen, device, progress, None)
        return [bench.rival_row(name) for name in rival_names or usual(bench.device, quick)]
    loaded = [Profile.load(name) for name in profiles or (QUICK_PROFILES if quick else PROFILES)]
    if quick:
        steps = max(200, _QUICK_TILE_STEPS // TileGrid.of(*lightmaps.light.mask.shape).count)
        short = {"samples": _QUICK_SAMPLES}
        loaded = [each.model_copy(update=short | {"steps": min(steps, each.steps)}) for each in loaded]
    names = usual(device, quick) if rivals else ()
    return run_rows(lightmaps, loaded, device=device, chosen=chosen, rivals=names, progress=progress)


def run_rows(
    lightmaps: LightmapSet,
    profiles: Sequence[Profile],
    *,
    device: str,
    chosen: Sequence[int] | np.ndarray,
    rivals: Sequence[str] = (),
    repeats: int | None = None,
    progress: Note | None = None,
) -> list[Row]:
    """Measures given profiles on a given lightmap set. Arguments that are not listed here are as for `run`.

    Args:
        lightmaps: The lightmap set.
        profiles: At least one profile. The ways to decode are measured with the profile "M", or else the first.
        chosen: Indices of the times at which errors are measured, at least one.
        rivals: Keys of `benchmarks.rivals.lightmap.RIVALS`.
        repeats: As for `Bench`.
    """
    if not profiles or len(chosen) == 0:
        raise ValueError("expected at least one profile and one time")
    bench = _LightmapBench(lightmaps, np.asarray(chosen), device, progress, repeats)
    fits = [bench.fit_profile(profile) for profile in profiles]
    peers = []
    for fit in fits:
        makers = (bench.profile_row, bench.texture_row, *[bench.pages_row] * bool(len(fit.model.light.uv)))
        peers += [make(fit) for make in makers]
    best = next((fit for fit in fits if fit.option == "M"), fits[0])
    if len(best.model.light.uv):
        # On the CPU "fast" is "tanh".
        gelus = [gelu for gelu in _GELUS if bench.device != "cpu" or gelu != "fast"]
        peers += [bench.option_row(best, "exact", gelu) for gelu in gelus]
        if bench.device != "cpu" and best.model.profile.hidden % 16 == 0:
            peers.append(bench.option_row(best, "matrix", "fast"))
    rows = bench.time_rows(peers)
    rows += [bench.rival_row(name) for name in rivals]
    rows += [bench.fit_row(fit) for fit in fits if len(fit.model.light.uv)]
    return rows + bench.plain_rows(best)


def _quick_times(times: np.ndarray) -> np.ndarray:
    """Returns the indices of 9, 12 and 21 h if the set has these times, else of three evenly spaced times."""
    if np.isin(_QUICK_HOURS, times).all():
        return np.searchsorted(times, _QUICK_HOURS)
    return np.unique(np.linspace(0, len(times) - 1, 3).round().astype(int))


def _hours(times: Sequence[float]) -> str:
    return ", ".join(f"{t:g}" for t in times)


def _repeated(model: SheetModel, count: int) -> SheetModel:
    """Returns a larger model that holds `count` copies of each tile."""
    arrays = {name: np.concatenate([array] * count) for name, array in model.parts.items()}
    width, height = TILE * len(model.kind), TILE * count
    return replace(model, width=width, height=height, mask=np.ones((height, width), bool), **arrays)


def view_of_all_pages(texture: VirtualTexture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns sheet, UV and derivatives of a view that needs every page: a square of pixels for each."""
    layout, own = texture.layout, texture.layout.models[0]
    _, level, row, column = layout.place.T
    texel = 2.0 ** (level + 0.01)[:, None] / [own.width, own.height]
    uv = (np.stack([column, row], 1) + 0.5) * layout.side * 2.0 ** level[:, None] / [own.width, own.height]
    slopes = np.stack([texel[:, 0], 0.0 * level, 0.0 * level, texel[:, 1]], 1)
    zero = np.zeros((STRIDE, STRIDE * len(level)), np.int32)
    return zero, *(np.repeat(part[None], STRIDE, 0).repeat(STRIDE, 1).astype(np.float32) for part in (uv, slopes))


def texels_of(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns sheet, UV and derivatives at the centre of each texel of a map."""
    y, x = (np.mgrid[: shape[0], : shape[1]] + 0.5) / np.reshape(shape, (2, 1, 1))
    return np.zeros(shape, np.int32), np.stack([x, y], 2), np.zeros((*shape, 4), np.float32)


def _load_ms(model: SheetModel) -> float | None:
    """Returns the median time in ms to unpack one tile of the file on the CPU; None if no tile has packed data."""
    numbers = model.numbers(*PACKED_KINDS).tolist()
    if not numbers:
        return None
    packed = [(number, encoding_of(model.kind[number])) for number in numbers]
    frames = [(number, encoding, zstd.compress(encoding.pack(model, number))) for number, encoding in packed]
    seconds = []
    for number, encoding, frame in frames * max(1, _LOADS // len(frames)):
        start = time.perf_counter()
        data = zstd.decompress(frame, encoding.packed_size(model, number), "tile")
        encoding.unpack(model, number, np.frombuffer(data, np.uint8))
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds))


class _LightmapBench(Bench):
    """The benchmark of one lightmap set, with the times at which errors are measured."""

    def __init__(
        self, lightmaps: LightmapSet, chosen: np.ndarray, device: str, progress: Note | None, repeats: int | None
    ) -> None:
        super().__init__("lightmap", device, progress, scene=lightmaps.name, repeats=repeats)
        self.set, self.lightmaps, self.chosen = lightmaps, lightmaps.light, chosen
        self.times = [float(t) for t in lightmaps.times[chosen]]
        self.grid = TileGrid.of(*self.lightmaps.mask.shape)
        places = np.linspace(0, len(self.times) - 1, min(_ERROR_TIMES, len(self.times))).round().astype(int)
        self.error_times = [self.times[i] for i in places]
        """Times that are also decoded by the float64 path."""
        self.scored = {"times": len(lightmaps.times), "times_scored": len(chosen)}
        whole = len(chosen) == len(lightmaps.times)
        self.scored_at = "" if whole else f"scored at {_hours(self.times)}; "

    def fit_profile(self, profile: Profile) -> Fit:
        """Compresses the set with a profile, writes the file and reads it back. Kernels are compiled beforehand."""
        if profile.frames == "always":  # no kernel is compiled
            self.note(f"{profile.name}: encoding {self.grid.count} tiles")
            return self.fit(profile.name, lambda: compress(self.set, profile, device=self.device))
        self.note(f"{profile.name}: fitting {self.grid.count} tiles, {profile.steps:,} steps")
        compress(self.set, profile.model_copy(update={"steps": 10}), device=self.device)
        return self.fit(profile.name, lambda: compress(self.set, profile, device=self.device))

    def profile_row(self, fit: Fit) -> tuple[Row, Callable[[], object]]:
        """Returns the row of a compressed model, and a call that decodes the model to RGB9E5, for the timing."""
        self.note(f"{fit.option}: measuring errors")
        model = fit.model.light
        decoder = SheetDecoder(model, self.device)
        frames = {t: decoder.frame(t) for t in self.times}
        error = 0.0
        for t in self.error_times:
            exact = self._assembled(np.stack([decode_tile64(model, number, t) for number in range(self.grid.count)]))
            # The float64 path leaves gaps unfilled.
            error = max(error, float(np.abs(frames[t] - exact)[self.lightmaps.mask].max()))
        row = self.row(
            "ours",
            fit.option,
            f"{self.scored_at}errors of the float decode; time of all tiles to RGB9E5, {self.mode}",
            bytes=model.memory_bytes,
            bpp=bits_per_texel(model, self.lightmaps.mask, model.memory_bytes),
            disk_bytes=fit.bytes,
            disk_bpp=bits_per_texel(model, self.lightmaps.mask, fit.bytes),
            encode_seconds=fit.seconds,
            load_ms=_load_ms(model),
            max_error=error,
            steps=model.profile.steps if len(model.uv) else None,
            **self._score(frames.values(), fit.option, decode=decoder.frame),
            **self._tiles(model),
        )
        return row, self._decode(self._decoders(model, "fast", None))

    def texture_row(self, fit: Fit) -> tuple[Row, Callable[[], object]]:
        """Returns the row of the RGB9E5 texture that a renderer samples, and a call that decodes the texture."""
        self.note(f"{fit.option}: measuring the texture")
        decoder = WholeMap(fit.model.light, self.device)

        def frame(t: float) -> np.ndarray:
            decoder.set_time(t)
            decoder.decode()
            return decoder.numpy()

        row = self.row(
            "texture",
            fit.option,
            f"{self.scored_at}one RGB9E5 texture with {len(decoder.levels) - 1} mips; time of all of it, {self.mode}",
            **self._score((frame(t) for t in self.times), fit.option, ("psnr",), frame, views=0),
        )
        decoder.set_time(self.times[0])
        return row, self.replay(decoder.decode)

    def pages_row(self, fit: Fit) -> tuple[Row, Callable[[], object]]:
        """Returns the row of the pages of a virtual texture, and a call that decodes all of them."""
        self.note(f"{fit.option}: measuring the pages")
        texture, timed = (
            VirtualTexture(fit.model, self.device, budget=ALL, decodes=PAGES, tolerance=1e-6) for _ in range(2)
        )
        view, found, worst = view_of_all_pages(texture), [], 0.0
        for t in self.times:
            for _ in range(PAGE_FRAMES):
                texture.frame(t, *view)
            found.append(texture.sample(*texels_of(self.lightmaps.mask.shape)).light)
            if t in self.error_times:
                worst = max(worst, self._largest_error(fit.model.light, found[-1], t))
        timed.frame(self.times[-1], *view)  # all pages are missing, so that its list has all of them
        row = self.row(
            "pages",
            fit.option,
            f"{self.scored_at}errors of the map itself, the largest as a share of the tile's bound; time of all pages "
            f"of all mips with borders of {texture.layout.border} texels, {self.mode}",
            max_error=worst,
            pages_decoded=timed.report()["decoded"],
            **self._score(found, fit.option, ("psnr",)),
        )
        return row, self.replay(timed.stages["decode"])

    def option_row(self, fit: Fit, path: str, gelu: str) -> tuple[Row, Callable[[], object]]:
        """Returns the row of one decoding kernel with one form of the GELU, and a call that decodes with it."""
        self.note(f"{fit.option}: {path} decode with {gelu} GELU")
        model = fit.model.light
        decoders = self._decoders(model, path, gelu)
        # A small map leaves most of a GPU idle: there the time is that of 1024 x 1024, the same tiles repeated.
        repeat = 1 if self.device == "cpu" else max(1, _FULL_TILES // self.grid.count)
        timed = _repeated(model, repeat)
        frames, error = [], 0.0
        for t in self.times:
            frames.append(self._assembled(self._decoded_tiles(model, decoders, t)))
            if t in self.error_times:
                error = max(error, self._largest_error(model, frames[-1], t))
        trained = ", as trained" if gelu == model.profile.gelu else ""
        row = self.row(
            path,
            _GELUS[gelu],
            f"profile {fit.option}, GELU by {_GELUS[gelu]}{trained}; {self.scored_at}errors of the RGB9E5 output, the "
            f"largest as a share of the tile's bound at {_hours(self.error_times)}; time {self.mode}",
            max_error=error,
            tiles_timed=len(timed.kind),
            # What an option costs shows in PSNR and in its largest error; FLIP would take most of the run.
            **self._score(frames, path, ("psnr",)),
        )
        return row, self._decode(self._decoders(timed, path, gelu))

    def rival_row(self, name: str) -> Row:
        """Returns the row of a rival on the same lightmaps."""
        method = RIVALS[name]
        self.note(f"compressing: {method.label}")
        try:
            tally = self._tally(name)
            score = functools.partial(self._frame, name, tally)
            rival, frames = encode_set(name, self.lightmaps, score, self.chosen, device=self.device)
        except WlmError as error:
            return self.missing_row(method.title, method.option, error)
        count = len(self.lightmaps.times)
        bits = 8 / (self.lightmaps.mask.size * count)
        where = "" if method.fitted else ", on one CPU thread"
        notes = [f"{self.scored_at}size and encode time of all times{where}", rival.option]
        figures = {"disk_bytes": rival.disk_bytes, "disk_bpp": rival.disk_bytes * bits}
        if method.random_access:
            figures |= {"bytes": rival.bytes, "bpp": rival.bytes * bits}
        else:
            notes.append("no random access")
        if self.device == "cpu":
            figures["decode_ms"] = 1e3 * rival.decode_seconds / count
        figures |= {"encode_seconds": rival.encode_seconds, **self._figures(frames, tally)}
        return self.row(method.title, method.option, "; ".join(filter(None, notes)), **figures)

    def fit_row(self, fit: Fit) -> Row:
        """Returns the row with the speed of the fit alone."""
        profile = fit.model.profile
        return self.row(
            "fit",
            f"{fit.option} {profile.steps:,} steps",
            "all tiles together",
            encode_seconds=fit.fit_seconds,
            step_ms=1e3 * fit.fit_seconds / profile.steps,
            steps=profile.steps,
            samples=profile.samples,
            **self._tiles(fit.model.light),
        )

    def plain_rows(self, fit: Fit) -> list[Row]:
        """Times some steps of the same fit in plain torch. Returns one row, or none if no tile changes over time."""
        # What a file would hold is left out: the loss is the plain square, and the maps stay continuous.
        plain = {"metric_weight": 0.0, "quantise_from": 1.0, "freeze_from": 1.0}
        profile = fit.model.profile.model_copy(update=plain)
        targets = dynamic_targets(self.lightmaps, profile)
        if targets is None:
            return []
        self.note(f"{fit.option}: fitting in plain torch")
        axis = TimeAxis(self.lightmaps.times, self.lightmaps.period, profile.time_axis)
        peer = PlainFit(profile, axis, targets, device=self.device)
        peer.step().item()
        steps = min(profile.steps, _PLAIN_STEPS["cpu" if self.device == "cpu" else "cuda"])
        start = time.perf_counter()
        for _ in range(steps):
            loss = peer.step()
        loss.item()  # waits for the device
        seconds = time.perf_counter() - start
        row = self.row(
            "fit in plain torch",
            f"{fit.option} {steps:,} steps",
            "maps stay continuous, no file",
            encode_seconds=seconds,
            step_ms=1e3 * seconds / steps,
            times_ours=seconds / steps / (fit.fit_seconds / profile.steps),
            steps=steps,
        )
        return [row]

    def _largest_error(self, model: SheetModel, light: np.ndarray, t: float) -> float:
        """Returns the largest error of valid texels, in gamma space and relative to a tile's bound."""
        worst = 0.0
        for number in np.flatnonzero(model.kind != TileKind.EMPTY).tolist():
            window, peak = self.grid.window(number), bound64(model, number, t)
            valid = self.lightmaps.mask[window]
            if peak > 0.0 and valid.any():
                exact = np.minimum(colour_tile64(model, number, t) / peak, 1.0)[: len(valid), : valid.shape[1]]
                colour = np.minimum(light[window] ** (1.0 / model.profile.gamma) / peak, 1.0)
                worst = max(worst, float(np.abs(colour - exact)[valid].max()))
        return worst

    def _assembled(self, tiles: np.ndarray) -> np.ndarray:
        image = np.zeros((self.grid.height, self.grid.width, 3), tiles.dtype)
        place(image, tiles, np.arange(self.grid.count), self.grid)
        return image

    def _tiles(self, model: SheetModel) -> dict[str, int]:
        """Returns the number of tiles of each kind: constant, dynamic and stored frames, but not empty."""
        kinds = count_kinds(model).items()
        return {f"{kind}_tiles": count for kind, count in kinds if count and kind != "empty"}

    def _score(
        self,
        frames: Iterable[np.ndarray],
        name: str,
        metrics: Sequence[str] = METRICS,
        decode: Callable[[float], np.ndarray] | None = None,
        views: int = VIEWS,
    ) -> dict[str, float]:
        """Returns errors of lightmaps at the chosen times and, with `decode`, of their light as a renderer shows it."""
        tally = None if decode is None else self._tally(name, decode, views)
        pairs = zip(self.chosen.tolist(), frames, strict=True)
        return self._figures([self._frame(name, tally, i, frame, metrics) for i, frame in pairs], tally)

    def _tally(self, name: str, decode: Callable[[float], np.ndarray] | None = None, views: int = VIEWS) -> Tally:
        """Makes the object that collects errors of light as a renderer shows it: filtered, between times, in views."""
        whole = len(self.chosen) == len(self.lightmaps.times)
        seen_from, warnings = views_of(self.lightmaps, views if whole else 0, device=self.device)
        for warning in warnings:
            self.note(warning)
        return Tally(self.lightmaps, self.lightmaps.mask, decode, seen_from, name)

    def _frame(
        self, name: str, tally: Tally | None, i: int, decoded: np.ndarray, metrics: Sequence[str] = METRICS
    ) -> FrameMetrics:
        frame, valid = self.lightmaps.frames[i], self.lightmaps.valid(i)
        scores = evaluate_frame(frame, decoded, valid, TILE, metrics, name=name)
        if tally is not None:
            tally.add(i, decoded, scores)
        return scores

    def _figures(self, frames: Sequence[FrameMetrics], tally: Tally | None) -> dict[str, float]:
        """Returns PSNR, SSIM, FLIP, the number of scored times, and with `tally` errors of light as shown."""
        summary = summarise(frames)
        figures = {"psnr": summary.psnr, "ssim": summary.ssim, "flip": summary.flip, **self.scored}
        if tally is None:
            return figures
        score = tally.score()
        figures |= {key: getattr(score, key) for key in _SEEN} | {"excess_change": score.flicker}
        worst = {"worst_seen": score.worst_seen, "worst_between": score.worst_between}
        return figures | {key: where["psnr"] for key, where in worst.items() if where is not None}

    def _decoders(self, model: SheetModel, path: str, gelu: str | None) -> list[TileDecoder]:
        """Makes the decoders of all tiles with feature maps or stored frames; tiles of constant light need none."""
        decoders: list[TileDecoder] = []
        if (model.kind == TileKind.DYNAMIC).any():
            if path == "fast":
                decoders.append(fast_decoder(model, self.device))
            elif path == "matrix":
                decoders.append(MatrixDecoder(model, self.device))
            else:
                decoders.append(ExactDecoder(model, self.device, gelu))
        if len(model.frames):
            decoders.append(FrameDecoder(model, self.device))
        for decoder in decoders:
            decoder.set_time(self.times[0])
        return decoders

    def _decode(self, decoders: Sequence[TileDecoder]) -> Callable[[], object]:
        def decode() -> None:
            for decoder in decoders:
                decoder.decode()

        # Without any launch there is nothing to capture.
        return self.replay(decode) if decoders else decode

    def _decoded_tiles(self, model: SheetModel, decoders: Sequence[TileDecoder], t: float) -> np.ndarray:
        """Decodes all tiles to RGB9E5 and returns their radiance."""
        tiles = np.zeros((self.grid.count, TILE, TILE, 3))
        for number in np.flatnonzero(model.kind == TileKind.CONSTANT).tolist():
            tiles[number] = decode_tile64(model, number, t)
        for decoder in decoders:
            decoder.set_time(t)
            decoder.decode()
            tiles[decoder.numbers] = decoder.numpy()
        return tiles
