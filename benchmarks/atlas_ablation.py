"""Ablation of the paper's cascade, and its texture sizes (lightmap-uv-clustering-cascade, section 4.5 and table 2).

One profile is fitted several times, each time with one setting changed. A fit is never replaced by a plain smaller
lightmap, even if that has less error. The rows of method "ablation":

- "whole": the profile without a change.
- "no repacking": the mesh keeps its UVs, and the cascade begins as the lightmap itself (table 3).
- "no cascade": the repacked lightmap as it is, without a lookup table and without a fit (table 3).
- "not tuned": the cascade before its textures are fitted.
- "ASTC": the colour texture T_p of "whole" in ASTC blocks of 4 x 4 texels (table 2).
- "downsampling", "downsampling, paper": the lightmap at a lower resolution, in the bits of "whole" (table 1). The first
  is the best that we know; the second is bilinear and has as many texels as half floats of 48 bits allow, where the
  colours of "whole" count 48 bits too, as in the paper.

Rows of method "sweep" (figure 7) change one of the paper's size factors: epsilon ("scale"), epsilon_p ("colour_scale")
or epsilon_c ("lut_scale").

Triangles are grouped once per lightmap, and the time of this is not counted. The error at seams is measured at chart
borders, in the UVs of the variant. A texel of half floats counts as 64 bits, as on a GPU; the paper counts 48.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from benchmarks.atlas import (
    QUICK_RESOLUTION,
    QUICK_VIEWS,
    RESOLUTION,
    SCORES,
    VIEWS,
    Lightmap,
    means,
    read_lightmaps,
    warm_up,
)
from benchmarks.rivals.atlas import RIVALS, share_of
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, check_only
from wlm.atlas.cascade.fit import fit_cascade, group_triangles
from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedScene
from wlm.atlas.decode import Decoder
from wlm.atlas.evaluation import Sampler, chart_labels, compare
from wlm.atlas.model import COLOUR_BITS, SOURCE_BITS, TEXELS, AtlasModel, Profile
from wlm.atlas.stages import Stages
from wlm.errors import WlmError

WHOLE, KEPT_UVS = "whole", "no repacking"
"""The rows of the profile itself, and of its cascade under the mesh's own UVs."""

ABLATION = {
    WHOLE: {},
    KEPT_UVS: {},
    "no cascade": {"lut_scale": 0.0, "colour_scale": 1.0, "steps": 0},
    "not tuned": {"steps": 0},
}
"""The changed settings of each row."""

OF_WHOLE = ("ASTC", "downsampling", "downsampling, paper")
"""The rows that are made from the model of "whole"."""

_PAPER_BITS = 48  # of a texel of colours in eq. 9

SWEEPS = {
    "scale": (0.3, 0.4, 0.5, 0.6, 0.7),
    "colour_scale": (0.2, 0.3, 0.4, 0.5, 0.6, 0.8),
    "lut_scale": (0.3, 0.5, 0.6, 0.7, 0.8, 1.0),
}
"""The values that rows of method "sweep" give to each setting."""

_SEED = 0
_QUICK = {"steps": 200, "resolution": 256}


def run(
    *,
    profile: str = "paper",
    only: Sequence[str] | None = None,
    quick: bool,
    device: str,
    steps: int | None = None,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
    **paths: Any,
) -> list[Row]:
    """Fits the variants of a profile to each lightmap and compares them.

    Args:
        profile: A profile of method "cascade": its name or a YAML file.
        only: Names of the variants to measure; None: all.
        quick: Whether to make short fits in small views, which only show on a CPU that everything works.
        device: "cpu" or "cuda:0".
        steps: Steps of each fit; None: as the profile states.
        progress: Called with a line before each part of the work.
        done: Called after each lightmap with all rows so far.
        paths: The arguments of `benchmarks.atlas.read_lightmaps`.

    Returns:
        The rows of each lightmap, and their means if there are several lightmaps.

    Raises:
        WlmError: A file, the profile or the device does not exist, the profile is not a cascade, or a name in `only`
            is unknown.
    """
    settings = Profile.load(profile).override(_QUICK if quick else {})
    if steps is not None:
        settings = settings.override({"steps": steps})
    choose(settings, only or ())  # a misspelt name fails before the meshes are read
    lightmaps = read_lightmaps(**paths)
    views, resolution = (QUICK_VIEWS, QUICK_RESOLUTION) if quick else (VIEWS, RESOLUTION)
    options = {"device": device, "progress": progress, "done": done}
    return run_rows(lightmaps, settings, only or (), views=views, resolution=resolution, **options)


