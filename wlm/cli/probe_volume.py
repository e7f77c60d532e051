"""`wlm probe walk` and `volume`: the light of probes as a viewer gets it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import check_output, escape, number, quiet_warp, running, show, table, write_json
from wlm.cli.options import Device, ModelFile, ReportFile, output_option
from wlm.errors import WlmError

if TYPE_CHECKING:
    import numpy as np

    from wlm.probe import Decoder, ProbeModel, ProbeSet, Volume
    from wlm.probe.views import ViewScore

_Block = Annotated[float | None, typer.Option(help="Side of the finest blocks; default from the probes' spacing.")]
_Key = Annotated[str | None, typer.Option(help="Name of the values in PROBES; default the only ones.")]
_AXES = ("x", "y", "z")


def register(app: typer.Typer) -> None:
    """Adds the commands of the volume to those of probes."""
    app.command()(walk)
    app.command()(volume)


def walk(
    file: ModelFile,
    probes_path: Annotated[
        Path | None,
        typer.Argument(metavar="PROBES", help="What was compressed, to compare with; default the places in FILE.wlm."),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Frames of a loop through the scene; default a tenth of a block each.")
    ] = None,
    path: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Viewpoints: a JSON list of x, y, z, or `position` of a .npz.")
    ] = None,
    block: _Block = None,
    eye: Annotated[
        float | None, typer.Option(help="Height of the eyes above the ground; default an 80th of the scene's length.")
    ] = None,
    up: Annotated[str, typer.Option(help="The axis that points up: x, y or z.")] = "y",
    budget: Annotated[int | None, typer.Option(help="Blocks decoded in a frame; default 64.")] = None,
    key: _Key = None,
    json_path: ReportFile = None,
    device: Device = "cpu",
) -> None:
    """Walk through the scene with a cascaded lighting volume: what a frame costs, covers and gets wrong.

    With PROBES the light that is read is scored against theirs, and walls keep light apart where PROBES have normals.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    if up not in _AXES:
        raise WlmError(f"--up: expected x, y or z, got {up}")
    quiet_warp()
    from wlm.probe import load_positions
    from wlm.probe.volume.walk import STEP, camera_path, loop_frames, settle, summary, walk
    from wlm.system import load

    model = load(file, "probe")
    decoder = model.decoder(device)
    volume, original = _volume(file, model, decoder, probes_path, key, block, budget)
    position = volume.position
    if path is None:
        axis, lit = _AXES.index(up), position[volume.numbers]
        if frames is None:
            frames = loop_frames(lit, STEP * volume.sizes[0], axis)
        viewpoints = camera_path(lit, frames, eye, axis)
    else:
        viewpoints = load_positions(path)
    first = settle(volume, viewpoints[0])
    peak = None if original is None else float(original.max()) - float(original.min())
    with running("walk") as progress:
        figures = summary(walk(volume, viewpoints, original=original, progress=progress), peak)
    figures |= {"first_frames": first, "volume_bytes": volume.memory_bytes, "model_bytes": decoder.device_bytes}
    if json_path is not None:
        settings = {"device": decoder.device, "sizes": list(volume.sizes), "side": volume.side, "budget": volume.budget}
        write_json(json_path, {"name": model.name} | settings | figures)
    _show_walk(file, figures)


def volume(
    file: ModelFile,
    output: Annotated[Path, output_option("DIR", "The folder to write to.")],
    probes_path: Annotated[
        Path | None, typer.Argument(metavar="PROBES", help="What was compressed; default the places in FILE.wlm.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Where the viewer stands; default the middle of the probes.")
    ] = None,
    block: _Block = None,
    key: _Key = None,
    device: Device = "cpu",
) -> None:
    """Write the cascaded volume round a viewer as buffers and a page table, with shaders that read them."""
    quiet_warp()
    from wlm.export import export
    from wlm.probe.volume.bundle import volume_bundle
    from wlm.probe.volume.walk import settle
    from wlm.system import load

    model = load(file, "probe")
    made, _ = _volume(file, model, model.decoder(device), probes_path, key, block, None)
    lit = made.position[made.numbers]
    settle(made, (lit.min(0) + lit.max(0)) / 2 if at is None else _point(at))
    rows = table(str(output), ["file", "bytes"])
    for path in export(volume_bundle(made), output):
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    show(rows)


def _point(text: str) -> "np.ndarray":
    import numpy as np

    try:
        point = np.array([float(word) for word in text.split(",")])
    except ValueError:
        point = np.zeros(0)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise WlmError(f"--at: expected three numbers as x,y,z, got {text}")
    return point


