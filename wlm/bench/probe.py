"""The probe system against itself, plain torch, the PCA family and an engine's packing: size, speed and error.

For each set these kinds of rows, but where another is named:

- method "ours", a profile each, and the first profile over the ratios of gaussian-probe-compression, tables 2 and 3:
  the file, the fit with the writing, the errors of the decode against the input, and the decode time of all live
  probes.
- method "decode", the first profile, a way to find and to bound the Gaussians each: what they cost and what they get
  wrong. "sphere" is the paper's way (eq. 6), another fit, in which Gaussians reach a sphere; "sphere lists" only finds
  the ellipsoids of the first fit by their spheres. The cuts below the profile's are those of the decode alone.
- method "fit", the first profile on the first set alone: the speed of the fit, and method "dense torch": as many steps
  in plain torch, all of them on CUDA, else a few.
- the rivals of ``wlm.baselines.probe`` at the bytes of the first profile's file and at three times as many, and
  Unreal's packing, which has one size. A bit a probe for the dead ones is counted for them too.
- method "volume": a walk with the cascaded volume over the decoder, and a teleport into an empty one.

A largest error is that against the float64 decode of the same model, at its own cut, in the probes' unit. A decode on
CUDA is timed as the replay of a graph, so that gaps between launches do not count; the rivals decode on the CPU alone.
"""

import math
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import warp as wp

import wlm
from wlm import interop, system
from wlm.baselines.probe import WEIGHT_BITS, Result, at_bytes, unreal_packing
from wlm.baselines.probe_torch import DenseFit
from wlm.bench.plot import Panel
from wlm.bench.runner import Row, read_json, run_peers
from wlm.errors import WlmError
from wlm.probe.codec import pack_dead
from wlm.probe.data import ProbeSet, load
from wlm.probe.decode import Decoder, Points
from wlm.probe.evaluation import Report, score
from wlm.probe.exact import decode64
from wlm.probe.fit import compress
from wlm.probe.model import ProbeModel, Profile
from wlm.probe.volume import SIZES, Volume
from wlm.probe.walk import EYE_HEIGHT, camera_path, summary, walk

__all__ = ["PANELS", "PROFILES", "RATIOS", "run", "run_rivals", "run_rows"]

PROFILES = ("standard", "compact", "paper")
"""Profiles of a run; the first is the one that the other rows are about."""

RATIOS = (0.02, 0.05, 0.10, 0.15, 0.20)
"""Gaussians as a share of the live probes, in a full run: the paper's tables 2 and 3."""

_DEMO_KEYS = ("12.00", "21.00")  # noon and night
# A quick fit is worth this many steps of one probe, however many probes there are: some seconds on two CPU cores.
_QUICK_PROBE_STEPS = 600_000
_QUICK_FRAMES = 60
_FRAMES = 240
_DENSE_STEPS = 10  # of the fit in plain torch, where it isn't run to its end
_CUTS = (2.5, 2.0)
_RIVALS: dict[str, tuple[str, Sequence[int | None]]] = {
    # The paper's own rival: clusters of places, nothing but half floats.
    "CPCA in halves": ("clustered_pca", (None,)),
    "global PCA": ("global_pca", WEIGHT_BITS),
    "block PCA": ("block_pca", WEIGHT_BITS),
    "window PCA": ("window_pca", WEIGHT_BITS),
    "clustered PCA": ("clustered_pca", WEIGHT_BITS),
    "CPCA by signal": ("clustered_pca_signal", WEIGHT_BITS),
    "moving basis": ("moving_basis", WEIGHT_BITS),
}
_SIZES = {1: "same bytes", 3: "3x bytes"}  # of the first profile's file
# The scene is scaled to this length for the volume, whose blocks are metres: the finest window covers a quarter of it.
_VILLAGE = 128.0

PANELS = (Panel("bpp", "psnr", ("ours", *_RIVALS)), Panel("decode_ms", "max_error", ("decode",)))
"""What a plot of the rows shows: quality against size, and what a quicker decode gets wrong."""

Note = Callable[[str], None]


