"""Lightmaps compressed by `wlm.atlas`, against smaller lightmaps and block codecs: size, speed and error.

For each lightmap of each mesh the results table has these kinds of rows:

- method "ours", one row for each profile, a set of options: size of the file, time to compress and write it, error in
  views from all around the mesh, and time to read a million random points of its surface. A full run also measures the
  first profile at compression ratios (CR) of 92.5% and 95%, and in as many bits as the first profile takes that
  compresses by a cascade.
- method "lightmap": the time to read the same points from the lightmap itself, in half floats.
- the rivals of `benchmarks.rivals.atlas` in as many bits as the first profile takes; in a full run also in as many as
  every other profile takes. Bits are counted by eq. 9 of lightmap-uv-clustering-cascade, which leaves out UVs and
  headers. A rival has no file, so its size in bytes is that number of bits.
- method "fit", for the first lightmap alone: the textures of the cascade fitted in rendered views, as in the paper, and
  fitted in UV space; the time is that of this fit alone.

If there are several lightmaps, the last rows are means over all of them, with the minimum and maximum of some figures;
the largest error of such a row is the maximum over the lightmaps.

The largest error of a model is measured against a float64 decode of the same model. A decode on CUDA is timed as the
replay of a CUDA graph, so that gaps between launches do not count. `wlm.atlas.evaluation` states the peaks of PSNR.
"""

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
import warp as wp

from benchmarks.atlas_exact import decode64
from benchmarks.plot import Panel
from benchmarks.rivals.atlas import RIVALS, share_of
from benchmarks.rivals.rival import Rival
from benchmarks.rows import MEAN, Row
from benchmarks.runner import Bench, Note, demo_data, exact_errors
from wlm import interop
from wlm.atlas.codec import sizes
from wlm.atlas.data import LightmappedScene, Sheet, from_arrays
from wlm.atlas.data import load as load_scene
from wlm.atlas.decode import Decoder
from wlm.atlas.evaluation import Sampler, compare
from wlm.atlas.fit import compress
from wlm.atlas.model import SOURCE_BITS, AtlasModel, Profile
from wlm.errors import WlmError

PROFILES = ("standard", "astc", "cascade", "paper")
"""Profiles of a run. A full run also measures the first one in as many bits as "cascade" takes."""

_RIVALS = {
    "downsampling": "downsampling",
    "downsampling bilinear": "downsampling bilinear",
    "BC6H": "bc6h",
    "BC6H, our encoder": "bc6h own",
    "ASTC": "astc",
}
_METHODS = tuple(_RIVALS)
_SMALLER = (0.925, 0.95)  # CRs that the first profile is measured at too
_FIRST = "downsampling"  # the rival of every run
VIEWS, RESOLUTION = 50, 512  # section 4.1.4; the paper doesn't say at which resolution it scores
QUICK_VIEWS, QUICK_RESOLUTION = 8, 256
_QUICK_CASCADE = {"steps": 30, "resolution": 256}
_POINTS = 1_000_000
_CHECKED = 1 << 17  # points that are compared with float64
_SAME = 0.01  # shares of bits that differ by less are equal
SCORES = ("psnr", "psnr_worst", "texel_psnr", "tone_psnr", "one_minus_ssim", "flip", "seam_ratio")
"""Figures of a row that are copied from a `Score`, by name."""

# Figures whose least and most are stated too.
_RANGED = ("psnr", "texel_psnr", "tone_psnr", "one_minus_ssim", "flip", "seam_ratio")
_AVERAGED = ("bytes", "bpp", "compression_ratio", "encode_seconds", "decode_ms", *_RANGED)

PANELS = (Panel("bpp", "psnr", ("ours", _FIRST, "BC6H", "ASTC")), Panel("decode_ms", "max_error", ("ours", "lightmap")))
"""The panels of a plot of the rows: quality against size, without the weakest rivals, whose names would hide the rest;
and a decode's error against its time."""


@dataclass(frozen=True, eq=False)
class Lightmap:
    """A lightmap of a mesh.

    Attributes:
        scene: Name of the scene, as the results table prints it.
        lit: The mesh and the lightmap.
    """

    scene: str
    lit: LightmappedScene


