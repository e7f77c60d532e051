"""The atlas system against smaller lightmaps, block codecs and single-colour merging: size, speed and error.

For each lightmap of each mesh these kinds of rows:

- method "ours", a profile each: the file, the compression with the writing, the error as the mesh is seen from around,
  and the time to read a million random points of its surface. In a full run also the first profile at the bits that
  the paper's method came to.
- method "lightmap": the time to read the same points from the lightmap itself, in half floats.
- the rivals of ``wlm.baselines.atlas`` at the bits of the first profile; in a full run also at those of the others.
  Bits are those of eq. 9 of lightmap-uv-clustering-cascade, which leave out UVs and headers; a rival's bytes are these
  bits alone, it has no file.
- method "fit", of the first lightmap alone: the cascade tuned in views, as the paper does it, and at points of the
  surface; the time is that of the tuning alone.

Where there are several lightmaps the last rows are the means over them; their largest error is the largest of all.

A largest error is that against the float64 decode of the same model. A decode on CUDA is timed as the replay of a
graph, so that gaps between launches do not count. The peaks of PSNR are those of ``wlm.atlas.evaluation``.
"""

import math
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean

import numpy as np
import torch
import warp as wp

from wlm import interop, system
from wlm.atlas.data import from_arrays
from wlm.atlas.decode import Decoder
from wlm.atlas.evaluation import Sampler, Score, compare
from wlm.atlas.exact import decode64
from wlm.atlas.fit import compress
from wlm.atlas.model import SOURCE_BITS, AtlasModel, Profile
from wlm.atlas.views import surface_points
from wlm.baselines.atlas import ATLAS_BASELINES
from wlm.bench.atlas_inputs import Lightmap
from wlm.bench.plot import Panel
from wlm.bench.runner import Row, read_json, run_peers
from wlm.errors import WlmError
from wlm.texels import fill_gaps

__all__ = ["PANELS", "PROFILES", "plotted", "run", "run_rivals", "run_rows"]

PROFILES = ("standard", "bc6h", "astc", "compact", "cascade", "paper")
"""Profiles of a run; the first has the bits of the first cascade too."""

_RIVALS = {
    "downsampling": "downsampling",
    "downsampling bilinear": "downsampling bilinear",
    "BC6H": "bc6h",
    "ASTC": "astc",
    "single colour": "single colour",
}
_HELD_TO = ("standard", "astc", "compact")  # profiles whose bits rivals get when they run alone
_FIRST = "downsampling"  # what everything is held against
_VIEWS, _RESOLUTION = 50, 512  # section 4.1.4; the paper doesn't say at which resolution it scores
_QUICK_VIEWS, _QUICK_RESOLUTION = 8, 256
_QUICK_CASCADE = {"steps": 30, "resolution": 256}
_POINTS = 1_000_000
_CHECKED = 1 << 17  # of them, against float64
_SAME = 0.01  # shares of bits that differ by less are one
_MEAN = "mean over"

PANELS = (Panel("bpp", "psnr", ("ours", _FIRST, "BC6H", "ASTC")), Panel("decode_ms", "max_error", ("ours", "lightmap")))
"""What a plot of the rows shows: quality against size, of all but the weakest rivals, whose names would hide the rest;
and what is wrong with a decode against its time."""

Note = Callable[[str], None]


def run(
    lightmaps: Sequence[Lightmap],
    names: Sequence[str] = (),
    *,
    quick: bool,
    device: str,
    rivals: bool = True,
    progress: Note | None = None,
) -> list[Row]:
    """Measures the atlas system.

    Args:
        lightmaps: At least one, as ``wlm.bench.atlas_inputs.load`` reads them.
        names: Profiles; none: ``PROFILES``.
        quick: 8 small views instead of 50, the cascade tuned for a few steps, rivals at one size: under 90 seconds on
            two CPU cores with the demo's mesh. The cascade's error is that of an unfinished fit.
        device: "cpu" or "cuda:0", for compressions, views and decodes; the rivals are compressed on the CPU.
        rivals: With the block codecs and single-colour merging, which take minutes on the CPU: ``run_rivals`` has them
            alone. Downsampling is always there.
        progress: Called with a line before each part of the work.

    Returns:
        The rows, lightmap by lightmap in the order of the module's list.

    Raises:
        WlmError: A profile or the device isn't there, or a compression failed.
    """
    profiles = [Profile.load(name) for name in names or PROFILES]
    if quick:
        profiles = [p.model_copy(update=_QUICK_CASCADE) if p.method == "cascade" else p for p in profiles]
    return run_rows(
        lightmaps,
        profiles,
        device=interop.check_device(device),
        views=_QUICK_VIEWS if quick else _VIEWS,
        resolution=_QUICK_RESOLUTION if quick else _RESOLUTION,
        whole=not quick,
        methods=tuple(_RIVALS) if rivals else (_FIRST,),
        progress=progress,
    )