def run_rows(
    lightmaps: Sequence[Lightmap],
    profile: Profile,
    only: Sequence[str] = (),
    *,
    device: str,
    views: int,
    resolution: int,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Fits the variants of a profile and measures errors in `views` square pictures. Other arguments: see `run`."""
    chosen = choose(profile, only)
    of = f", ablation of {profile.name}"
    first = Bench("atlas", device, progress)
    first.note("compiling kernels")
    warm_up(profile, first.device)
    rows: list[Row] = []
    for lightmap in lightmaps:
        bench = Bench("atlas", device, progress, scene=lightmap.scene + of)
        rows += _rows(bench, lightmap, profile, chosen, views, resolution)
        if done is not None:
            done(rows)
    return rows + means(rows, len(lightmaps), of)


def variants(base: Profile) -> list[tuple[str, str, Profile]]:
    """Returns the variants of a profile: the method and the option that a row states, and the changed profile.

    Values of `SWEEPS` that the profile already has are left out.
    """
    rows = [("ablation", name, base.override(changes)) for name, changes in ABLATION.items()]
    rows += [("ablation", name, base) for name in OF_WHOLE]
    for setting, values in SWEEPS.items():
        for value in values:
            if value != getattr(base, setting):
                rows.append(("sweep", f"{setting} {value:g}", base.override({setting: value})))
    return rows


def choose(base: Profile, only: Sequence[str]) -> list[tuple[str, str, Profile]]:
    """Returns the requested variants of a profile, in the form that `variants` returns.

    Args:
        base: The profile of which each variant changes one setting.
        only: Names of the variants; empty: all.

    Raises:
        WlmError: The profile is not a cascade, or no variant has such a name.
    """
    if base.method != "cascade":
        raise WlmError(f"--profile: expected a profile of method cascade, found {base.name} of method {base.method}")
    rows = variants(base)
    check_only(only, [option for _, option, _ in rows])
    wanted = {*only, WHOLE} if any(name in OF_WHOLE for name in only) else only
    return [row for row in rows if not only or row[1] in wanted]


def _rows(
    bench: Bench,
    lightmap: Lightmap,
    base: Profile,
    chosen: Sequence[tuple[str, str, Profile]],
    views: int,
    resolution: int,
) -> list[Row]:
    scene, device = lightmap.lit, bench.device
    clusters = None
    if any(option != KEPT_UVS for _, option, _ in chosen):
        bench.note("grouping triangles")
        clusters = group_triangles(scene.sheets[0], base, Stages(device))
    rows: list[Row] = []
    samplers: dict[str, Sampler] = {}
    labels: dict[str, np.ndarray] = {}
    whole = None
    for method, option, variant in chosen:
        bench.note(f"fitting {option}")
        stages, start = Stages(device), time.perf_counter()
        try:
            if option not in OF_WHOLE:
                model = fit_cascade(scene, clusters, variant, _SEED, stages, repack=option != KEPT_UVS)
                whole = model if option == WHOLE else whole
            elif whole is None:
                raise WlmError(f"it is made from {WHOLE}, which failed")
            elif option == "ASTC":
                texels = quantise(whole.texels[0].astype(np.float32), "astc")
                parts = {name: texture[None] for name, texture in texels.items()}
                model = replace(whole, profile=variant.override({"colour": "astc"}), colour="astc", **parts)
            else:
                row, samplers[str(len(rows))] = _downsampled(bench, scene, whole, option)
                rows.append(row)
                continue
        except WlmError as error:  # a package is missing, or the fit diverged
            rows.append(bench.missing_row(method, option, error))
            continue
        samplers[str(len(rows))] = Decoder(model, device)
        labels[str(len(rows))] = chart_labels(model, scene, device)
        rows.append(_row(bench, method, option, variant, model, stages, time.perf_counter() - start))
    bench.note(f"measuring errors in {views} views of {resolution} x {resolution} pixels")
    scores = compare(scene, samplers, labels=labels, views=views, resolution=resolution, device=device)
    for i, score in scores.items():
        rows[int(i)] = rows[int(i)].with_figures(**{name: getattr(score, name) for name in SCORES})
    return rows


def _downsampled(bench: Bench, scene: LightmappedScene, whole: AtlasModel, option: str) -> tuple[Row, Sampler]:
    """Makes a smaller lightmap in as many bits as a cascade. Returns its row and a decoder."""
    share, drawn = 1.0 - whole.compression_ratio, 1.0
    if option != "downsampling":
        saved = whole.texels[0, ..., 0].size * (COLOUR_BITS[whole.colour] - _PAPER_BITS)
        share -= saved / (scene.texels * SOURCE_BITS)
        drawn = COLOUR_BITS[TEXELS] / _PAPER_BITS
    rival = RIVALS["downsampling" if drawn == 1.0 else "downsampling bilinear"](scene, share * drawn)
    height, width = rival.size
    share = share_of(rival, scene) / drawn
    figures = {"bpp": SOURCE_BITS * share, "compression_ratio": 1.0 - share}
    figures |= {"colour_width": width, "colour_height": height, "encode_seconds": rival.encode_seconds}
    return bench.row("ablation", option, **figures), rival.decoded


def _row(
    bench: Bench, method: str, option: str, profile: Profile, model: AtlasModel, stages: Stages, seconds: float
) -> Row:
    fit = stages.seconds.get("fit")  # None where the textures are those of another row
    return bench.row(
        method,
        option,
        bpp=SOURCE_BITS * (1.0 - model.compression_ratio),
        compression_ratio=model.compression_ratio,
        encode_seconds=seconds,
        step_ms=1e3 * fit / profile.steps if fit and profile.steps else None,
        steps=profile.steps,
        resolution=profile.resolution if profile.space == "views" and profile.steps else None,
        colour_width=model.texels.shape[2],
        colour_height=model.texels.shape[1],
        lut_width=model.lut.shape[1] or None,
        lut_height=model.lut.shape[0] or None,
        **{f"{stage}_seconds": value for stage, value in stages.seconds.items()},
    )