def run(
    *,
    quick: bool,
    device: str,
    probes_path: str | os.PathLike[str] | None = None,
    keys: Sequence[str] = (),
    rivals: bool = True,
    progress: Note | None = None,
) -> list[Row]:
    """Measures the probe system on one file.

    Args:
        quick: Short fits, no other ratios than the profiles', rivals of one size, a short walk, and of the demo noon
            alone: under two minutes on two CPU cores. Its errors are those of unfinished fits.
        device: "cpu" or "cuda:0", for fits, decodes and the volume.
        probes_path: A file as ``wlm.probe.load`` reads it; None: the checkout's
            ``demos/data/probes/street.npz``.
        keys: Which of the file's arrays, one set of rows each; none: the only one, or noon and night of the demo's.
        rivals: With the PCA family and Unreal's packing, which take minutes on the CPU and no GPU: ``run_rivals``
            has them alone.
        progress: Called with a line before each part of the work.

    Returns:
        The rows, set by set in the order of the module's list.

    Raises:
        WlmError: The file, a key or the device isn't there, or a fit diverged.
    """
    sets = _load(probes_path, keys or (_DEMO_KEYS[: 1 if quick else None] if probes_path is None else ()))
    profiles = [Profile.load(name) for name in PROFILES]
    if quick:
        steps = max(200, _QUICK_PROBE_STEPS // max(int(one.live.sum()) for one in sets))
        profiles = [profile.model_copy(update={"steps": min(steps, profile.steps)}) for profile in profiles]
    return run_rows(
        sets,
        profiles,
        device=device,
        ratios=() if quick else RATIOS,
        sizes=() if not rivals else (1,) if quick else tuple(_SIZES),
        frames=_QUICK_FRAMES if quick else _FRAMES,
        progress=progress,
    )


def run_rivals(
    results: str | os.PathLike[str],
    *,
    probes_path: str | os.PathLike[str] | None = None,
    keys: Sequence[str] = (),
    progress: Note | None = None,
) -> list[Row]:
    """Measures the rivals alone, at the bytes that our first profile took on another machine.

    Args:
        results: What a former run wrote, maybe without rivals.
        probes_path: As for ``run``.
        keys: As for ``run``.
        progress: As for ``run``.

    Returns:
        The rows of the rivals, computed on the CPU.

    Raises:
        WlmError: As ``run``, or ``results`` lacks the first profile of a set.
    """
    ours = {row.scene: row.bytes for row in read_json(results)[0] if (row.method, row.option) == ("ours", PROFILES[0])}
    sets = _load(probes_path, keys or (_DEMO_KEYS if probes_path is None else ()))
    benches = [_Bench(probes, "cpu", progress or (lambda line: None)) for probes in sets]
    missing = [bench.scene for bench in benches if not ours.get(bench.scene)]
    if missing:
        raise WlmError(f"{results}: expected a row of profile {PROFILES[0]} of {missing[0]}")
    return [row for bench in benches for row in bench.rival_rows(ours[bench.scene], tuple(_SIZES))]


def _load(path: str | os.PathLike[str] | None, keys: Sequence[str]) -> list[ProbeSet]:
    if path is None:
        path = Path(wlm.__file__).resolve().parents[1] / "demos" / "data" / "probes" / "street.npz"
        if not path.is_file():
            raise WlmError("bench probe: the demo's probes come with a checkout alone; expected --probes FILE")
    return [load(path, key=key) for key in keys or (None,)]


def run_rows(
    sets: Sequence[ProbeSet],
    profiles: Sequence[Profile],
    *,
    device: str,
    ratios: Sequence[float],
    sizes: Sequence[int],
    frames: int,
    repeats: int | None = None,
    progress: Note | None = None,
) -> list[Row]:
    """Measures given profiles on given sets.

    Args:
        sets: At least one.
        profiles: At least one; all but the rows "ours" are about the first.
        device: "cpu" or "cuda:0".
        ratios: Further ratios of the first profile; its own is left out.
        sizes: Of the rivals, in bytes of the first profile's file: 1, 3; none: no rivals.
        frames: Of the walk.
        repeats: Samples of each decode time; None: 30 on CUDA, 5 on the CPU, where a sample is a whole set.
        progress: As for ``run``.

    Returns:
        The rows.

    Raises:
        WlmError: As ``run``, or no frame.
        ValueError: No set or no profile.
    """
    if not sets or not profiles:
        raise ValueError("expected at least one set and one profile")
    device = interop.check_device(device)
    few = device == "cpu"
    repeats = repeats if repeats is not None else 5 if few else 30
    rows = []
    for probes in sets:
        bench = _Bench(probes, device, progress or (lambda line: None))
        first, *others = [bench.fit(profile, profile.name) for profile in profiles]
        for ratio in ratios:
            if ratio != profiles[0].ratio:
                changed = profiles[0].model_copy(update={"ratio": ratio})
                others.append(bench.fit(changed, f"ratio {ratio:.2f}"))
        peers = [bench.profile_row(fit) for fit in (first, *others)]
        peers += bench.decode_rows(first)
        bench.note("timing the decoders, in turns")
        rows += run_peers(peers, device, warmup=1 if few else 5, repeats=repeats)
        if probes is sets[0]:
            rows += bench.fit_rows(first)
        if sizes:
            rows += bench.rival_rows(first.bytes, sizes)
        rows += bench.volume_rows(first.model, frames)
    return rows


@dataclass(frozen=True)
class _Fit:
    option: str
    model: ProbeModel  # as read back from the file
    bytes: int
    fit_seconds: float
    write_seconds: float


class _Bench:
    """A set, and where it is fitted and decoded."""

    def __init__(self, probes: ProbeSet, device: str, progress: Note):
        self.probes, self.device = probes, device
        key = probes.key.removeprefix("sh").removeprefix("_")
        self.scene = f"{probes.name} {key}".strip()
        self.note: Note = lambda line: progress(f"{self.scene}: {line}")
        self.position = probes.position[probes.live]

    def fit(self, profile: Profile, option: str) -> _Fit:
        """Fits and writes a profile; compiling its kernels is no part of either time."""
        self.note(f"{option}: fitting {len(self.position):,} probes, {profile.steps:,} steps")
        compress(self.probes, profile.model_copy(update={"steps": 10}), device=self.device)
        start = time.perf_counter()
        model = compress(self.probes, profile, device=self.device)
        fitted = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.wlm"
            writing = time.perf_counter()
            size = model.save(path)
            written = time.perf_counter()
            return _Fit(option, system.load(path, "probe"), size, fitted - start, written - writing)

    def profile_row(self, fit: _Fit) -> tuple[Row, Callable[[], object]]:
        """What a fit costs and gives, but for the time of its decode, which is the function's."""
        model, decoder = fit.model, Decoder(fit.model, self.device)
        points = decoder.points(self.position)
        report, error, usual = self._decode(decoder, points, decode64(model, self.position), fit.bytes)
        irradiance = "" if report.irradiance_psnr is None else f", irradiance {report.irradiance_psnr:.2f} dB"
        row = self._row(
            "ours",
            fit.option,
            report,
            max_error=error,
            encode_seconds=fit.fit_seconds + fit.write_seconds,
            notes=f"{model.count:,} Gaussians, {model.dropped:,} dropped, for {report.live:,} live probes; "
            f"{100 * report.ratio:.2f}% of float32{irradiance}; {model.profile.steps:,} steps; {usual}; "
            f"{self._timed()}",
        )
        return row, self._timer(decoder, points)

    def decode_rows(self, fit: _Fit) -> list[tuple[Row, Callable[[], object]]]:
        """The ways to decode a model."""
        model = fit.model
        spheres = self.fit(model.profile.model_copy(update={"support": "sphere"}), "sphere").model
        own, other = decode64(model, self.position), decode64(spheres, self.position)
        ways = {
            "none": (Decoder(model, self.device, culling="none"), own),
            "sphere": (Decoder(spheres, self.device), other),
            "sphere lists": (Decoder(model, self.device, culling="sphere"), own),
            "box": (Decoder(model, self.device, culling="box"), own),
            "exact": (Decoder(model, self.device, culling="exact"), own),
            "exact, given order": (Decoder(model, self.device, culling="exact"), own),
        }
        for cut in _CUTS:
            if cut < model.profile.cut:
                ways[f"cut {cut:g}"] = (Decoder(model, self.device, cut=cut), own)
        rows = []
        for option, (decoder, exact) in ways.items():
            points = decoder.points(self.position)
            if option == "exact, given order":
                _in_given_order(points)
            report, error, usual = self._decode(decoder, points, exact, fit.bytes)
            what = f"profile {fit.option}{' with the spheres of eq. 6' if option == 'sphere' else ''}"
            row = self._row(
                "decode",
                option,
                report,
                max_error=error,
                bytes=None,
                bpp=None,
                notes=f"{what}, {decoder.model.count:,} Gaussians, {decoder.pairs:,} list entries; {usual}; "
                f"{self._timed()}",
            )
            rows.append((row, self._timer(decoder, points)))
        return rows

    def fit_rows(self, fit: _Fit) -> list[Row]:
        """The speed of the fit alone, and of the same fit in plain torch."""
        p, model = fit.model.profile, fit.model
        count = model.count + model.dropped
        what = f"{len(self.position):,} probes, {count:,} Gaussians"
        step_ms = 1e3 * fit.fit_seconds / p.steps
        option = f"{fit.option} {p.steps:,} steps"
        ours = Row("probe", self.scene, "fit", option, encode_seconds=fit.fit_seconds)
        ours = replace(ours, notes=f"{what}, their first places too: {step_ms:.3g} ms a step")
        self.note(f"{fit.option}: the fit in plain torch")
        peer = DenseFit(
            model.normalise(self.position),
            self.probes.values[self.probes.live],
            count=count,
            latent=p.latent,
            hidden=p.hidden,
            steps=p.steps,
            rates=(p.centre_rate, p.scale_rate, p.rotation_rate, p.latent_rate, p.net_rate),
            final=p.final_rate,
            bits=p.bits,
            seed=0,
            device=self.device,
        )
        peer.step()  # loads what torch loads late
        whole = self.device != "cpu"
        steps = p.steps - 1 if whole else min(p.steps, _DENSE_STEPS)
        peer.run(steps)
        seconds = peer.seconds / steps
        scaled = "" if whole else f"; time of {steps} steps scaled to {p.steps:,}"
        row = Row(
            "probe",
            self.scene,
            "dense torch",
            option,
            encode_seconds=seconds * p.steps,
            notes=f"{what}, each at each probe, no file: {1e3 * seconds:.3g} ms a step, {1e3 * seconds / step_ms:.3g} "
            f"times ours{scaled}",
        )
        if whole:
            row = replace(row, psnr=_finite(score(self._all(peer.decoded()), self.probes, fit.bytes).psnr))
        return [ours, row]

    def rival_rows(self, size: int, sizes: Sequence[int]) -> list[Row]:
        """The rivals at some times the size of a file, and Unreal's packing."""
        return [*(self.rival_row(name, size, times) for times in sizes for name in _RIVALS), self.unreal_row()]

    def rival_row(self, name: str, size: int, times: int) -> Row:
        """A rival at some times the size of a file."""
        self.note(f"{name}, {_SIZES[times]}")
        baseline, bits = _RIVALS[name]
        budget = times * size - self._dead_bytes()
        try:
            result = at_bytes(baseline, self.position, self._live_values(), budget, bits)
        except WlmError as error:  # nothing fits
            return Row("probe", self.scene, name, _SIZES[times], notes=f"not measured: {error}")
        return self._result_row(name, _SIZES[times], result)

    def unreal_row(self) -> Row:
        """Unreal's packing, at its own size."""
        try:
            return self._result_row("Unreal packing", "", unreal_packing(self.position, self._live_values()))
        except WlmError as error:  # not L0, L1 or L2 in RGB
            return Row("probe", self.scene, "Unreal packing", notes=f"not measured: {error}")

    def volume_rows(self, model: ProbeModel, frames: int) -> list[Row]:
        """A teleport into an empty volume, and a walk from there."""
        self.note(f"the volume, {frames} frames")
        extent = float(np.ptp(self.position, axis=0).max())
        scale = extent / _VILLAGE if extent > 0 else 1.0
        path = camera_path(self.position, frames, EYE_HEIGHT * scale)
        decoder = Decoder(model, self.device)
        volume = Volume(
            self.probes.position,
            decoder.decode,
            model.outputs,
            live=self.probes.live,
            scale=scale,
            device=self.device,
        )
        start = walk(volume, path[:1])
        left, count = start[0].stats.left, 1
        while left:
            left, count = volume.update(path[0]).left, count + 1
        settled = walk(volume, path[:1])
        walked = summary(walk(volume, path))
        blocks = ", ".join(f"{size:g}" for size in SIZES)
        world = f"blocks of {blocks} m, the scene as {_VILLAGE:g} m; {volume.memory_bytes / 2**20:.1f} MB"
        work = f"update {_two(walked['update_ms'])} ms, of which decode {_two(walked['decode_ms'])} ms"
        work += f", {_two(walked['updated'])} blocks and {_two(walked['probes'])} probes decoded (mean, 95%)"
        first, last = summary(start), summary(settled)
        row = Row("probe", self.scene, "volume")
        return [
            replace(row, option=f"walk of {frames} frames", notes=f"{world}; {work}; {_light(walked)}"),
            replace(
                row,
                option="teleport",
                notes=f"into an empty volume: {count} frames until nothing waits; the first took "
                f"{first['update_ms']['max']:.3g} ms; after it {_light(first)}; after the last {_light(last)}",
            ),
        ]

    def _decode(self, decoder: Decoder, points: Points, exact: np.ndarray, size: int) -> tuple[Report, float, str]:
        """Scores, the largest error against float64, and where nearly all errors lie.

        A point that rounding puts on the other side of a Gaussian's edge has an error far beyond all others.
        """
        decoder.run(points)
        values = points.values()
        error = np.abs(values - exact).max(1)
        report = score(self._all(values), self.probes, size)
        return report, float(error.max()), f"99.9% of the probes within {np.percentile(error, 99.9):.2g} of float64"

    def _timer(self, decoder: Decoder, points: Points) -> Callable[[], object]:
        return interop.StepGraph(lambda: decoder.run(points), self.device, warmup=1)

    def _timed(self) -> str:
        return f"time of all live probes, {'one thread' if self.device == 'cpu' else 'replayed as a graph'}"

    def _all(self, live: np.ndarray) -> np.ndarray:
        """Values of all probes, the dead ones zero."""
        values = np.zeros_like(self.probes.values)
        values[self.probes.live] = live
        return values

    def _live_values(self) -> np.ndarray:
        return self.probes.values[self.probes.live]

    def _dead_bytes(self) -> int:
        """What it takes to say which probes are dead, as in our file."""
        return len(pack_dead(~self.probes.live))

    def _result_row(self, method: str, option: str, result: Result) -> Row:
        size = result.bytes + self._dead_bytes()
        report = score(self._all(result.decoded), self.probes, size)
        row = self._row(
            method,
            option,
            report,
            encode_seconds=result.encode_seconds,
            notes=f"{result.option}; {100 * report.ratio:.2f}% of float32; on the CPU",
        )
        return replace(row, decode_ms=1e3 * result.decode_seconds) if self.device == "cpu" else row

    def _row(self, method: str, option: str, report: Report, **values) -> Row:
        scores = {"bytes": report.bytes, "bpp": report.bits_per_probe, "psnr": _finite(report.psnr)}
        return Row("probe", self.scene, method, option, **(scores | values))


def _in_given_order(points: Points) -> None:
    """Puts points back in the order in which they were given, in which neighbours may lie far apart."""
    x = np.empty((len(points.order), 3), np.float32)
    x[points.order] = points.x.numpy()
    points.x = wp.array(x, dtype=wp.vec3, device=points.x.device)
    points.order = np.arange(len(x))


def _finite(value: float) -> float | None:
    """JSON has no NaN: a set without a range has no PSNR."""
    return value if math.isfinite(value) else None


def _two(figures: dict[str, float]) -> str:
    return f"{figures['mean']:.3g}, {figures['p95']:.3g}"


def _light(figures: dict) -> str:
    """What the samples of a walk say of the light."""
    if figures["coverage"] is None:
        return "no probe near the viewer"
    return (
        f"coverage {100 * figures['coverage']['mean']:.1f}%, rmse {figures['rmse']['mean']:.3g} against the direct "
        f"decode's rms {figures['rms']['mean']:.3g}"
    )
