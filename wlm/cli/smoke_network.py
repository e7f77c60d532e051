"""`wlm smoke`: make samples, train the network that lightmaps come from, use it, measure it, export it."""

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
    deferred_interrupt,
    escape,
    note,
    number,
    progress_bar,
    quiet_warp,
    show,
    table,
    write_json,
)
from wlm.cli.options import Device
from wlm.cli.smoke_options import Input, SmokeOptions, with_smoke, write_lightmaps
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.camera import Camera
    from wlm.smoke.evaluation import Comparison
    from wlm.smoke.lightmaps import SixWay
    from wlm.smoke.model import SixWayNetwork

__all__ = ["register"]

_POOL, _SHEET = "pool.safetensors", "sheet.png"
_SUFFIX = ".safetensors"

_MARCH = 130  # steps of `predict --coarse` along the longest edge

_Network = Annotated[
    Path | None,
    typer.Argument(metavar="NETWORK", help="A file that train wrote; default the one that comes with wlm."),
]


def register(app: typer.Typer) -> None:
    """Adds the commands to `wlm smoke`."""
    for command in (train, predict, evaluate, export, dataset):
        app.command()(command)


def train(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="fast, 16, 24, 32, paper, or a YAML file.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="NETWORK", help="The .safetensors to write.")],
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="After which it stops and can be resumed; default at its end.")
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted training of NETWORK.")] = False,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="One seed gives one result on one device.")] = 0,
    device: Device = "cpu",
) -> None:
    """Train a network on smoke that is simulated as it is needed, and keep the best of its validations.

    Ctrl-C keeps the training in NETWORK.partial; the same command with --resume goes on exactly. The curves are in
    NETWORK.csv.
    """
    check_output(output, _SUFFIX)
    quiet_warp()
    from wlm.formats.checkpoint import SUFFIX
    from wlm.smoke.fit import Progress, load_profile
    from wlm.smoke.fit import train as fit
    from wlm.smoke.learn.dataset import make_pool, make_validation

    settings = load_profile(profile)
    kept = Path(f"{output}{SUFFIX}")
    if resume and not kept.exists() and not output.exists():
        note(f"{kept}: there is nothing to resume; starting at step 0")
    at, begun = 0, False
    try:
        with deferred_interrupt() as check_interrupt, progress_bar("train") as bar:

            def validated(*_: object) -> None:
                check_interrupt()

            def made(*_: object) -> None:
                # Between two sequences of a pool nothing is lost: what came before the pool is kept already.
                nonlocal begun
                begun = True
                check_interrupt()

            def report(now: Progress) -> None:
                nonlocal at
                at = now.step
                bar(now.step, now.steps, f"PSNR {number(now.psnr, '.2f')} dB, loss {number(now.loss, '.3g')}")
                check_interrupt()

            result = fit(
                output,
                settings,
                make_pool=partial(make_pool, progress=made),
                make_validation=partial(make_validation, progress=validated),
                seed=seed,
                device=device,
                minutes=minutes,
                resume=resume,
                progress=report,
            )
    except KeyboardInterrupt:
        if begun or (resume and kept.exists()):
            told = f"at step {at}" if at else "before another step"
            note(f"stopped {told}: the same command with --resume goes on from {kept}")
        raise
    if not result.finished:
        note(f"out of time at step {result.steps}: the same command with --resume goes on from {kept}")
    rows = table(f"{output}: {settings.name}", ["", "value"])
    rows.add_row("steps", f"{result.steps:,} of {settings.training.total:,}")
    rows.add_row("steps left out", f"{result.skipped:,}")
    rows.add_row("best validation, dB", number(result.best, ".2f"))
    if result.score is not None:
        rows.add_row("last validation, dB", number(result.score.psnr, ".2f"))
        rows.add_row("its flicker over the reference's", number(result.score.flicker_ratio, ".3f"))
    rows.add_row("seconds", f"{result.seconds:.1f}")
    if output.is_file():
        rows.add_row("bytes", f"{output.stat().st_size:,}")
    show(rows)


