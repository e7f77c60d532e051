"""`wlm smoke`: make samples, train the network that lightmaps come from, use it, measure it."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
    escape,
    exclusive,
    note,
    number,
    quiet_warp,
    running,
    show,
    table,
    write_json,
)
from wlm.cli.options import CheckpointEvery, Device, PageFile, ReportFile, Resume, Seed, output_option
from wlm.cli.smoke_options import Input, SmokeOptions, with_smoke, write_lightmaps
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.camera import Camera
    from wlm.smoke.evaluation import Comparison
    from wlm.smoke.lightmaps import SixWay
    from wlm.smoke.model import SmokeModel

_MARCH = 130  # steps of `predict --coarse` along the longest edge

_Network = Annotated[
    Path | None,
    typer.Argument(metavar="NETWORK", help="A file that train wrote; default the one that comes with wlm."),
]


def register(app: typer.Typer) -> None:
    """Adds the commands to `wlm smoke`."""
    for command in (train, predict, evaluate):
        app.command()(command)


@exclusive
def train(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="fast, paper, or a YAML file.")],
    output: Annotated[Path, output_option("NETWORK", "The .safetensors to write.")],
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="After which it stops and can be resumed; default at its end.")
    ] = None,
    resume: Resume = False,
    checkpoint_every: CheckpointEvery = 30.0,
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Train a network on smoke that is simulated as it is needed, and keep the best of its validations.

    The training is kept in NETWORK.partial from time to time, and by Ctrl-C and SIGTERM; the same command with --resume
    goes on exactly. The curves are in NETWORK.csv.
    """
    check_output(output, ".safetensors")
    quiet_warp()
    from wlm.formats.checkpoint import SUFFIX
    from wlm.smoke.fit import train as fit
    from wlm.smoke.network.settings import Profile

    settings = Profile.load(profile)
    checkpoint = Path(f"{output}{SUFFIX}")
    if resume and not checkpoint.exists() and not output.exists():
        note(f"{checkpoint}: there is nothing to resume; starting at step 0")
    options = {"seed": seed, "device": device, "minutes": minutes, "resume": resume}
    options["checkpoint_every"] = checkpoint_every
    with running("train", checkpoint) as progress:
        training = fit(settings, output, progress=progress, **options)
    if not training.finished:
        note(f"out of time at step {training.steps}: the same command with --resume goes on from {checkpoint}")
    rows = table(f"{output}: {settings.name}", ["", "value"])
    rows.add_row("steps", f"{training.steps:,} of {settings.training.total:,}")
    rows.add_row("steps skipped", f"{training.skipped:,}")
    rows.add_row("best validation, dB", number(training.best, ".2f"))
    if training.score is not None:
        rows.add_row("last validation, dB", number(training.score.psnr, ".2f"))
        rows.add_row("its flicker over the reference's", number(training.score.flicker_ratio, ".3f"))
    rows.add_row("seconds", f"{training.seconds:.1f}")
    if training.model is not None:
        rows.add_row("bytes", f"{output.stat().st_size:,}")
    show(rows)


@with_smoke
@exclusive
def predict(
    smoke: Input,
    output: Annotated[Path, output_option("OUT", "A .exr, or of frames a folder.")],
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
    seed: Seed = 0,
    resume: Resume = False,
) -> None:
    """Make six-way lightmaps by the network, from a guiding map as it was trained with: what bake makes, sooner.

    What is written is as of bake: shade and flipbook take it. Of frames, those done are kept when it is stopped; the
    same command with --resume makes the others.
    """
    if coarse and network is not None:
        raise WlmError("--coarse: expected no --network beside it")
    if step is not None and not coarse:
        raise WlmError("--step: expected --coarse beside it: a network looks as it was trained to")
    quiet_warp()
    from wlm.smoke.codec import open_network

    frames = options.open(smoke)
    if coarse:
        made = {"made": "coarse", "step": step, "seed": seed}
        make = _coarse(step, seed)
    else:
        model = open_network(network)
        made = {"made": "network", "of": dict(model.summary), "seed": seed}
        make = _predicted(model, seed, frames.device)
    write_lightmaps(frames, options.camera(frames), output, make, made, resume=resume)