def run_rivals(
    results: str | os.PathLike[str], lightmaps: Sequence[Lightmap], *, progress: Note | None = None
) -> list[Row]:
    """Measures the rivals alone, at the bits that our tiles took in a former run.

    Args:
        results: What that run wrote.
        lightmaps: At least one; those of that run.
        progress: As for ``run``.

    Returns:
        The rows of the rivals, of the CPU, and their means.

    Raises:
        WlmError: ``results`` can't be read, or has no row of a lightmap.
    """
    ours = [row for row in read_json(results)[0] if (row.system, row.method) == ("atlas", "ours")]
    scored: list[_Entry] = []
    for lightmap in lightmaps:
        rows = [row for row in ours if row.scene == lightmap.scene and row.bpp and row.option in _HELD_TO]
        if not rows:
            raise WlmError(f"{results}: expected a row of method ours of {lightmap.scene}")
        bench = _Bench(lightmap, "cpu", 1, progress or (lambda line: None))
        shares = [(row.option, row.bpp / SOURCE_BITS) for row in rows]
        scored += bench.scored(bench.rivals(shares, tuple(_RIVALS)), _VIEWS, _RESOLUTION)
    return [one.row for one in scored] + (_means(scored, len(lightmaps)) if len(lightmaps) > 1 else [])


def run_rows(
    lightmaps: Sequence[Lightmap],
    profiles: Sequence[Profile],
    *,
    device: str,
    views: int,
    resolution: int,
    whole: bool,
    methods: Sequence[str] = tuple(_RIVALS),
    points: int = _POINTS,
    repeats: int | None = None,
    progress: Note | None = None,
) -> list[Row]:
    """Measures given profiles on given lightmaps.

    Args:
        lightmaps: At least one.
        profiles: At least one; the rivals have the bits of the first.
        device: "cpu" or "cuda:0".
        views: Cameras of the scores.
        resolution: Their pixels along a side.
        whole: With the first profile at the bits of a cascade, and rivals at the bits of all profiles.
        methods: The rivals.
        points: Read by a timed decode.
        repeats: Samples of each decode time; None: 30 on CUDA, 5 on the CPU.
        progress: As for ``run``.

    Returns:
        The rows.

    Raises:
        WlmError: As ``run``.
        ValueError: No lightmap or no profile.
    """
    if not lightmaps or not profiles:
        raise ValueError("expected at least one lightmap and one profile")
    device = interop.check_device(device)
    note = progress or (lambda line: None)
    note("compiling")
    for profile in profiles:
        _warm_up(profile, device)
    few = device == "cpu"
    scored: list[_Entry] = []
    for lightmap in lightmaps:
        bench = _Bench(lightmap, device, points, note)
        entries = bench.ours(profiles, whole)
        if lightmap is lightmaps[0]:
            entries += bench.tuned(entries)
        bench.note("timing the decoders, in turns")
        peers = [entry for entry in (*entries, bench.original(entries[0].model)) if entry.decode is not None]
        timed = run_peers(
            [(entry.row, entry.decode) for entry in peers],
            device,
            warmup=1 if few else 5,
            repeats=repeats if repeats is not None else 5 if few else 30,
        )
        rows = dict(zip((id(entry) for entry in peers), timed, strict=True))
        entries = [replace(entry, row=rows.get(id(entry), entry.row)) for entry in (*entries, *peers[-1:])]
        shares = [
            (entry.row.option, entry.share)
            for entry in entries
            if entry.model is not None and entry.row.option == entry.model.profile.name
        ]
        entries += bench.rivals(shares if whole else shares[:1], methods)
        scored += bench.scored(entries, views, resolution)
    return [one.row for one in scored] + (_means(scored, len(lightmaps)) if len(lightmaps) > 1 else [])


