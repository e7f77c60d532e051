"""The neural six-way lightmaps against marches, flip books and path tracing: time and error, in one run.

All rows are of held-out frames of a jet, a plume, a flame and a burst, from one camera, and their error is against the
six-way march in steps of half a voxel. PSNR is of the six lightmaps of an image, in sRGB with a peak of 1: mean, least
and most over the images. The methods, each a table of its own:

- "time against error": the fine march ("six ways") and the coarse one by their steps in voxels, the latter also with
  nodes of its lattice that are nearer or farther apart than a step, and networks with their guiding maps and with their
  planes decoded to light. The emission is that of frames that glow. Times are of a frame, the mean over all; on a GPU
  as replayed graphs, and as the calls that a user makes beside it.
- "frame": the stages of a frame, and the simulation beside it. "shade" weights six lightmaps for two lights.
- "flip book": lightmaps baked from one side, on a billboard that turns with the camera; the coarse march and the first
  network, of the turned view, are beside it.
- "path tracing": all six lightmaps by Mitsuba at one bounce, on the GPU where its driver can, else on the CPU, with and
  without a denoiser, which is the CPU's; only with the extra `bake`.
- "profiles": the time of each profile's network, with random weights.
- "density": the same frames and those a moment before them, with another density. The flicker is the mean change of
  the lightmaps along the motion, in levels of 255, also over that of the reference, in which nothing flickers.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch

from benchmarks.plot import Panel
from benchmarks.rows import Row
from benchmarks.runner import Note
from benchmarks.smoke_network_parts import density_rows, frame_rows, profile_rows
from benchmarks.smoke_network_rivals import flipbook_rows, traced_rows
from benchmarks.smoke_network_setup import (
    EXACT,
    FULL,
    QUICK,
    NetworkBench,
    NetworkSizes,
    Pipeline,
    Subject,
    open_subjects,
    score,
)
from wlm.errors import WlmError
from wlm.fluid.volume import DensityVolume
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import bake_coarse
from wlm.smoke.march.fine import bake
from wlm.smoke.network.planes import EMISSION_PLANE, OPACITY_PLANE, decode_lightmaps, encode_lightmaps, render_guide
from wlm_kernels.smoke.settings import March

PANELS = (Panel("time_ms", "psnr"),)
"""What a plot of `plotted` rows shows."""

_TABLE = "time against error"
_LONG = 5.0  # voxels: six-way marches with no longer steps take long


def run(
    networks: Sequence[str | Path] = (),
    profiles: Sequence[str] = (),
    *,
    quick: bool,
    device: str,
    progress: Note | None = None,
) -> list[Row]:
    """Measures networks and their rivals.

    Args:
        networks: Files of trained networks.
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
    sizes: NetworkSizes, subjects: Sequence[Subject], *, device: str, progress: Note | None = None
) -> list[Row]:
    """Measures networks on grids of the given sizes; the rest as for `run`."""
    bench = NetworkBench(device, sizes, subjects, progress)
    parts = (error_rows, frame_rows, flipbook_rows, traced_rows, profile_rows, density_rows)
    return [row for part in parts for row in part(bench)]


