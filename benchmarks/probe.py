"""Size, speed and error of compressed light probes, beside a fit in plain torch; `--table` has the rivals.

The results table of each set of probes has these rows, by method:

- "ours": one row for each profile, and one for the first profile at each compression ratio of tables 2 and 3 of
  gaussian-probe-compression: size on disk and on a GPU, time to fit and write, errors against the input, and time to
  decode all live probes. "pca" has the same figures for the profile of principal components.
- "decode": the first profile, with Gaussians that are cut off at ellipsoids, or at spheres as in the paper (eq. 6);
  each is a fit of its own.
- "fit": speed of the fit by the first profile on the first set. "dense torch": the same fit in plain torch, with as
  many steps on CUDA and only a few on a CPU.
- "held out": every fifth probe is left out of a fit by the first profile, which predicts its light, as do two simple
  interpolations of the uncompressed other probes. "half-way" is the error of the full fit between probes.
- "volume", the first profile: a viewer walks through the cascaded volume, which is filled from the original probes
  ("lossless") or from a model. Times are means and 95th percentiles over frames. The PSNR compares light read from the
  volume at probes near the viewer with the input; further columns have the PSNR of the decoded probes at the same
  places, and of light read farther away. The walk starts with an empty volume: hence the time of the first frame,
  and the frames until all blocks are filled. RMSE compares light read from the volume with the light that fills it.
- "views", the first profile: pictures of balls at the probes, compared after tone mapping, see `wlm.probe.views`.

The largest error of a model is measured against a float64 decode of the same model. A decode on CUDA is timed as the
replay of a CUDA graph, so that gaps between launches do not count. `benchmarks.probe_table` has the rows of `--table`,
`benchmarks.probe_speed` those of `--speed`, and `benchmarks.probe_pictures` those of `--mesh`.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from benchmarks.plot import Panel
from benchmarks.probe_exact import decode64
from benchmarks.probe_pictures import picture_rows
from benchmarks.probe_speed import many_probes, speed_rows
from benchmarks.probe_table import RIVALS, nearest_probes, table_rows
from benchmarks.rivals.probe_torch import DenseFit
from benchmarks.rows import Row
from benchmarks.runner import Bench, Fit, Note, demo_data, exact_errors, expect_alone
from wlm.errors import WlmError
from wlm.formats.geometry import read_geometry
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet, from_arrays, load
from wlm.probe.evaluation import Report, between_psnr, by_distance, score
from wlm.probe.fit import compress
from wlm.probe.gaussian.decode import GaussianDecoder, Points
from wlm.probe.gaussian.trainer import CODE_BITS, FINAL_RATE
from wlm.probe.model import ProbeModel, Profile
from wlm.probe.views import VIEWS, score_views
from wlm.probe.volume.light import Light, StoredLight
from wlm.probe.volume.walk import score_volume

PROFILES = ("standard", "compact", "paper")
"""Profiles of a run; the rows of other methods measure the first."""

RATIOS = (0.02, 0.05, 0.10, 0.15, 0.20)
"""Gaussians as a share of the live probes, in a full run: the paper's tables 2 and 3."""

_EVERY = 5  # one in this many live probes is held out
_DEMO_KEYS = ("12.00", "21.00")  # noon and night
# A quick fit is worth this many steps of one probe, however many probes there are: some seconds on two CPU cores.
_QUICK_PROBE_STEPS = 600_000
_QUICK_FRAMES = 60
_DENSE_STEPS = 10  # steps of the fit in plain torch, where it is not run to its end

PANELS = (Panel("bpp", "psnr", ("ours", "pca", *RIVALS)), Panel("decode_ms", "max_error", ("decode",)))
"""The panels of a plot of the rows: quality against size, and the error of a decode against its time."""