def plotted(rows: Sequence[Row]) -> list[Row]:
    """The rows that a plot shows: the means, or all where there are none."""
    return [row for row in rows if row.scene.startswith(_MEAN)] or list(rows)


@dataclass(frozen=True, eq=False)
class _Entry:
    """What a lightmap is measured with.

    Attributes:
        row: Without score, and before the timing without a decode time.
        share: Bits of eq. 9 over the lightmap's.
        sample: The decoder to score; None: none.
        decode: The decoder to time; None: none.
        model: Ours.
        report: The score; None: none, or not yet.
        full_size: Whether a rival has as many texels as the lightmap.
    """

    row: Row
    share: float
    sample: Sampler | None = None
    decode: Callable[[], object] | None = None
    model: AtlasModel | None = None
    report: Score | None = None
    full_size: bool = False


class _Bench:
    """A lightmap, and where it is compressed and decoded."""

    def __init__(self, lightmap: Lightmap, device: str, points: int, note: Note):
        self.mesh, self.scene, self.device = lightmap.mesh, lightmap.scene, device
        self.note: Note = lambda line: note(f"{self.scene}: {line}")
        self.triangle, self.weight = surface_points(self.mesh, points, np.random.default_rng(0))

    def ours(self, profiles: Sequence[Profile], whole: bool) -> list[_Entry]:
        """Our profiles, and the first of them at the bits of the first cascade."""
        entries = [self.fit(profile, profile.name) for profile in profiles]
        cascade = next((entry for entry in entries if entry.model.profile.method == "cascade"), None)
        if whole and cascade is not None and profiles[0].method == "tiles":
            option = f"{profiles[0].name}, bits of {cascade.row.option}"
            try:
                entries.append(self.fit(profiles[0].model_copy(update={"budget": cascade.share}), option))
            except WlmError as error:  # no room for a table
                entries.append(_Entry(self._row("ours", option, notes=f"not measured: {error}"), cascade.share))
        return entries

    def fit(self, profile: Profile, option: str) -> _Entry:
        """Compresses and writes, and reads the file back."""
        self.note(f"{option}: compressing")
        start = time.perf_counter()
        model = compress(self.mesh, profile, device=self.device)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "atlas.wlm"
            size = model.save(path)
            seconds = time.perf_counter() - start
            # The file leaves the stages' times out.
            model = replace(system.load(path, "atlas"), report=model.report)
        decode, error, usual = self._decode(model)
        share = 1.0 - model.compression_ratio
        stages = ", ".join(f"{name} {value:.2g}" for name, value in model.report["seconds"].items())
        notes = f"CR {100 * model.compression_ratio:.1f}%; {_kind(model)}; {usual}; s: {stages}"
        figures = {"bytes": size, "bpp": SOURCE_BITS * share, "encode_seconds": seconds, "max_error": error}
        row = self._row("ours", option, **figures, notes=notes)
        return _Entry(row, share, Decoder(model, self.device), decode, model)

    def tuned(self, entries: Sequence[_Entry]) -> list[_Entry]:
        """A cascade tuned in either space."""
        own = next((entry for entry in entries if entry.model and "fit" in entry.model.report["seconds"]), None)
        if own is None:
            return []
        # A cascade that doesn't pay is scored as the cascade that it is, here.
        alone = own.model.profile.model_copy(update={"fallback": False})
        spaces = (alone.space, "uv" if alone.space == "views" else "views")
        fits = [self.fit(alone.model_copy(update={"space": space}), f"{own.row.option}, {space}") for space in spaces]
        return [self._tuned(entry) for entry in fits]

    def _tuned(self, entry: _Entry) -> _Entry:
        p, seconds = entry.model.profile, entry.model.report["seconds"]["fit"]
        row = self._row(
            "fit",
            f"{p.name}, space {p.space}",
            encode_seconds=seconds,
            notes=f"{p.steps:,} steps at {p.resolution}²: {1e3 * seconds / max(p.steps, 1):.3g} ms a step; the tuning "
            "alone",
        )
        return _Entry(row, entry.share, entry.sample)

    def original(self, model: AtlasModel) -> _Entry:
        """The lightmap itself, in the place of a model of it."""
        model = replace(
            model,
            method="plain",
            colour="half",
            texels=fill_gaps(self.mesh.lightmap, self.mesh.mask).astype(np.float16),
            blocks=np.empty((0, 16), np.uint8),
            lut=np.empty((0, 0, 2), np.uint16),
            uv=np.empty((0, 3, 2), np.float32),
        )
        decode, error, _ = self._decode(model)
        figures = {"bytes": model.texels.nbytes, "bpp": SOURCE_BITS, "max_error": error}
        return _Entry(self._row("lightmap", "half floats", **figures, notes="as it is"), 1.0, decode=decode)

    def rivals(self, shares: Sequence[tuple[str, float]], methods: Sequence[str]) -> list[_Entry]:
        """The rivals at the bits of our profiles.

        One that holds the whole lightmap in fewer bits isn't measured twice.

        Args:
            shares: Names of profiles, and their bits over the lightmap's.
            methods: The rivals.
        """
        result, done, enough = [], [], {}
        for name, share in shares:
            if any(abs(share / other - 1.0) < _SAME for other in done):
                continue
            done.append(share)
            for method in methods:
                if enough.get(method, math.inf) > share:
                    self.note(f"{method}, bits of {name}")
                    result.append(self._rival(method, f"bits of {name}", share))
                    # ASTC has other blocks for other budgets.
                    if result[-1].full_size and method != "ASTC":
                        enough[method] = result[-1].share
        return result

    def _rival(self, method: str, option: str, share: float) -> _Entry:
        try:
            rival = ATLAS_BASELINES[_RIVALS[method]](self.mesh, share)
        except (WlmError, ValueError) as error:  # a package is missing, or nothing fits
            return _Entry(self._row(method, option, notes=f"not measured: {error}"), share)
        size = "" if rival.size is None else f"; {rival.size[1]}x{rival.size[0]} texels"
        row = self._row(
            method,
            option,
            bytes=math.ceil(int(rival.bits) / 8),
            bpp=SOURCE_BITS * rival.share,
            encode_seconds=rival.seconds,
            notes=f"CR {100 * (1.0 - rival.share):.1f}%{size}; compressed on the CPU, no file",
        )
        return _Entry(row, rival.share, rival.sample, full_size=rival.size == self.mesh.mask.shape)

    def scored(self, entries: Sequence[_Entry], views: int, resolution: int) -> list[_Entry]:
        """Scores all in one go: each view is drawn once."""
        self.note(f"scoring, {views} views of {resolution}²")
        decoders = {str(i): entry.sample for i, entry in enumerate(entries) if entry.sample is not None}
        reports = compare(self.mesh, decoders, views=views, resolution=resolution, device=self.device)
        result = []
        for i, entry in enumerate(entries):
            report, row = reports.get(str(i)), entry.row
            if report is not None:
                psnr, ssim = _known(report.psnr), _known(1.0 - report.one_minus_ssim)
                row = replace(row, psnr=psnr, ssim=ssim, notes=f"{_scores(report)}; {row.notes}")
            # The decoders are done with, and hold memory of the device.
            result.append(_Entry(row, entry.share, report=report))
        return result

    def _decode(self, model: AtlasModel) -> tuple[Callable[[], object], float, str]:
        """What is timed, the largest error against float64, and where nearly all errors lie.

        A point that rounding puts into the neighbouring tile has an error far beyond all others.
        """
        decoder = Decoder(model, self.device)
        corner = model.uv if len(model.uv) else self.mesh.uv[self.mesh.triangle]
        uv = np.einsum("nk,nkc->nc", self.weight, corner[self.triangle]).astype(np.float32)
        own = torch.from_numpy(uv).to(self.device)
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=self.device)
        places = interop.to_warp(own, wp.vec2)
        decoder.run(places, out)
        wp.synchronize_device(self.device)
        error = np.abs(out[:_CHECKED].cpu().numpy() - decode64(model, uv[:_CHECKED])).max(1)
        usual = f"99.9% of points within {np.percentile(error, 99.9):.2g} of float64"
        return interop.StepGraph(lambda: decoder.run(places, out), self.device, warmup=1), float(error.max()), usual

    def _row(self, method: str, option: str, **values) -> Row:
        return Row("atlas", self.scene, method, option, **values)


