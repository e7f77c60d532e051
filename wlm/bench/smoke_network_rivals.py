"""What a frame's lightmaps could be made by instead of a network: a flip book seen from aside, a path tracer."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from wlm.baselines.smoke import billboard
from wlm.bench.path_tracer import GPU, PathTracer, choose_variant, denoise, has_denoiser, has_tracer
from wlm.bench.runner import Row
from wlm.bench.smoke_network_setup import EXACT, NetworkBench, Scores, Whole, row, score
from wlm.bench.timing import time_together
from wlm.errors import one_line
from wlm.smoke.baking import bake
from wlm.smoke.coarse import march
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.planes import encode_lightmaps, to_srgb
from wlm_kernels.smoke.settings import March

__all__ = ["flipbook_rows", "traced_rows"]

_DENOISED = "denoised"


def flipbook_rows(bench: NetworkBench) -> list[Row]:
    """A flip book baked from the first camera, under cameras that turn away from it."""
    bench.note("flip book")
    frames = bench.frames[:: bench.sizes.frames]  # one of each scene
    baked = [bake(frame.later, bench.camera, step=EXACT, estimate=False) for frame in frames]
    pivots = [frame.later.centre for frame in frames]
    ours = Whole(bench, bench.trained[0], half=True) if bench.trained else None
    settings = bench.settings if ours is None else ours.subject.settings
    step = settings.look(frames[0].later.shape).step
    rows = []
    for degrees in bench.sizes.turns:
        camera = bench.turned(degrees)
        references = [bench.reference(frame.later, camera) for frame in frames]

        def turned(camera=camera) -> list[SixWay]:
            return [billboard(six, bench.camera, camera, at) for six, at in zip(baked, pivots, strict=True)]

        marched = [march(frame.later, camera, March(step, seed=frame.seed + 1)) for frame in frames]
        found = score([encode_lightmaps(six) for six in turned()], references)
        beside = score([encode_lightmaps(six) for six in marched], references)
        figures = found.figures | {f"coarse march, h {step:g}, dB": f"{beside.mean:.2f}"}
        if ours is not None:
            made = [ours.planes(frame.later, camera, frame.seed + 1) for frame in frames]
            figures[f"{ours.subject.name}, dB"] = f"{score(made, references).mean:.2f}"
        timing = bench.time({"": turned}, few=True)[""]
        rows.append(
            row("flip book", f"turned {degrees:g}°", figures, timing=timing, calls=len(frames), psnr=found.mean)
        )
    return rows


def traced_rows(bench: NetworkBench) -> list[Row]:
    """All six lightmaps by a path tracer, with and without a denoiser, where they are installed.

    It is another's, with a driver of its own: if it fails on the bench's GPU it traces on the CPU, which the rows say,
    and if it fails there too, there are none.
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
    """The rows of one of Mitsuba's variants, and in their notes why it isn't the GPU's."""
    numbers = range(0, len(bench.frames), bench.sizes.frames)  # one frame of each scene
    tracers = [PathTracer(bench.frames[i].later, bench.camera, variant=variant) for i in numbers]
    references = [bench.references[i].cpu() for i in numbers]
    made = {count: [tracer(count)[0] for tracer in tracers] for count in bench.sizes.samples}
    calls: dict[str, Callable[[], object]] = {_name(count): _traced(tracers[0], count) for count in made}
    if has_denoiser():
        calls[_DENOISED] = _cleaned(made[bench.sizes.samples[0]][0])
    times = {name: found.median_ms for name, found in time_together(calls, "cpu", 1, bench.sizes.few).items()}
    # By the CPU's clock on both: an image is a copy there.
    on = {"pixels": f"{bench.sizes.resolution}²", "on": f"{'GPU' if variant == GPU else 'CPU'}, {variant}"}
    # In notes, a colon would make a figure and a semicolon end it.
    note = f"not on the GPU ({trouble.replace(':', ',').replace(';', ',')})" if trouble else ""
    rows = []
    for count, images in made.items():
        name = _name(count)
        found = _score(images, references)
        rows.append(row("path tracing", name, found.figures | on, note, decode_ms=times[name], psnr=found.mean))
        if _DENOISED in times:
            found, total = _score([denoise(image) for image in images], references), times[name] + times[_DENOISED]
            option = f"{name}, {_DENOISED}" + (" on the CPU" if variant == GPU else "")
            rows.append(row("path tracing", option, found.figures | on, note, decode_ms=total, psnr=found.mean))
    return rows


def _name(count: int) -> str:
    return "1 sample" if count == 1 else f"{count} samples"


def _traced(tracer: PathTracer, samples: int) -> Callable[[], object]:
    return lambda: tracer(samples)


def _cleaned(image: np.ndarray) -> Callable[[], object]:
    return lambda: denoise(image)


def _score(images: Sequence[np.ndarray], references: Sequence[torch.Tensor]) -> Scores:
    return score([to_srgb(torch.from_numpy(image)) for image in images], references)