def _volume(
    file: Path,
    model: "ProbeModel",
    decoder: "Decoder",
    probes_path: Path | None,
    key: str | None,
    block: float | None,
    budget: int | None,
) -> "tuple[Volume, np.ndarray | None]":
    """A volume of a model's probes, and the light that was compressed, where it is given."""
    from wlm.probe.places import probes_of
    from wlm.probe.volume.cascade import BUDGET, Volume

    if probes_path is None:
        live = ~model.dead if len(model.dead) else None
        position, original, normal = model.stored_positions(), None, None
    else:
        position, original, live, normal = probes_of(model, probes_path, key)
    if probes_path is not None and not model.has_probes_at(position):
        raise WlmError(f"{probes_path}: expected the {model.probes} probes that {file} was made of, in their order")
    budget = BUDGET if budget is None else budget
    light = decoder.light(position)
    return Volume(position, light, live=live, normal=normal, block=block, budget=budget), original


def walk_scores(model: "ProbeModel", probes: "ProbeSet", device: str) -> dict[str, dict[str, Any]]:
    """What is read along a walk, from the probes as they were and from the model's."""
    from wlm.probe.volume.light import StoredLight
    from wlm.probe.volume.walk import score_volume

    decoder = model.decoder(device)
    lights = {
        "lossless": StoredLight(probes.values, decoder.device),
        "decoded": decoder.light(probes.position),
    }
    with running("walk") as progress:
        return {name: score_volume(probes, light, progress=progress) for name, light in lights.items()}


def show_walk_scores(walked: dict[str, dict[str, Any]]) -> None:
    """Shows the scores of walks; nothing without any."""
    if not walked:
        return
    columns = ["light", "read near, dB", "decoded there, dB", "read farther away, dB", "blocks a frame"]
    rows = table("through the volume", columns)
    for name, figures in walked.items():
        decibels = (number(figures[key], ".2f") for key in ("psnr", "light_psnr", "far_psnr"))
        rows.add_row(name, *decibels, number(figures["updated"]["mean"], ".1f"))
    show(rows)


def score_seen(
    model: "ProbeModel", probes: "ProbeSet", views: int, mesh: Path | None, device: str
) -> "list[ViewScore]":
    """Scores pictures under the decoded light, 50 of them where no number is given."""
    from wlm.formats.geometry import read_geometry
    from wlm.probe.views import VIEWS, score_views

    geometry = None if mesh is None else read_geometry(mesh, with_uv=False)
    decoded = model.decoder(device).decode_probes(probes.position)
    with running("views") as progress:
        return score_views(probes, decoded, geometry, views=views or VIEWS, device=device, progress=progress)


def show_seen(scores: "list[ViewScore]") -> None:
    """Shows the scores of pictures; nothing without any."""
    if not scores:
        return
    rows = table("pictures under the light", ["", "light", "views", "MSE", "PSNR dB", "SSIM", "FLIP"])
    for score in scores:
        figures = (number(score.mse, ".3g"), number(score.psnr, ".2f"), number(score.ssim, ".4f"))
        rows.add_row(score.drawn, score.light, str(score.views), *figures, number(score.flip, ".4f"))
    show(rows)


def _show_walk(file: Path, figures: dict[str, Any]) -> None:
    rows = table(f"{file}: {figures['frames']} frames", ["per frame", "mean", "95%", "worst"])
    counts = {
        "blocks decoded": "updated",
        "blocks from the pool": "cached",
        "blocks waiting": "left",
        "probes": "probes",
    }
    times = {"update ms": "update_ms", "read ms": "read_ms"}
    for names, form in ((counts, ".1f"), (times, ".3f"), ({"error": "rmse", "light": "rms"}, ".4g")):
        for name, key in names.items():
            values = figures[key] or {}
            rows.add_row(name, *(number(values.get(part), form) for part in ("mean", "p95", "max")))
        rows.add_section()
    coverage = figures["coverage"] or {}
    rows.add_row("covered", *(number(coverage.get(part), ".2%") for part in ("mean", "p5", "min")))
    rows.add_section()
    names = {"read near, dB": "psnr", "decoded there, dB": "light_psnr", "read farther away, dB": "far_psnr"}
    for name, key in names.items():
        if key in figures:
            rows.add_row(name, number(figures[key], ".2f"))
    rows.add_row("frames until all is there", str(figures["first_frames"]))
    rows.add_row("volume, bytes", f"{figures['volume_bytes']:,}")
    rows.add_row("model, bytes", f"{figures['model_bytes']:,}")
    show(rows)