def run(
    *,
    quick: bool = False,
    device: str = "cpu",
    probes_path: str | os.PathLike[str] | None = None,
    keys: Sequence[str] | None = None,
    volume_only: bool = False,
    speed: bool = False,
    many: int | None = None,
    lit_path: str | os.PathLike[str] | None = None,
    table: bool = False,
    only: Sequence[str] | None = None,
    nearest: Sequence[int] | None = None,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Measures the compression of the light probes of one file.

    Args:
        quick: Whether to make short fits at one compression ratio or size, and to measure the demo's probes at noon
            only: under two minutes on two CPU cores. The unfinished fits have large errors.
        device: "cpu" or "cuda:0", for fits, decodes and the volume.
        probes_path: A file that `wlm.probe.load` can read; None: the checkout's `demos/data/probes/street.npz`.
        keys: Names of arrays in the file, each one a set of probes; None: the only array, or the demo's noon and night.
        volume_only: Whether to measure only the volume, filled from the original probes and from principal components.
        speed: Whether to measure only the speed of the first profile, see `benchmarks.probe_speed`.
        many: The speed of a set of so many random probes, in place of those of the file; None: of the file's.
        lit_path: A mesh that the probes light: measure only fits to its pictures, see `benchmarks.probe_pictures`.
        table: Whether to measure only our methods and their rivals at equal bytes, see `benchmarks.probe_table`.
        only: Names of methods of the table; None: all. Rivals take minutes on the CPU and need no GPU.
        nearest: The table of only so many live probes around the middle of the set; None: of all probes.
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each row of `speed`, each fit to pictures and each size of the table.

    Returns:
        The rows of each set, in the order in which the module's docstring lists them.

    Raises:
        WlmError: The file, a key or the device does not exist, options contradict each other, or a fit diverged.
    """
    if volume_only:
        expect_alone("--volume-only", {"--quick": quick, "--table": table, "--speed": speed, "--mesh": lit_path})
    if not table and (only or nearest):
        raise WlmError("--only, --nearest: expected --table beside them")
    if many:
        expect_alone("--many", {"--table": table, "--probes": probes_path, "--key": keys})
        if not speed:
            raise WlmError("--many: expected --speed beside it")
    if speed:
        expect_alone("--speed", {"--table": table})
    if lit_path:
        expect_alone("--mesh", {"--speed": speed, "--table": table, "--many": many})
    if probes_path is None and not many:
        probes_path, keys = demo_data("probes/street.npz", "--probes FILE"), keys or _DEMO_KEYS[: 1 if quick else None]
    sets = [many_probes(many)] if many else [load(probes_path, key=key) for key in keys or (None,)]
    if volume_only:
        return [row for probes in sets for row in ProbeBench(probes, device, progress).volume()]
    profiles = [Profile.load(name) for name in PROFILES]
    if quick:
        steps = max(200, _QUICK_PROBE_STEPS // max(int(probes.live.sum()) for probes in sets))
        profiles = [profile.model_copy(update={"steps": min(steps, profile.steps)}) for profile in profiles]
    if speed:
        frames = _QUICK_FRAMES if quick else None
        return speed_rows(sets, profiles[0], device=device, frames=frames, progress=progress, done=done)
    if table:
        sets = [nearest_probes(probes, count) if count else probes for probes in sets for count in nearest or (None,)]
        shares = (5,) if quick else None
        return table_rows(sets, profiles[0], device=device, only=only, shares=shares, progress=progress, done=done)
    if lit_path:
        geometry = read_geometry(lit_path, with_uv=False)
        return picture_rows(sets, profiles[0], geometry, device=device, progress=progress, done=done)
    ratios, frames = ((), _QUICK_FRAMES) if quick else (RATIOS, None)
    return run_rows(sets, profiles, device=device, ratios=ratios, frames=frames, progress=progress)


def run_rows(
    sets: Sequence[ProbeSet],
    profiles: Sequence[Profile],
    *,
    device: str,
    ratios: Sequence[float],
    frames: int | None,
    repeats: int | None = None,
    progress: Note | None = None,
) -> list[Row]:
    """Measures given profiles on given sets of probes. Arguments that are not listed here are as for `run`.

    Args:
        sets: At least one set of probes.
        profiles: At least one profile; all rows except "ours" are measured with the first one.
        ratios: Further compression ratios for the first profile; its own ratio is not measured twice.
        frames: Frames of the walk through the volume, at least one; None: each moves the viewer by 1/10 block.
        repeats: As for `Bench`.
    """
    if not sets or not profiles:
        raise ValueError("expected at least one set and one profile")
    rows = []
    for probes in sets:
        bench = ProbeBench(probes, device, progress, repeats)
        first, *others = [bench.fit_profile(profile, profile.name) for profile in profiles]
        for ratio in ratios:
            if ratio != profiles[0].ratio:
                changed = profiles[0].model_copy(update={"ratio": ratio})
                others.append(bench.fit_profile(changed, f"ratio {ratio:.2f}"))
        peers = [bench.profile_row(fit) for fit in (first, *others)] + [bench.component_row()]
        rows += bench.time_rows(peers + bench.decode_rows(first))
        if probes is sets[0]:
            rows += bench.fit_rows(first)
        rows.append(bench.held_out_row(first))
        rows += volume_rows(bench, probes, {"ours": first.model}, frames)
        rows += view_rows(bench, probes, first.model, VIEWS if frames is None else min(frames, VIEWS))
    return rows


class ProbeBench(Bench):
    """The benchmark of one set of probes."""

    def __init__(self, probes: ProbeSet, device: str, progress: Note | None, repeats: int | None = None) -> None:
        key = probes.key.removeprefix("sh").removeprefix("_")
        super().__init__("probe", device, progress, scene=f"{probes.name} {key}".strip(), repeats=repeats)
        self.probes = probes
        self.position, self.values = probes.position[probes.live], probes.values[probes.live]

    def volume(self, frames: int | None = None) -> list[Row]:
        """Returns the rows of walks through volumes filled from the original probes and from principal components."""
        return volume_rows(self, self.probes, {"pca": compress(self.probes, "pca")}, frames)

    def fit_profile(self, profile: Profile, option: str) -> Fit:
        """Compresses the probes with a profile, writes the file and reads it back. Kernels are compiled beforehand."""
        self.note(f"{option}: fitting {len(self.position):,} probes, {profile.steps:,} steps")
        profile = profile.model_copy(update={"method": "gaussians"})
        compress(self.probes, profile.model_copy(update={"steps": 10}), device=self.device)
        return self.fit(option, lambda: compress(self.probes, profile, device=self.device))

    def profile_row(self, fit: Fit) -> tuple[Row, Callable[[], object]]:
        """Returns the row of a compressed model, and a call that decodes the model's probes, for the timing."""
        model, decoder = fit.model, GaussianDecoder(fit.model, self.device)
        points = decoder.points(self.position)
        report, errors = self._decode(decoder, points, decode64(model, self.position), fit.bytes)
        row = self.row(
            "ours",
            fit.option,
            f"time of all live probes, {self.mode}",
            encode_seconds=fit.seconds,
            steps=model.profile.steps,
            probes=report.live,
            gaussians=model.content.count,
            dropped=model.content.dropped,
            irradiance_psnr=report.irradiance_psnr,
            **_size_and_psnr(report, model.content.nbytes),
            **errors,
        )
        return row, self.replay(lambda: decoder.run(points))

    def component_row(self) -> tuple[Row, Callable[[], object]]:
        """Returns the row of principal components, and a call that decodes the probes, for the timing."""
        self.note("compressing to principal components")
        fit = self.fit("pca", lambda: compress(self.probes, "pca"))
        decoder = fit.model.decoder(self.device)
        report = score(decoder.decode_probes(), self.probes, fit.bytes)
        live = np.flatnonzero(self.probes.live).astype(np.int32)
        numbers = wp.array(live, dtype=int, device=self.device)
        values = wp.zeros((len(live), self.probes.outputs), dtype=float, device=self.device)
        row = self.row(
            "pca",
            f"{fit.model.content.count} components",
            f"time of all live probes, {self.mode}; made on the CPU",
            encode_seconds=fit.seconds,
            probes=report.live,
            irradiance_psnr=report.irradiance_psnr,
            **_size_and_psnr(report, fit.model.content.nbytes),
        )
        return row, self.replay(lambda: decoder.read(numbers, values))

    def held_out_row(self, fit: Fit) -> Row:
        """Returns the row with the error of predicted light at probes that were left out of the fit."""
        self.note(f"{fit.option}: fitting four fifths of the probes")
        live = np.flatnonzero(self.probes.live)
        out = np.arange(len(live)) % _EVERY == min(_EVERY, len(live)) - 1
        known, asked = live[~out], live[out]
        others = from_arrays(self.probes.position[known], self.probes.values[known], name=self.probes.name)
        fitted = compress(others, fit.model.profile, device=self.device)
        position, expected = self.probes.position[asked], self.probes.values[asked].astype(np.float64)
        light = {
            "psnr": fitted.decoder(self.device).decode(position),
            "nearest_psnr": by_distance(others, position, 1),
            "distance_psnr": by_distance(others, position, 8),
        }
        peak = float(np.ptp(self.values))
        decoder = fit.model.decoder(self.device, position=self.probes.position)
        return self.row(
            "held out",
            fit.option,
            "PSNR at every fifth probe of a file of the others; beside it that of the uncompressed others",
            disk_bytes=fitted.file_bytes(),
            probes=len(asked),
            half_way_psnr=between_psnr(decoder, self.probes),
            **{name: psnr_from_mse(float(np.square(each - expected).mean()), peak) for name, each in light.items()},
        )

    def decode_rows(self, fit: Fit) -> list[tuple[Row, Callable[[], object]]]:
        """Returns a row and a decoding call for Gaussians cut off at spheres, and for those cut off at ellipsoids."""
        model = fit.model
        spheres = self.fit_profile(model.profile.model_copy(update={"support": "sphere"}), "sphere").model
        exact, sphere_exact = decode64(model, self.position), decode64(spheres, self.position)
        ways = {
            "sphere": (GaussianDecoder(spheres, self.device), sphere_exact),
            "exact": (GaussianDecoder(model, self.device), exact),
        }
        return [self._way(fit, option, *way) for option, way in ways.items()]

    def _way(
        self, fit: Fit, option: str, decoder: GaussianDecoder, exact: np.ndarray
    ) -> tuple[Row, Callable[[], object]]:
        points = decoder.points(self.position)
        report, errors = self._decode(decoder, points, exact, fit.bytes)
        spheres = " with the spheres of eq. 6" if option == "sphere" else ""
        row = self.row(
            "decode",
            option,
            f"profile {fit.option}{spheres}; time of all live probes, {self.mode}",
            psnr=report.psnr,
            gaussians=decoder.model.content.count,
            list_entries=decoder.pairs,
            **errors,
        )
        return row, self.replay(lambda: decoder.run(points))

    def fit_rows(self, fit: Fit) -> list[Row]:
        """Returns one row with the speed of the fit, and one with the speed of the same fit in plain torch."""
        p, model = fit.model.profile, fit.model
        step_ms = 1e3 * fit.fit_seconds / p.steps
        option = f"{fit.option} {p.steps:,} steps"
        counts = {
            "steps": p.steps,
            "probes": len(self.position),
            "gaussians": model.content.count + model.content.dropped,
        }
        ours = self.row(
            "fit", option, "with the first places", encode_seconds=fit.fit_seconds, step_ms=step_ms, **counts
        )
        self.note(f"{fit.option}: fitting in plain torch")
        peer = DenseFit(
            model.normalise(self.position),
            self.values,
            count=counts["gaussians"],
            latent=p.latent,
            hidden=p.hidden,
            steps=p.steps,
            rates=(p.centre_rate, p.scale_rate, p.rotation_rate, p.latent_rate, p.net_rate),
            final=FINAL_RATE,
            bits=CODE_BITS,
            seed=0,
            device=self.device,
        )
        peer.step()  # loads what torch loads late
        whole = self.device != "cpu"
        steps = p.steps - 1 if whole else min(p.steps, _DENSE_STEPS)
        peer.run(steps)
        seconds = peer.seconds / steps
        scaled = "" if whole else f"; time of {steps} steps scaled to {p.steps:,}"
        dense = self.row(
            "dense torch",
            option,
            f"every Gaussian at every probe, no file{scaled}",
            encode_seconds=seconds * p.steps,
            step_ms=1e3 * seconds,
            times_ours=1e3 * seconds / step_ms,
            psnr=score(self._all(peer.decoded()), self.probes, fit.bytes).psnr if whole else None,
            **counts,
        )
        return [ours, dense]

    def _decode(
        self, decoder: GaussianDecoder, points: Points, exact: np.ndarray, size: int
    ) -> tuple[Report, dict[str, float]]:
        """Decodes the probes. Returns PSNR and other scores, and the errors against `exact`, a float64 decode."""
        decoder.run(points)
        values = points.values()
        return score(self._all(values), self.probes, size), exact_errors(values, exact)

    def _all(self, live: np.ndarray) -> np.ndarray:
        """Returns values of all probes, given the live probes' values [live, numbers]; dead probes get zeros."""
        values = np.zeros_like(self.probes.values)
        values[self.probes.live] = live
        return values


def _size_and_psnr(report: Report, gpu_bytes: int) -> dict[str, float]:
    """Returns the size on a GPU, the size on disk and the PSNR as figures of a row."""
    sizes = {"bytes": gpu_bytes, "bpp": 8 * gpu_bytes / report.probes, "disk_bytes": report.bytes}
    return sizes | {"share_of_float32": gpu_bytes / (4 * report.probes * report.outputs), "psnr": report.psnr}


def volume_rows(bench: Bench, probes: ProbeSet, models: Mapping[str, ProbeModel], frames: int | None) -> list[Row]:
    """Measures a viewer's walks through a volume filled from the original probes, and through one for each model.

    Args:
        bench: Benchmark of the set, on the device of the volume.
        probes: The original probes.
        models: Compressed models, by the names that the results table prints.
        frames: Frames of a walk, at least one; None: each frame moves the viewer by a tenth of a block.
    """
    rows = []
    lights: dict[str, Light] = {"lossless": StoredLight(probes.values, bench.device)}
    for name, model in models.items():
        lights[name] = model.decoder(bench.device).light(probes.position)
    for name, light in lights.items():
        bench.note(f"walking through the volume: {name}")
        walked = score_volume(probes, light, frames=frames)
        spread = {"update_ms": walked["update_ms"], "blocks": walked["updated"], "probes_decoded": walked["probes"]}
        rows.append(
            bench.row(
                "volume",
                f"{name}, walk of {walked['frames']} frames",
                f"the finest blocks are {walked['block']:.3g} units wide",
                frames=walked["frames"],
                first_ms=walked["first_ms"],
                frames_first=walked["first_frames"],
                memory=walked["memory_bytes"] / 2**20,
                psnr=walked["psnr"],
                light_psnr=walked["light_psnr"],
                far_psnr=walked["far_psnr"],
                **_light(walked),
                **{key: value["mean"] for key, value in spread.items()},
                **{f"{key}_p95": value["p95"] for key, value in spread.items()},
            )
        )
    return rows


def view_rows(bench: Bench, probes: ProbeSet, model: ProbeModel, views: int) -> list[Row]:
    """Compares pictures of balls lit by a model with pictures lit by the original probes, for each kind of light.

    Args:
        bench: Benchmark of the set, on the device of the decode.
        probes: The original probes.
        model: The compressed probes.
        views: Number of pictures, at least one.
    """
    bench.note(f"rendering {views} views of balls")
    decoded = model.decoder(bench.device, position=probes.position).decode_probes()
    try:
        scores = score_views(probes, decoded, views=views, device=bench.device)
    except WlmError as error:  # no spherical harmonics
        return [bench.missing_row("views", "balls", error)]
    return [
        bench.row(
            "views",
            f"{score.drawn}, {score.light}",
            f"{score.views} views under the original probes and under these",
            psnr=score.psnr,
            ssim=score.ssim,
            flip=score.flip,
        )
        for score in scores
    ]


def _light(figures: dict[str, Any]) -> dict[str, float | None]:
    """Returns the covered share, RMSE and RMS of light read during a walk; None if no probe was near the viewer."""
    names = {"coverage": "coverage", "light_rmse": "rmse", "light": "rms"}
    return {name: figures[key]["mean"] if figures[key] else None for name, key in names.items()}