def _means(scored: Sequence[_Entry], lightmaps: int) -> list[Row]:
    """A row for each method and option that was measured more than once."""
    groups: dict[tuple[str, str], list[_Entry]] = {}
    for one in scored:
        if not one.row.notes.startswith("not measured"):
            groups.setdefault((one.row.method, one.row.option), []).append(one)
    rows = []
    for (method, option), group in groups.items():
        if method == "fit" or len(group) < 2:
            continue

        def mean(name: str, group=group) -> float | None:
            values = [value for one in group if (value := getattr(one.row, name)) is not None]
            return fmean(values) if values else None

        size, error = mean("bytes"), [one.row.max_error for one in group if one.row.max_error is not None]
        notes = f"{len(group)} lightmaps; CR {100 * (1.0 - fmean(one.share for one in group)):.1f}%"
        reports = [one.report for one in group if one.report is not None]
        for title, values in (
            ("PSNR", [report.psnr for report in reports]),
            ("1-SSIM", [report.one_minus_ssim for report in reports]),
            ("seam ratio", [report.seam_ratio for report in reports]),
        ):
            finite = [value for value in values if math.isfinite(value)]
            if finite:
                notes += f"; {title} {min(finite):.4g} to {max(finite):.4g}, mean {fmean(finite):.4g}"
        rows.append(
            Row(
                "atlas",
                f"{_MEAN} {lightmaps} lightmaps",
                method,
                option,
                bytes=None if size is None else round(size),
                max_error=max(error, default=None),
                notes=notes,
                **{name: mean(name) for name in ("bpp", "encode_seconds", "decode_ms", "psnr", "ssim")},
            )
        )
    return rows