@with_smoke
def predict(
    smoke: Input,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="A .exr, or of frames a folder.")],
    options: SmokeOptions,
    network: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A network that train wrote; default the one that wlm has.")
    ] = None,
    coarse: Annotated[bool, typer.Option("--coarse", help="By a march alone, without a network.")] = False,
    step: Annotated[
        float | None,
        typer.Option(
            min=0.01,
            max=1000.0,
            metavar="H",
            help=f"Voxels, of the march of --coarse; default 1/{_MARCH} of the longest edge.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the march's jitter.")] = 0,
) -> None:
    """Make six-way lightmaps by the network, from a guiding map as it was trained with: what bake makes, sooner.

    What is written is as of bake: shade and flipbook take it.
    """
    if coarse and network is not None:
        raise WlmError("--coarse: expected no --network beside it")
    if step is not None and not coarse:
        raise WlmError("--step: expected --coarse beside it: a network looks as it was trained to")
    quiet_warp()
    frames = options.open(smoke)
    make = _coarse(step, seed) if coarse else _predicted(network, seed, frames.device)
    write_lightmaps(frames, options.camera(frames), output, make)


def evaluate(
    network: _Network = None,
    smoke: Annotated[
        list[Path] | None, typer.Option(metavar="FILE", help="A .npz or .nvdb volume to look at too; repeat for more.")
    ] = None,
    resolution: Annotated[int, typer.Option(min=8, max=4096, help="Pixels along an image's edges.")] = 512,
    cells: Annotated[
        int | None, typer.Option(min=16, max=512, help="Of the air along the box's edges; default as it was trained.")
    ] = None,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")] = None,
    device: Device = "cpu",
) -> None:
    """Measure a network on smoke that it hasn't learned from, beside a coarse march and a flip book.

    The smoke is of sequences by which no network was chosen either, at half, once and twice its density, and the
    volumes given. PSNR is of the lightmaps in sRGB; flicker is what changes from frame to frame beside the motion, over
    the same of the reference.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.smoke.codec import load_network, settings_of, shipped
    from wlm.smoke.evaluation import evaluate_all

    device, network = check_device(device), network or shipped()
    loaded, summary = load_network(network, device=device)
    settings = settings_of(network, summary)
    changed = {"resolution": resolution, "cells": settings.cells if cells is None else cells}
    with progress_bar("evaluate") as bar:
        found = evaluate_all(loaded, settings.model_copy(update=changed), smoke or (), device=device, progress=bar)
    if json_path is not None:
        facts = {"network": _described(network, loaded, summary), "device": device, **changed}
        write_json(json_path, facts | {"sets": [one.to_json() for one in found]})
    _show_evaluation(network, found)


def export(
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE.onnx", help="The file to write.")],
    network: _Network = None,
    resolution: Annotated[int, typer.Option(min=1, max=16384, help="Pixels along the image's edges.")] = 512,
) -> None:
    """Write a network as ONNX: encoded guiding maps to encoded lightmaps, of one size, in float32."""
    check_output(output, ".onnx")
    quiet_warp()
    from wlm.smoke.codec import export_onnx, load_network, shipped
    from wlm.smoke.planes import GUIDES, PLANES

    network = network or shipped()
    loaded, _ = load_network(network)
    size = export_onnx(loaded, output, resolution, resolution)
    rows = table(str(network), ["", "planes"], text=["planes"])
    rows.add_row("guide", " ".join(GUIDES[loaded.settings.guide]))
    rows.add_row("lightmaps", " ".join(PLANES))
    rows.add_row(escape(str(output)), f"{size:,} bytes, {resolution} x {resolution} pixels")
    show(rows)


def dataset(
    settings_file: Annotated[
        Path, typer.Argument(metavar="SETTINGS", help="A YAML file of dataset settings, each with a default.")
    ],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="The folder to write to.")],
    seed: Annotated[int, typer.Option(min=0, help="Of all rounds.")] = 0,
    round_number: Annotated[int, typer.Option("--round", min=0, help="Which round of samples.")] = 0,
    validation: Annotated[
        bool, typer.Option("--validation", help="The validation's samples, which no round has.")
    ] = False,
    columns: Annotated[int, typer.Option(min=1, max=64, help="Samples in the contact sheet.")] = 12,
    device: Device = "cpu",
) -> None:
    """Simulate scenes drawn at random, and write the samples that a network would learn from.

    DIR gets pool.safetensors, and sheet.png with guiding maps, lightmaps and motion.
    """
    quiet_warp()
    from wlm.config import load_settings
    from wlm.interop import check_device
    from wlm.smoke.learn.dataset import STAGES, DatasetSettings, make_pool, make_validation
    from wlm.smoke.learn.pool_file import save_pool
    from wlm.view.smoke_pool import pool_sheet

    settings, device = load_settings(DatasetSettings, settings_file), check_device(device)
    try:
        output.mkdir(exist_ok=True)
    except OSError as error:
        raise WlmError(f"{output}: cannot write there: {error.strerror or error}") from error
    total = settings.validation_sequences if validation else settings.sequences
    figures: dict[str, float] = {}
    with progress_bar("dataset") as bar:

        def report(done: int, found: dict[str, float]) -> None:
            figures.update(found)
            bar(done, total, f"{found['samples']:.0f} samples")

        if validation:
            pool = make_validation(settings, device, progress=report)
        else:
            pool = make_pool(settings, seed=seed, round=round_number, device=device, progress=report)
    if not len(pool):
        raise WlmError(f"{settings_file}: expected frames with smoke, found none: use a longer warmup")
    source = f"validation-{settings.validation_seed}" if validation else f"seed-{seed}-round-{round_number}"
    size = save_pool(output / _POOL, pool, settings, source)
    shown = pool_sheet(output / _SHEET, pool, columns=columns)
    rows = table(f"{output}: {source}", ["", "value"])
    rows.add_row("samples", f"{len(pool):,}")
    rows.add_row("pixels", f"{settings.resolution} x {settings.resolution}")
    rows.add_row("voxels", " x ".join([str(settings.cells * settings.refine)] * 3))
    rows.add_row("scenes that blew up", f"{figures['skipped']:.0f}")
    rows.add_row("samples without smoke, left out", f"{figures['dropped']:.0f}")
    for stage in STAGES:
        rows.add_row(f"seconds: {stage}", f"{figures[stage]:.3g}")
    rows.add_row(escape(str(output / _POOL)), f"{size:,} bytes")
    show(rows)
    note(f"{output / _SHEET}: samples {', '.join(map(str, shown))}")


def _coarse(step: float | None, seed: int) -> "Callable[[DensityVolume, Camera], SixWay]":
    """Makes lightmaps by a march whose nodes are as far apart as its steps."""
    from wlm.smoke.coarse import march
    from wlm_kernels.smoke.settings import March

    def make(volume: "DensityVolume", camera: "Camera") -> "SixWay":
        voxels = max(volume.shape) / _MARCH if step is None else step
        return march(volume, camera, March(voxels, seed=seed))

    return make


def _predicted(path: Path | None, seed: int, device: str) -> "Callable[[DensityVolume, Camera], SixWay]":
    """Makes lightmaps by a network; notes once where it wasn't trained for the image's size."""
    from wlm.smoke.prediction import SmokePredictor

    predictor, first = SmokePredictor(path, device), True

    def make(volume: "DensityVolume", camera: "Camera") -> "SixWay":
        nonlocal first
        if first and (warning := predictor.warning(volume, camera)):
            note(warning)
        first = False
        return predictor(volume, camera, seed)

    return make


def _described(path: Path, network: "SixWayNetwork", summary: dict[str, Any]) -> dict[str, Any]:
    """Which network it is, and how it was trained as far as its file says."""
    from wlm.smoke.model import parameter_count

    known = {name: summary[name] for name in ("profile", "seed", "steps", "seconds", "device") if name in summary}
    settings = network.settings.model_dump(mode="json")
    return {"name": path.stem, **settings, "parameters": parameter_count(network), **known}


def _show_evaluation(path: Path, found: "list[Comparison]") -> None:
    from wlm.smoke.planes import PLANES

    scores = table(str(path), ["smoke", "method", "PSNR", "lowest", "highest", "flicker"], text=["method"])
    planes = table(f"{path}: PSNR of each plane", ["smoke", "method", *PLANES], text=["method"])
    for one in found:
        for place, (name, method) in enumerate(one.methods.items()):
            first = ("" if place else escape(one.name), name)
            decibels = (number(value, ".2f") for value in (method.psnr, method.lowest, method.highest))
            scores.add_row(*first, *decibels, number(method.flicker_ratio, ".3f"))
            planes.add_row(*first, *(number(value, ".2f") for value in method.planes))
        scores.add_section()
        planes.add_section()
    show(scores)
    show(planes)
    for one in found:
        if one.half_loss is not None:
            note(f"{one.name}: half floats lose {one.half_loss:.3f} dB")