def run(
    *,
    quick: bool,
    device: str,
    profiles: Sequence[str] | None = None,
    rivals: bool = True,
    progress: Note | None = None,
    **paths: Any,
) -> list[Row]:
    """Measures lightmaps compressed by `wlm.atlas` and by rivals.

    Args:
        quick: Whether to render 8 small views instead of 50, fit the cascade in a few steps and measure rivals at one
            size: under 90 seconds on two CPU cores with the demo's mesh. The unfinished cascade has a large error.
        device: "cpu" or "cuda:0", for compressions, views and decodes; the rivals are compressed on the CPU.
        profiles: Names or YAML files of profiles; None: `PROFILES`.
        rivals: Whether to measure block codecs, which take minutes on the CPU. Downsampling is always measured.
        progress: Called with a line before each part of the work.
        paths: The arguments of `read_lightmaps`.

    Returns:
        The rows of each lightmap, in the order in which the module's docstring lists them, then their means.

    Raises:
        WlmError: A file, a profile or the device does not exist, paths were given that don't go together, or a
            compression failed.
    """
    device = interop.check_device(device)
    loaded = [Profile.load(name) for name in profiles or PROFILES]
    lightmaps = read_lightmaps(**paths)
    if quick:
        loaded = [each.model_copy(update=_QUICK_CASCADE) if each.method == "cascade" else each for each in loaded]
    return run_rows(
        lightmaps,
        loaded,
        device=device,
        views=QUICK_VIEWS if quick else VIEWS,
        resolution=QUICK_RESOLUTION if quick else RESOLUTION,
        whole=not quick,
        methods=_METHODS if rivals else (_FIRST,),
        progress=progress,
    )


def read_lightmaps(
    meshes_path: str | os.PathLike[str] | None = None,
    mesh_path: str | os.PathLike[str] | None = None,
    lightmap_paths: Sequence[str | os.PathLike[str]] | None = None,
    mask_path: str | os.PathLike[str] | None = None,
) -> list[Lightmap]:
    """Reads the lightmaps to measure, with their meshes.

    Args:
        meshes_path: The folder of one mesh, or a folder of such folders. The folder of a mesh has one `.glb` file,
            its lightmaps as `.exr` files, and optionally their mask, `mask.png`.
        mesh_path: One mesh file, instead of `meshes_path`.
        lightmap_paths: The lightmaps of the mesh file.
        mask_path: The mask of these lightmaps; None derives it from the mesh.

    Returns:
        The lightmaps; if no path is given, the lightmaps in `demos/data/atlas` of the checkout.

    Raises:
        WlmError: A file is missing or damaged, a folder has no mesh with a lightmap, or paths were given that don't go
            together.
    """
    if mesh_path is not None:
        if meshes_path is not None or not lightmap_paths:
            raise WlmError("expected --mesh FILE with --lightmap FILE, or only --meshes DIR")
        return _lightmaps(Path(mesh_path), [Path(path) for path in lightmap_paths], mask_path)
    if lightmap_paths or mask_path is not None:
        raise WlmError("--lightmap and --mask need --mesh FILE")
    folder = demo_data("atlas", "--meshes DIR") if meshes_path is None else Path(meshes_path)
    if not folder.is_dir():
        raise WlmError(f"{folder}: no such folder; expected a folder of meshes with their lightmaps")
    lightmaps = []
    for each in (folder, *sorted(path for path in folder.iterdir() if path.is_dir())):
        meshes, images = sorted(each.glob("*.glb")), sorted(each.glob("*.exr"))
        if len(meshes) > 1:
            raise WlmError(f"{each}: expected one .glb file in the folder, found {len(meshes)}")
        if meshes and images:
            mask = each / "mask.png"
            lightmaps += _lightmaps(meshes[0], images, mask if mask.is_file() else None)
    if not lightmaps:
        raise WlmError(f"{folder}: expected a .glb file and its .exr lightmaps, there or one folder below, found none")
    return lightmaps


def _lightmaps(mesh: Path, lightmaps: Sequence[Path], mask: str | os.PathLike[str] | None) -> list[Lightmap]:
    name = mesh.resolve().parent.name if mesh.stem == "mesh" else mesh.stem
    scenes = [name if path.stem == name else f"{name} {path.stem}" for path in lightmaps]
    meshes = (load_scene(mesh, path, mask_path=mask) for path in lightmaps)
    return [Lightmap(*pair) for pair in zip(scenes, meshes, strict=True)]