def _warm_up(profile: Profile, device: str) -> None:
    """Compiles what a compression and a decode need, on a square of 32 texels a side."""
    side = np.linspace(0.1, 1.0, 32)
    image = np.stack([np.outer(side, side), np.outer(side, side[::-1]), np.outer(side, side) ** 2], -1)
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    mesh = from_arrays(np.insert(uv, 2, 0.0, 1), np.array([[0, 1, 2], [2, 1, 3]]), uv, image, name="square")
    small = {"views": 1, "steps": min(profile.steps, 4), "resolution": 64, "budget": 1.0}
    model = compress(mesh, profile.model_copy(update=small), device=device)
    Decoder(model, device).lightmap(mesh)


def _kind(model: AtlasModel) -> str:
    steps = f" of {model.profile.steps:,} steps" if model.profile.method == "cascade" else ""
    lut = f", T_c {model.lut.shape[1]}x{model.lut.shape[0]}" if model.lut.size else ""
    return f"{model.method}{steps}, T_p {model.texels.shape[1]}x{model.texels.shape[0]}{lut}"


def _scores(report: Score) -> str:
    """What a row has no column for. SSIM's four figures say little where 1 - SSIM is what methods differ by."""
    figures = (
        ("1-SSIM", report.one_minus_ssim, ".2g", ""),
        ("worst view", report.psnr_worst, ".2f", " dB"),
        ("seam ratio", report.seam_ratio, ".2f", ""),
        ("texels", report.texel_psnr, ".2f", " dB"),
    )
    known = [f"{name} {value:{form}}{unit}" for name, value, form, unit in figures if math.isfinite(value)]
    return ", ".join(known) or "no range to measure against"


def _known(value: float) -> float | None:
    """JSON has no infinity: a lightmap without a range has no PSNR, and one decoded exactly none either."""
    return value if math.isfinite(value) else None
