"""Rivals of the network: a flip book seen from aside, a path tracer."""

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
import torch

from benchmarks.path_tracer import GPU, PathTracer, choose_variant, denoise, has_denoiser, has_tracer
from benchmarks.rivals.smoke import billboard
from benchmarks.rows import Row
from benchmarks.smoke_network_setup import EXACT, NetworkBench, Pipeline, score
from benchmarks.timing import time_together
from wlm.errors import one_line
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.coarse import bake_coarse
from wlm.smoke.march.fine import bake
from wlm.smoke.network.planes import encode_lightmaps, to_srgb
from wlm_kernels.smoke.settings import March

_DENOISED = "denoised"


def flipbook_rows(bench: NetworkBench) -> list[Row]:
    """A flip book baked from the first camera, under cameras that turn away from it."""
    bench.note("flip book")
    frames = bench.frames[:: bench.sizes.frames]  # one of each scene
    baked = [bake(frame.later, bench.camera, step=EXACT, estimate=False) for frame in frames]
    pivots = [frame.later.centre for frame in frames]
    ours = Pipeline(bench, bench.trained[0], half=True) if bench.trained else None
    settings = bench.settings if ours is None else ours.subject.settings
    step = settings.look(frames[0].later.shape).step
    rows = []
    for degrees in bench.sizes.turns:
        camera = bench.turned(degrees)
        references = [bench.reference(frame.later, camera) for frame in frames]

        def turned(camera=camera) -> list[SixWay]:
            return [billboard(six, bench.camera, camera, at) for six, at in zip(baked, pivots, strict=True)]

        marched = [bake_coarse(frame.later, camera, March(step, seed=frame.seed + 1)) for frame in frames]
        figures = score([encode_lightmaps(six) for six in turned()], references)
        figures["coarse_psnr"] = score([encode_lightmaps(six) for six in marched], references)["psnr"]
        notes = f"coarse march of h {step:g}"
        if ours is not None:
            planes = [ours.planes(frame.later, camera, frame.seed + 1) for frame in frames]
            figures["network_psnr"] = score(planes, references)["psnr"]
            notes += f", network {ours.subject.name}"
        timing = bench.time({"": turned}, few=True)[""]
        rows.append(bench.row("flip book", f"turned {degrees:g}°", notes, timing=timing, calls=len(frames), **figures))
    return rows


def traced_rows(bench: NetworkBench) -> list[Row]:
    """All six lightmaps by a path tracer, with and without a denoiser, where they are installed.

    Mitsuba needs a driver with OptiX: where it fails on the bench's GPU it traces on the CPU, which the rows say, and
    where it fails there too, there are none.
    """
    if not has_tracer():
        bench.note("path tracing: left out, mitsuba isn't installed: wlm[bake]")
        return []
    bench.note("path tracing")
    variant, trouble = choose_variant(bench.device)
    if variant == GPU:
        try:
            return _rows_of(bench, variant, "")
        except (RuntimeError, ImportError, OSError) as error:  # what Mitsuba and Dr.Jit raise
            variant, trouble = choose_variant()[0], one_line(error)
    if trouble:
        bench.note(f"path tracing: on the CPU: {trouble}")
    try:
        return _rows_of(bench, variant, trouble)
    except (RuntimeError, ImportError, OSError) as error:
        bench.note(f"path tracing: left out: {one_line(error)}")
        return []


def _rows_of(bench: NetworkBench, variant: str, trouble: str) -> list[Row]:
    """The rows of one of Mitsuba's variants; their notes say why it isn't the GPU's."""
    numbers = range(0, len(bench.frames), bench.sizes.frames)  # one frame of each scene
    tracers = [PathTracer(bench.frames[i].later, bench.camera, variant=variant) for i in numbers]
    references = [bench.references[i].cpu() for i in numbers]
    traced = {count: [tracer(count)[0] for tracer in tracers] for count in bench.sizes.samples}
    calls: dict[str, Callable[[], object]] = {_name(count): partial(tracers[0], count) for count in traced}
    if has_denoiser():
        calls[_DENOISED] = partial(denoise, traced[bench.sizes.samples[0]][0])
    # By the CPU's clock on both: an image is a copy there.
    times = {name: timing.median_ms for name, timing in time_together(calls, "cpu", 1, bench.sizes.few).items()}
    notes = f"on the {'GPU' if variant == GPU else 'CPU'}, {variant}" + (f": not on the GPU, {trouble}" * bool(trouble))
    pixels = bench.sizes.resolution
    rows = []
    for count, images in traced.items():
        name = _name(count)
        rows.append(
            bench.row("path tracing", name, notes, time_ms=times[name], pixels=pixels, **_score(images, references))
        )
        if _DENOISED in times:
            figures, total = _score([denoise(image) for image in images], references), times[name] + times[_DENOISED]
            option = f"{name}, {_DENOISED}" + (" on the CPU" if variant == GPU else "")
            rows.append(bench.row("path tracing", option, notes, time_ms=total, pixels=pixels, **figures))
    return rows


def _name(count: int) -> str:
    return "1 sample" if count == 1 else f"{count} samples"


def _score(images: Sequence[np.ndarray], references: Sequence[torch.Tensor]) -> dict[str, float]:
    return score([to_srgb(torch.from_numpy(image)) for image in images], references)