def run_rows(
    lightmaps: Sequence[Lightmap],
    profiles: Sequence[Profile],
    *,
    device: str,
    views: int,
    resolution: int,
    whole: bool,
    methods: Sequence[str] = _METHODS,
    points: int = _POINTS,
    repeats: int | None = None,
    progress: Note | None = None,
) -> list[Row]:
    """Measures lightmaps with the given profiles. Arguments that are not listed here are as for `run`.

    Args:
        lightmaps: At least one lightmap.
        profiles: At least one profile; the rivals get as many bits as the model of the first profile takes.
        views, resolution: Number of cameras for the error, and pixels along a side of their pictures.
        whole: Whether to measure the first profile also in as many bits as a cascade takes and at the compression
            ratios `_SMALLER`, and the rivals at the sizes of all profiles.
        methods: Names of the rivals.
        points: Number of surface points that a timed decode reads.
        repeats: As for `Bench`.
    """
    if not lightmaps or not profiles:
        raise ValueError("expected at least one lightmap and one profile")
    (progress or (lambda line: None))("compiling kernels")
    for profile in profiles:
        warm_up(profile, device)
    rows: list[Row] = []
    for lightmap in lightmaps:
        bench = _AtlasBench(lightmap, device, progress, points, repeats)
        entries = bench.ours(profiles, whole)
        named = {profile.name for profile in profiles} | {_smaller_name(profiles[0], cr) for cr in _SMALLER}
        shares = {entry.row.option: _share(entry.row) for entry in entries if entry.model and entry.row.option in named}
        if lightmap is lightmaps[0]:
            entries += bench.tuned(entries)
        entries.append(bench.original(entries[0].model))
        entries = bench.timed(entries)
        entries += bench.rivals(shares if whole else {profiles[0].name: shares[profiles[0].name]}, methods)
        rows += bench.scored(entries, views, resolution)
    return rows + means(rows, len(lightmaps))


def plotted(rows: Sequence[Row]) -> list[Row]:
    """Returns the rows that a plot shows: the means, or all rows if there are no means."""
    return [row for row in rows if row.scene.startswith(MEAN)] or list(rows)


def _smaller_name(profile: Profile, cr: float) -> str:
    return f"{profile.name}, CR {100 * cr:g}%"


def _share(row: Row) -> float:
    """Returns the compressed size as a fraction of the lightmap's bits; both are counted by the paper's eq. 9."""
    return row["bpp"] / SOURCE_BITS


@dataclass(frozen=True, eq=False)
class _Entry:
    """A row of the results table while it is being measured.

    Attributes:
        row: The row so far: its errors are added later, and its decode time after the timing.
        sample: Decoder whose errors are measured; None if no error is measured.
        decode: Decoder whose time is measured; None if no time is measured.
        model: The compressed model if the method is ours; None for rivals.
    """

    row: Row
    sample: Sampler | None = None
    decode: Callable[[], object] | None = None
    model: AtlasModel | None = None