def evaluate(
    network: _Network = None,
    smoke: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE", help="A .npz, .nvdb or .vdb volume to score; repeat for more."),
    ] = None,
    resolution: Annotated[int, typer.Option(min=8, max=4096, help="Pixels along an image's edges.")] = 512,
    cells: Annotated[
        int | None, typer.Option(min=16, max=512, help="Of the air along the box's edges; default as it was trained.")
    ] = None,
    json_path: ReportFile = None,
    html_path: PageFile = None,
    device: Device = "cpu",
) -> None:
    """Measure a network on smoke that it was not trained on.

    The smoke is of sequences by which no network was chosen either, at half, once and twice its density, and the
    volumes given. PSNR is of the lightmaps in sRGB; flicker is what changes from frame to frame beside the motion, over
    the same of the reference.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.smoke.codec import open_network, shipped
    from wlm.smoke.evaluation import compare

    device, network = check_device(device), network or shipped()
    model = open_network(network)
    sizes = {"resolution": resolution, "cells": model.dataset.cells if cells is None else cells}
    settings = model.dataset.model_copy(update=sizes)
    with running("evaluate") as progress:
        comparisons = compare(model, settings, smoke or (), device=device, progress=progress)
    if json_path is not None:
        facts = {"network": _facts(network, model), "device": device, **sizes}
        write_json(json_path, facts | {"sets": [comparison.to_json() for comparison in comparisons]})
    if html_path is not None:
        from wlm.view.reports import smoke_report

        smoke_report(html_path, network.stem, model, comparisons)
    _show_comparisons(network, comparisons)


def _coarse(step: float | None, seed: int) -> "Callable[[DensityVolume, Camera], SixWay]":
    """Makes lightmaps by a march whose nodes are as far apart as its steps."""
    from wlm.smoke.march.coarse import bake_coarse
    from wlm_kernels.smoke.settings import March

    def make(volume: "DensityVolume", camera: "Camera") -> "SixWay":
        voxels = max(volume.shape) / _MARCH if step is None else step
        return bake_coarse(volume, camera, March(voxels, seed=seed))

    return make


def _predicted(model: "SmokeModel", seed: int, device: str) -> "Callable[[DensityVolume, Camera], SixWay]":
    """Makes lightmaps by a network; notes once where little of it is taken."""
    from wlm.smoke.network.prediction import SmokePredictor

    predictor, first = SmokePredictor(model, device), True

    def make(volume: "DensityVolume", camera: "Camera") -> "SixWay":
        nonlocal first
        six = predictor(volume, camera, seed)
        if first and (line := predictor.note()):
            note(line)
        first = False
        return six

    return make


def _facts(path: Path, model: "SmokeModel") -> dict[str, Any]:
    """The network, and what its file says of its training."""
    from wlm.smoke.model import parameter_count

    names = ("profile", "seed", "steps", "seconds", "device")
    training = {name: model.summary[name] for name in names if name in model.summary}
    settings = model.settings.model_dump(mode="json")
    return {"name": path.stem, **settings, "parameters": parameter_count(model.network), **training}


def _show_comparisons(path: Path, comparisons: "list[Comparison]") -> None:
    from wlm.smoke.network.planes import PLANES

    scores = table(str(path), ["smoke", "method", "PSNR", "lowest", "highest", "flicker"], text=["method"])
    planes = table(f"{path}: PSNR of each plane", ["smoke", "method", *PLANES], text=["method"])
    for comparison in comparisons:
        smoke = escape(comparison.name)
        for name, score in comparison.methods.items():
            decibels = (number(value, ".2f") for value in (score.psnr, score.lowest, score.highest))
            scores.add_row(smoke, name, *decibels, number(score.flicker_ratio, ".3f"))
            planes.add_row(smoke, name, *(number(value, ".2f") for value in score.planes))
            smoke = ""
        scores.add_section()
        planes.add_section()
    show(scores)
    show(planes)
    for comparison in comparisons:
        if comparison.half_loss is not None:
            note(f"{comparison.name}: half floats lose {comparison.half_loss:.3f} dB")
