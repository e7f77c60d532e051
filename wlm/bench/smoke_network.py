"""The neural six-way lightmaps against marches, flip books and path tracing: time and error, in one run.

All look at frames of a jet, a plume, a flame and a burst that no network has learned from, nor was chosen by, from one
camera, and are held against the six-way march in steps of half a voxel. PSNR is of the six lightmaps in sRGB with a
peak of 1, an image at a time: its mean, least and most. The methods, each a table of its own:

- "time against error": the fine march ("six ways") and the coarse one by their steps in voxels, the latter also with
  nodes of its lattice that are nearer or farther apart than a step, and networks with the guiding map that each reads
  and with its planes decoded to light. The emission is that of frames that glow. Times are
  of a frame, the mean over all; on a GPU as replayed graphs, and as the calls that a user makes beside it.
- "frame": where the time of a frame goes, and the simulation beside it. "shade" weighs for two lights.
- "flip book": lightmaps baked from one side, on a billboard that turns with the camera; what the coarse march and the
  first network make of the turned view is beside it.
- "path tracing": all six lightmaps by Mitsuba at one bounce, on the GPU where its driver can, else on the CPU, with and
  without a denoiser, which is the CPU's; only with the extra `bake`.
- "profiles": the networks' own time by profile, with random weights.
- "density": the same frames and those a moment before them, with another density. The flicker is the mean change of
  the lightmaps along the motion, in levels of 255, also over that of the reference, in which nothing flickers.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from wlm.bench.plot import Panel
from wlm.bench.runner import Row
from wlm.bench.smoke_network_parts import density_rows, frame_rows, profile_rows
from wlm.bench.smoke_network_rivals import flipbook_rows, traced_rows
from wlm.bench.smoke_network_setup import (
    EXACT,
    FULL,
    QUICK,
    Frame,
    NetworkBench,
    NetworkSizes,
    Subject,
    Whole,
    open_subjects,
    row,
    score,
)
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.baking import bake
from wlm.smoke.coarse import march
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.planes import EMISSION_PLANE, OPACITY_PLANE, decode_lightmaps, encode_lightmaps, render_guide
from wlm_kernels.smoke.settings import March

__all__ = ["PANELS", "plotted", "run", "run_rows"]

PANELS = (Panel("decode_ms", "psnr"),)
"""What a plot shows."""

_TABLE = "time against error"
_DEAR = 5.0  # voxels, the longest step of a six-way march that takes long


def run(
    networks: Sequence[str | Path] = (),
    profiles: Sequence[str] = (),
    *,
    quick: bool,
    device: str,
    progress: Callable[[str], None] | None = None,
) -> list[Row]:
    """Measures networks and what they are compared with.

    Args:
        networks: Files of trained ones.
        profiles: Names of profiles whose untrained networks are timed.
        quick: Small grids, for a minute on a CPU. Otherwise the paper's, for a GPU.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        The rows, method by method.

    Raises:
        WlmError: Neither is given or one can't be read, or the device isn't there or hasn't the memory.
    """
    if not networks and not profiles:
        raise WlmError("bench: expected --network FILE or --profile NAME, found neither")
    subjects = open_subjects(networks, profiles)
    return run_rows(QUICK if quick else FULL, subjects, device=device, progress=progress)


def run_rows(
    sizes: NetworkSizes, subjects: Sequence[Subject], *, device: str, progress: Callable[[str], None] | None = None
) -> list[Row]:
    """Measures them on given grids.

    Args:
        sizes: Of the grids.
        subjects: The networks.
        device: "cpu" or "cuda:0".
        progress: As for ``run``.

    Raises:
        WlmError: As ``run``.
    """
    bench = NetworkBench(check_device(device), sizes, subjects, progress)
    parts = (error_rows, frame_rows, flipbook_rows, traced_rows, profile_rows, density_rows)
    return [one for part in parts for one in part(bench)]


def error_rows(bench: NetworkBench) -> list[Row]:
    """Time and error of marches by their steps, and of networks."""
    bench.note(_TABLE)
    makers: dict[str, Callable[..., torch.Tensor] | None] = {}  # None: nothing to score
    notes = {f"six ways, step {EXACT:g}": "what all is held against"}
    calls: dict[str, Callable[[], object]] = {}
    chains: dict[str, Callable[[], object]] = {}  # of graphs that each network has already
    for step in bench.sizes.six:
        name = f"six ways, step {step:g}"
        makers[name] = None if name in notes else _six_maker(step)
        calls[name] = _on_all(bench, _six_call(bench, step))
    coarse = {f"coarse, h {step:g}": (step, step) for step in bench.sizes.coarse}
    coarse |= {f"coarse, h {step:g}, nodes {spacing:g}": (step, spacing) for step, spacing in bench.sizes.swept}
    for name, (step, spacing) in coarse.items():
        makers[name] = _coarse_maker(step, spacing)
        calls[name] = _on_all(bench, _coarse_call(bench, step, spacing))
    for subject in bench.subjects:
        for half in (True, False) if bench.device != "cpu" else (False,):
            name = f"{subject.name}, {'fp16' if half else 'fp32'}"
            whole = Whole(bench, subject, half=half)
            makers[name] = whole.planes if subject.trained else None
            if not subject.trained:
                notes[name] = "not trained"
            calls[name] = _on_all(bench, _predict_call(bench, whole))
            parts = [part for frame in bench.frames for part in whole.parts(frame).values()]
            chains[name] = _in_turn(parts)
    dear = {name for name in calls if name.startswith("six ways") and float(name.split()[-1]) <= _DEAR}
    cheap = {name: call for name, call in calls.items() if name not in dear}
    marched = {name: call for name, call in cheap.items() if name not in chains}
    long = {name: calls[name] for name in calls if name in dear}
    eager = bench.time(cheap) | bench.time(long, few=True)
    graphs = bench.replayed(marched) | bench.replayed(long, few=True)
    if bench.device != "cpu":
        graphs |= bench.time(chains)
    glowing = [i for i, frame in enumerate(bench.frames) if frame.later.temperature is not None]
    rows = []
    for name, maker in makers.items():
        figures, scores = {}, None
        if maker is not None:
            made = [maker(frame.later, bench.camera, frame.seed + 1) for frame in bench.frames]
            scores = score(made, bench.references)
            figures = scores.figures | {"opacity dB": f"{_plane(OPACITY_PLANE, made, bench.references):.2f}"}
            if glowing:
                parts = ([planes[i] for i in glowing] for planes in (made, bench.references))
                figures["emission dB"] = f"{_plane(EMISSION_PLANE, *parts):.2f}"
        if name in graphs:
            figures["as calls, ms"] = f"{eager[name].median_ms / len(bench.frames):.3g}"
        timing = graphs.get(name, eager[name])
        psnr = None if scores is None else scores.mean
        rows.append(row(_TABLE, name, figures, notes.get(name, ""), timing=timing, calls=len(bench.frames), psnr=psnr))
    return rows


def plotted(rows: Sequence[Row]) -> list[Row]:
    """The rows that a plot shows, with the first part of what they are for their method."""
    shown = []
    for one in rows:
        if one.method == _TABLE:
            method, _, option = one.option.partition(", ")
            shown.append(replace(one, method=method, option=option))
    return shown


def _plane(plane: int, made: Sequence[torch.Tensor], references: Sequence[torch.Tensor]) -> float:
    """PSNR of one of the planes, over all frames."""
    off = [float((a[plane] - b[plane]).square().mean()) for a, b in zip(made, references, strict=True)]
    return psnr_from_mse(sum(off) / len(off), 1.0)


def _on_all(bench: NetworkBench, call: Callable[[Frame], object]) -> Callable[[], object]:
    return lambda: [call(frame) for frame in bench.frames]


def _in_turn(parts: Sequence[Callable[[], object]]) -> Callable[[], object]:
    return lambda: [part() for part in parts]


def _six_call(bench: NetworkBench, step: float) -> Callable[[Frame], SixWay]:
    return lambda frame: bake(frame.later, bench.camera, step=step, estimate=False)


def _coarse_call(bench: NetworkBench, step: float, spacing: float) -> Callable[[Frame], object]:
    return lambda frame: march(frame.later, bench.camera, March(step, spacing, seed=frame.seed + 1))


def _six_maker(step: float) -> Callable[..., torch.Tensor]:
    return lambda volume, camera, seed: encode_lightmaps(bake(volume, camera, step=step, estimate=False))


def _coarse_maker(step: float, spacing: float) -> Callable[..., torch.Tensor]:
    return lambda volume, camera, seed: encode_lightmaps(march(volume, camera, March(step, spacing, seed=seed)))


def _predict_call(bench: NetworkBench, whole: Whole) -> Callable[[Frame], SixWay]:
    def call(frame: Frame) -> SixWay:
        look = whole.subject.settings.look(frame.later.shape, frame.seed + 1)
        planes = whole.decoder(render_guide(frame.later, bench.camera, whole.decoder.guide, look))
        return decode_lightmaps(planes, hot=whole.decoder.emission and frame.later.temperature is not None)

    return call