class _AtlasBench(Bench):
    """The benchmark of one lightmap, with random points of its mesh's surface at which decoders are timed."""

    def __init__(
        self, lightmap: Lightmap, device: str, progress: Note | None, points: int, repeats: int | None = None
    ) -> None:
        super().__init__("atlas", device, progress, scene=lightmap.scene, repeats=repeats)
        self.lit = lightmap.lit
        self.triangle, self.weight = _surface_points(self.lit.sheets[0], points, np.random.default_rng(0))

    def ours(self, profiles: Sequence[Profile], whole: bool) -> list[_Entry]:
        """Compresses with each profile and, if `whole`, with the first one to smaller sizes and to a cascade's size."""
        entries = [self.entry(profile, profile.name) for profile in profiles]
        if not whole or profiles[0].method != "tiles":
            return entries
        budgets = {_smaller_name(profiles[0], cr): 1.0 - cr for cr in _SMALLER}
        cascade = next((entry for entry in entries if entry.model.profile.method == "cascade"), None)
        if cascade is not None:
            budgets[f"{profiles[0].name}, bits of {cascade.row.option}"] = _share(cascade.row)
        for option, budget in budgets.items():
            try:
                entries.append(self.entry(profiles[0].model_copy(update={"budget": budget}), option))
            except WlmError as error:  # no room for a table
                entries.append(_Entry(self.missing_row("ours", option, error)))
        return entries

    def entry(self, profile: Profile, option: str) -> _Entry:
        """Compresses with a profile, writes the file and reads it back. Returns an entry with sizes and times."""
        self.note(f"{option}: compressing")
        fit = self.fit(option, lambda: compress(self.lit, profile, device=self.device))
        model = replace(fit.model, report=fit.fitted.report)  # the file leaves the stages' times out
        decode, errors = self._decode(model)
        figures = {f"{stage}_seconds": seconds for stage, seconds in model.report["seconds"].items()}
        row = self.row(
            "ours",
            option,
            model.method,
            bytes=fit.bytes - sizes(model)[1],
            bpp=SOURCE_BITS * (1.0 - model.compression_ratio),
            compression_ratio=model.compression_ratio,
            encode_seconds=fit.seconds,
            steps=profile.steps if profile.method == "cascade" else None,
            colour_width=model.texels.shape[2],
            colour_height=model.texels.shape[1],
            lut_width=model.lut.shape[1] or None,
            lut_height=model.lut.shape[0] or None,
            **errors,
            **figures,
        )
        return _Entry(row, Decoder(model, self.device), decode, model)

    def tuned(self, entries: Sequence[_Entry]) -> list[_Entry]:
        """Fits the first cascade's textures in its space, then in the other (UV or views); returns an entry each."""
        cascade = next((entry for entry in entries if entry.model and "fit" in entry.model.report["seconds"]), None)
        if cascade is None:
            return []
        # A cascade that doesn't pay is scored as the cascade that it is, here.
        alone = cascade.model.profile.model_copy(update={"fallback": False})
        tuned = []
        for space in (alone.space, "uv" if alone.space == "views" else "views"):
            fit = self.entry(alone.model_copy(update={"space": space}), f"{cascade.row.option}, {space}")
            seconds = fit.model.report["seconds"]["fit"]
            row = self.row(
                "fit",
                f"{alone.name}, space {space}",
                "the tuning alone",
                encode_seconds=seconds,
                step_ms=1e3 * seconds / max(alone.steps, 1),
                steps=alone.steps,
                resolution=alone.resolution,
            )
            tuned.append(_Entry(row, fit.sample))
        return tuned

    def original(self, model: AtlasModel) -> _Entry:
        """Makes the entry of the uncompressed lightmap, whose decoder reads it at the surface points."""
        model = replace(
            model,
            method="plain",
            colour="half",
            texels=self.lit.sheets[0].lightmaps.astype(np.float16),
            blocks=np.empty((0, 0, 16), np.uint8),
            block_texels=np.empty((0, 0, 0, 3), np.float16),
            lut=np.empty((0, 0, 2), np.uint16),
            uv=np.empty((0, 3, 2), np.float32),
        )
        decode, errors = self._decode(model)
        figures = {"bytes": model.texels.nbytes, "bpp": SOURCE_BITS, "compression_ratio": 0.0}
        return _Entry(self.row("lightmap", "half floats", "as it is", **figures, **errors), decode=decode)

    def timed(self, entries: Sequence[_Entry]) -> list[_Entry]:
        """Times the decoders of all entries in turns. Returns the entries with their times."""
        peers = [entry for entry in entries if entry.decode is not None]
        rows = self.time_rows([(entry.row, entry.decode) for entry in peers])
        timed = {id(entry): row for entry, row in zip(peers, rows, strict=True)}
        return [replace(entry, row=timed.get(id(entry), entry.row)) for entry in entries]

    def rivals(self, shares: dict[str, float], methods: Sequence[str]) -> list[_Entry]:
        """Compresses with the rivals to as many bits as each of our profiles takes.

        A rival that has reached the lightmap's full resolution is not measured again with more bits.

        Args:
            shares: Compressed size of each profile as a fraction of the lightmap's bits, by the profile's name.
            methods: Names of the rivals.
        """
        entries, measured, enough = [], [], {}
        for profile, share in shares.items():
            if any(abs(share / other - 1.0) < _SAME for other in measured):
                continue
            measured.append(share)
            for method in methods:
                if enough.get(method, math.inf) > share:
                    make = partial(RIVALS[_RIVALS[method]], self.lit, share)
                    entries.append(self._rival(method, f"bits of {profile}", make))
                    row = entries[-1].row
                    # ASTC has other blocks for other budgets.
                    whole = self.lit.sheets[0].mask.shape
                    if (row.get("colour_height"), row.get("colour_width")) == whole and method != "ASTC":
                        enough[method] = _share(row)
        return entries

    def _rival(self, method: str, option: str, make: Callable[[], Rival]) -> _Entry:
        self.note(f"compressing: {method}, {option}")
        try:
            rival = make()
        except (WlmError, ValueError) as error:  # a package is missing, or nothing fits
            return _Entry(self.missing_row(method, option, error))
        share = share_of(rival, self.lit)
        height, width = rival.size or (None, None)
        row = self.row(
            method,
            option,
            "compressed on the CPU, no file",
            bytes=rival.bytes,
            bpp=SOURCE_BITS * share,
            compression_ratio=1.0 - share,
            encode_seconds=rival.encode_seconds,
            colour_width=width,
            colour_height=height,
        )
        return _Entry(row, rival.decoded)

    def scored(self, entries: Sequence[_Entry], views: int, resolution: int) -> list[Row]:
        """Computes the errors of all entries together, so that each view is drawn once. Returns the finished rows."""
        self.note(f"measuring errors in {views} views of {resolution} x {resolution} pixels")
        decoders = {str(i): entry.sample for i, entry in enumerate(entries) if entry.sample is not None}
        reports = compare(self.lit, decoders, views=views, resolution=resolution, device=self.device)
        rows = [entry.row for entry in entries]
        for i, report in reports.items():
            rows[int(i)] = rows[int(i)].with_figures(**{name: getattr(report, name) for name in SCORES})
        return rows

    def _decode(self, model: AtlasModel) -> tuple[Callable[[], object], dict[str, float]]:
        """Returns a call that decodes a model at the surface points, and its errors against a float64 decode."""
        decoder = Decoder(model, self.device)
        sheet = self.lit.sheets[0]
        corner = model.uv if len(model.uv) else sheet.uv[sheet.triangle]
        uv = np.einsum("nk,nkc->nc", self.weight, corner[self.triangle]).astype(np.float32)
        points = interop.to_warp(torch.from_numpy(uv).to(self.device), wp.vec2)
        out = torch.empty((len(uv), 3), dtype=torch.float32, device=self.device)
        decoder.run(points, out)
        wp.synchronize_device(self.device)
        errors = exact_errors(out[:_CHECKED].cpu().numpy(), decode64(model, uv[:_CHECKED]))
        return self.replay(lambda: decoder.run(points, out)), errors