def error_rows(bench: NetworkBench) -> list[Row]:
    """Time and error of marches by their steps, and of networks."""
    bench.note(_TABLE)
    marches = {f"six ways, step {step:g}": _six(step) for step in bench.sizes.six}
    coarse = {f"coarse, h {step:g}": (step, step) for step in bench.sizes.coarse}
    coarse |= {f"coarse, h {step:g}, nodes {spacing:g}": (step, spacing) for step, spacing in bench.sizes.swept}
    marches |= {name: _coarse(*steps) for name, steps in coarse.items()}
    predicted = {name: _encoded(method) for name, method in marches.items()}
    reference = f"six ways, step {EXACT:g}"
    notes = {reference: "the reference"}
    calls = {name: _on_all(bench, method) for name, method in marches.items()}
    chains: dict[str, Callable[[], object]] = {}  # of the graphs that each network has already
    for subject in bench.subjects:
        for half in (True, False) if bench.device != "cpu" else (False,):
            name = f"{subject.name}, {'fp16' if half else 'fp32'}"
            pipeline = Pipeline(bench, subject, half=half)
            if subject.trained:
                predicted[name] = pipeline.planes
            else:
                notes[name] = "not trained"
            calls[name] = _on_all(bench, _network(pipeline))
            parts = [part for frame in bench.frames for part in pipeline.parts(frame).values()]
            chains[name] = _in_turn(parts)
    long = {name for name in calls if name.startswith("six ways") and float(name.split()[-1]) <= _LONG}
    short_calls = {name: call for name, call in calls.items() if name not in long}
    long_calls = {name: call for name, call in calls.items() if name in long}
    eager = bench.time(short_calls) | bench.time(long_calls, few=True)
    graphs = bench.replayed({name: call for name, call in short_calls.items() if name not in chains})
    graphs |= bench.replayed(long_calls, few=True)
    if bench.device != "cpu":
        graphs |= bench.time(chains)
    count = len(bench.frames)
    glowing = [i for i, frame in enumerate(bench.frames) if frame.later.temperature is not None]
    rows = []
    for name in calls:
        figures = {}
        if name in predicted and name != reference:
            planes = [predicted[name](frame.later, bench.camera, frame.seed + 1) for frame in bench.frames]
            figures = score(planes, bench.references)
            figures["opacity_psnr"] = _plane_psnr(OPACITY_PLANE, planes, bench.references)
            if glowing:
                parts = ([images[i] for i in glowing] for images in (planes, bench.references))
                figures["emission_psnr"] = _plane_psnr(EMISSION_PLANE, *parts)
        if name in graphs:
            figures["call_ms"] = eager[name].median_ms / count
        timing = graphs.get(name, eager[name])
        rows.append(bench.row(_TABLE, name, notes.get(name, ""), timing=timing, calls=count, **figures))
    return rows


def plotted(rows: Sequence[Row]) -> list[Row]:
    """The rows that a plot shows, with the first part of their option as the method."""
    points = []
    for row in rows:
        if row.method == _TABLE:
            method, _, option = row.option.partition(", ")
            points.append(replace(row, method=method, option=option))
    return points


def _plane_psnr(plane: int, predicted: Sequence[torch.Tensor], references: Sequence[torch.Tensor]) -> float:
    """PSNR of one of the planes, over all frames."""
    squares = [float((a[plane] - b[plane]).square().mean()) for a, b in zip(predicted, references, strict=True)]
    return psnr_from_mse(sum(squares) / len(squares), 1.0)


_Method = Callable[[DensityVolume, Camera, int], SixWay]
"""Smoke, a camera and a seed to lightmaps."""


def _six(step: float) -> _Method:
    return lambda volume, camera, seed: bake(volume, camera, step=step, estimate=False)


def _coarse(step: float, spacing: float) -> _Method:
    return lambda volume, camera, seed: bake_coarse(volume, camera, March(step, spacing, seed=seed))


def _network(pipeline: Pipeline) -> _Method:
    decoder = pipeline.decoder

    def lightmaps(volume: DensityVolume, camera: Camera, seed: int) -> SixWay:
        look = pipeline.subject.settings.look(volume.shape, seed)
        planes = decoder(render_guide(volume, camera, decoder.guide, look))
        return decode_lightmaps(planes, hot=decoder.emission and volume.temperature is not None)

    return lightmaps


def _encoded(method: _Method) -> Callable[[DensityVolume, Camera, int], torch.Tensor]:
    return lambda volume, camera, seed: encode_lightmaps(method(volume, camera, seed))


def _on_all(bench: NetworkBench, method: _Method) -> Callable[[], object]:
    return lambda: [method(frame.later, bench.camera, frame.seed + 1) for frame in bench.frames]


def _in_turn(parts: Sequence[Callable[[], object]]) -> Callable[[], object]:
    return lambda: [part() for part in parts]
