"""`wlm smoke train` and `export-onnx`, and `wlm evaluate` and `info` for networks."""

from dataclasses import asdict
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli import console
from wlm.cli import options as opt
from wlm.cli.settings import Generated, with_settings

if TYPE_CHECKING:
    from wlm.smoke.model import SmokeModel


_Network = Annotated[
    Path | None, typer.Argument(metavar="NETWORK", help="Network that wlm smoke train wrote; default the shipped one.")
]


def register(app: typer.Typer) -> None:
    """Adds the commands `train`, `export-onnx` and `export-three` to the group `wlm smoke`."""
    app.command(cls=Generated)(train)
    app.command("export-onnx")(export_onnx)
    app.command("export-three")(export_three)


@with_settings("wlm.smoke:Profile")
@opt.with_options
@console.exclusive
def train(
    profile: Annotated[str, typer.Argument(metavar="PROFILE", help="Settings: fast, paper, or a YAML file.")],
    output: Annotated[Path, opt.output_option("NETWORK", "The .safetensors to write.")],
    settings: dict[str, Any],
    work: opt.FitOptions,
    minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Minutes after which the training stops; --resume continues.")
    ] = None,
) -> None:
    """Train a network on smoke simulated during the training, and keep the state with the best validation.

    --workers and --cluster simulate sequences side by side; the network is trained in this process.
    The state is saved in NETWORK.partial from time to time and on Ctrl-C or SIGTERM; repeat the command with --resume
    to continue exactly. NETWORK.csv has the loss curves.
    """
    console.begin(output, ".safetensors")
    from wlm.formats.checkpoint import SUFFIX
    from wlm.smoke import Profile
    from wlm.smoke.fit import train as fit

    checked = Profile.load(profile).override(settings, "--")
    checkpoint = Path(f"{output}{SUFFIX}")
    if work.resume and not checkpoint.exists() and not output.exists():
        console.note(f"{checkpoint}: there is nothing to resume; starting at step 0")
    with console.running("train", checkpoint) as progress:
        training = fit(checked, output, progress=progress, minutes=minutes, **asdict(work))
    if not training.finished:
        console.note(
            f"out of time at step {training.steps}: repeat the command with --resume to continue from {checkpoint}"
        )
    facts: dict[str, Any] = {
        "steps": f"{training.steps:,} of {checked.training.total:,}",
        "skipped steps": training.skipped,
        "best validation PSNR, dB": training.best,
    }
    if training.score is not None:
        facts["last validation PSNR, dB"] = training.score.psnr
        facts["its flicker relative to the reference"] = training.score.flicker_ratio
    facts["seconds"] = f"{training.seconds:.1f}"
    if training.model is not None:
        facts["bytes on disk"] = output.stat().st_size
    console.show_facts(f"{output}: {checked.name}", facts)


def export_onnx(
    output: Annotated[Path, opt.output_option("NETWORK.onnx", "The file to write.")],
    network: _Network = None,
    resolution: Annotated[
        int, typer.Option(min=1, max=16384, help="Height and width of the network's images in pixels.")
    ] = 512,
) -> None:
    """Write a network as ONNX: from encoded guiding maps to encoded lightmaps, of a fixed size, in float32."""
    console.begin(output, ".onnx")
    from wlm.smoke.codec import open_network, shipped
    from wlm.smoke.network import onnx_file
    from wlm.smoke.network.planes import GUIDES, PLANES

    network = network or shipped()
    model = open_network(network)
    size = onnx_file.export_onnx(model, output, height=resolution, width=resolution)
    facts = {"input planes": " ".join(GUIDES[model.settings.guide]), "output planes": " ".join(PLANES)}
    console.show_facts(str(output), facts | {"image": f"{resolution} x {resolution} pixels", "bytes": size})


def export_three(
    output: Annotated[Path, opt.output_option("FOLDER", "The folder to write.")], network: _Network = None
) -> None:
    """Write a kit for three.js as a folder, which lights smoke live by a network."""
    console.quiet_warp()
    from wlm.export import export
    from wlm.smoke.codec import open_network

    console.show_files(output, export(open_network(network), output, "three"))


def evaluate(
    network: opt.ModelFile,
    resolution: Annotated[int, typer.Option(min=8, max=4096, help="Edge of the test images in pixels.")] = 512,
    cells: Annotated[
        int | None,
        typer.Option(min=16, max=512, help="Air cells along an edge of the simulated box; default as trained."),
    ] = None,
    json_path: opt.ReportFile = None,
    device: opt.Device = "cpu",
) -> None:
    """Measure a network on simulated smoke that it was not trained on.

    PSNR compares lightmaps in sRGB. Flicker is the change between frames that motion does not explain, relative to the
    reference's flicker.
    """
    console.begin(json_path, ".json")
    from wlm.interop import check_device
    from wlm.smoke.codec import open_network
    from wlm.smoke.evaluation import evaluate
    from wlm.smoke.network.planes import PLANES

    device = check_device(device)
    model = open_network(network)
    sizes = {"resolution": resolution, "cells": model.dataset.cells if cells is None else cells}
    # Almost empty frames are not scored.
    settings = model.dataset.model_copy(update=sizes | {"kept_empty": 0.0})
    with console.running("evaluate") as progress:
        report = evaluate(model, settings, device=device, progress=progress)
    if json_path is not None:
        content = {"network": _facts(network, model), "device": device, **sizes}
        console.write_json(json_path, content | report.to_json())
    facts: dict[str, Any] = {
        "images": 2 * report.samples,
        "PSNR, dB": report.psnr,
        "lowest, dB": report.lowest,
        "highest, dB": report.highest,
        "flicker relative to the reference": report.flicker_ratio,
    }
    if not isnan(report.guide_psnr):
        facts["PSNR of its guide, the coarse march, dB"] = report.guide_psnr
    planes = zip(PLANES, report.planes, strict=True)
    console.show_facts(str(network), facts | {f"PSNR of {name}, dB": value for name, value in planes})


def info(file: opt.ModelFile, as_json: opt.AsJson = False) -> None:
    """Show the shape of a network and facts about its training."""
    console.quiet_warp()
    from wlm.formats.artifact import read_artifact
    from wlm.smoke.codec import open_network

    facts = _facts(file, open_network(file)) | {"bytes_on_disk": read_artifact(file).file_bytes}
    if as_json:
        console.show_json(facts)
    else:
        console.show_facts(str(file), facts)


def _facts(path: Path, model: "SmokeModel") -> dict[str, Any]:
    """Returns the shape of a network and the facts about its training that its file states."""
    from wlm.smoke.model import parameter_count

    names = ("profile", "seed", "steps", "seconds", "device")
    training = {name: model.summary[name] for name in names if name in model.summary}
    settings = model.settings.model_dump(mode="json")
    return {"name": path.stem, **settings, "parameters": parameter_count(model.network), **training}