def means(rows: Sequence[Row], lightmaps: int, of: str = "") -> list[Row]:
    """Averages the rows of each method and option that was measured on more than one lightmap.

    Args:
        rows: The rows of all lightmaps.
        lightmaps: The number of lightmaps.
        of: Text that is added to the scene name of the averaged rows.
    """
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.figures and row.method != "fit":
            groups.setdefault((row.method, row.option), []).append(row)
    made = []
    for (method, option), group in groups.items():
        if len(group) < 2:
            continue
        figures: dict[str, float | None] = {}
        for name in _AVERAGED:
            if values := [row[name] for row in group if name in row.figures]:
                figures[name] = fmean(values)
                if name in _RANGED:
                    figures |= {f"{name}_min": min(values), f"{name}_max": max(values)}
        figures["max_error"] = max((row["max_error"] for row in group if "max_error" in row.figures), default=None)
        figures["lightmaps"] = len(group)
        made.append(Row("atlas", f"{MEAN} {lightmaps} lightmaps{of}", method, option, figures))
    return made


def make_square(states: int) -> LightmappedScene:
    """Makes a small scene with which kernels are compiled: a square of 32 x 32 texels in some lighting states."""
    side = np.linspace(0.1, 1.0, 32)
    image = np.stack([np.outer(side, side), np.outer(side, side[::-1]), np.outer(side, side) ** 2], -1)
    uv = np.array([[0, 0], [1, 0], [0, 1], [1, 1]], float)
    light = np.stack([image ** (1 + state) for state in range(states)])
    return from_arrays(np.insert(uv, 2, 0.0, 1), np.array([[0, 1, 2], [2, 1, 3]]), uv, light, name="square")


def warm_up(profile: Profile, device: str) -> None:
    """Compiles all kernels of compression and decoding, by a small scene of one state."""
    small = {"views": 1, "steps": min(profile.steps, 4), "resolution": 64}
    small |= {"budget": 1.0} if profile.method == "tiles" else {}
    model = compress(make_square(1), profile.model_copy(update=small), device=device)
    Decoder(model, device).lightmap()


def _surface_points(sheet: Sheet, count: int, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Draws N points uniformly over the lit surface. Returns triangle indices [N] and barycentric weights [N, 3]."""
    corner = sheet.position[sheet.triangle]
    area = np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) * sheet.active
    ends = np.cumsum(area)
    triangle = np.searchsorted(ends, random.random(count) * ends[-1], side="right").clip(max=len(ends) - 1)
    root, share = np.sqrt(random.random(count)), random.random(count)
    return triangle, np.stack([1.0 - root, root * (1.0 - share), root * share], 1)
