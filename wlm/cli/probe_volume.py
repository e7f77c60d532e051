"""`wlm probe volume`: the cascaded lighting volume around a viewer, and its scores for `wlm evaluate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import check_output, number, quiet_warp, running, show, show_files, table, write_json
from wlm.cli.options import Device, Key, ModelFile, ReportFile
from wlm.errors import WlmError

if TYPE_CHECKING:
    import numpy as np

    from wlm.probe import Decoder, ProbeModel, ProbeSet, Volume
    from wlm.probe.views import ViewScore

_AXES = ("x", "y", "z")
_DECIBELS = {
    "sampled near the viewer, dB": "psnr",
    "decoded at the same points, dB": "light_psnr",
    "sampled farther away, dB": "far_psnr",
}

app = typer.Typer(help="Light probes: the cascaded volume that a renderer samples.")


@app.callback()
def _group() -> None:
    """Light probes: the cascaded volume that a renderer samples."""


@app.command()
def volume(
    file: ModelFile,
    probes_path: Annotated[
        Path | None,
        typer.Argument(metavar="PROBES", help="The original probes, to compare with; default the stored positions."),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", metavar="DIR", help="Write the volume at --at instead of walking.")
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Viewer of --output; default the middle of the probes.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(help="Frames of the walk through the scene; default a step of a tenth of a block.")
    ] = None,
    path: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Viewpoints of the walk: a JSON list of x, y, z, or `position` of a .npz."),
    ] = None,
    block: Annotated[
        float | None, typer.Option(help="Side of the finest blocks; default from the distances of the probes.")
    ] = None,
    eye: Annotated[
        float | None, typer.Option(help="Height of the eyes; default 1/80 of the length of the scene.")
    ] = None,
    up: Annotated[str, typer.Option(help="Axis that points up: x, y or z.")] = "y",
    budget: Annotated[int | None, typer.Option(help="Blocks decoded per frame; default 64.")] = None,
    key: Key = None,
    json_path: ReportFile = None,
    device: Device = "cpu",
) -> None:
    """Walk through the scene with a cascaded volume and report cost, coverage and error per frame.

    With PROBES the sampled light is compared with theirs, and normals of PROBES keep light from passing through walls.
    With --output the volume around one viewer is written instead: buffers and an index, with shaders that read them.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    if up not in _AXES:
        raise WlmError(f"--up: expected x, y or z, got {up}")
    if at is not None and output is None:
        raise WlmError("--at: has no meaning without --output")
    quiet_warp()
    from wlm.probe.volume.walk import settle
    from wlm.system import load

    model = load(file, "probe")
    decoder = model.decoder(device)
    made, original = _volume(file, model, decoder, probes_path, key, block, budget)
    lit = made.position[made.numbers]
    if output is not None:
        from wlm.export import export
        from wlm.probe.volume.bundle import volume_bundle

        settle(made, (lit.min(0) + lit.max(0)) / 2 if at is None else _point(at))
        show_files(output, export(volume_bundle(made), output))
        return
    viewpoints = _viewpoints(path, lit, frames, eye, _AXES.index(up), made)
    _walk(file, model, decoder, made, viewpoints, original, json_path)


def _viewpoints(
    path: Path | None, lit: "np.ndarray", frames: int | None, eye: float | None, axis: int, volume: "Volume"
) -> "np.ndarray":
    from wlm.probe import load_positions
    from wlm.probe.volume.walk import STEP, camera_path, loop_frames

    if path is not None:
        return load_positions(path)
    frames = loop_frames(lit, STEP * volume.sizes[0], axis) if frames is None else frames
    return camera_path(lit, frames, eye, axis)


def _walk(
    file: Path,
    model: "ProbeModel",
    decoder: "Decoder",
    volume: "Volume",
    viewpoints: "np.ndarray",
    original: "np.ndarray | None",
    json_path: Path | None,
) -> None:
    from wlm.probe.volume.walk import settle, summary, walk

    first = settle(volume, viewpoints[0])
    peak = None if original is None else float(original.max()) - float(original.min())
    with running("walk") as progress:
        figures = summary(walk(volume, viewpoints, original=original, progress=progress), peak)
    figures |= {"first_frames": first, "volume_bytes": volume.memory_bytes, "model_bytes": decoder.device_bytes}
    if json_path is not None:
        settings = {"device": decoder.device, "sizes": list(volume.sizes), "side": volume.side, "budget": volume.budget}
        write_json(json_path, {"name": model.name} | settings | figures)
    _show_walk(file, figures)


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
    """Makes the volume of a model's probes; also returns the original light, if it is given."""
    from wlm.probe.places import probes_of
    from wlm.probe.volume.cascade import BUDGET, Volume

    if probes_path is None:
        position, original, live, normal = model.stored_positions(), None, model.live, None
    else:
        position, original, live, normal = probes_of(model, probes_path, key)
        if not model.has_probes_at(position):
            raise WlmError(f"{probes_path}: expected the {model.probes} probes of {file}, in their order")
    budget = BUDGET if budget is None else budget
    light = decoder.light(position)
    return Volume(position, light, live=live, normal=normal, block=block, budget=budget), original


def score_walks(model: "ProbeModel", probes: "ProbeSet", device: str) -> dict[str, dict[str, Any]]:
    """Scores the light sampled from the volume along a walk, for the original and the decoded probes."""
    from wlm.probe.volume.light import StoredLight
    from wlm.probe.volume.walk import score_volume

    decoder = model.decoder(device, position=probes.position)
    lights = {
        "original": StoredLight(probes.values, decoder.device),
        "decoded": decoder.light(probes.position),
    }
    with running("walk") as progress:
        return {name: score_volume(probes, light, progress=progress) for name, light in lights.items()}


def show_walks(walks: dict[str, dict[str, Any]]) -> None:
    """Shows the scores of walks, if there are any."""
    if not walks:
        return
    rows = table("sampled from the cascaded volume", ["light", *_DECIBELS, "blocks decoded per frame"])
    for name, figures in walks.items():
        decibels = (number(figures[key], ".2f") for key in _DECIBELS.values())
        rows.add_row(name, *decibels, number(figures["updated"]["mean"], ".1f"))
    show(rows)


def score_pictures(
    model: "ProbeModel", probes: "ProbeSet", views: int, mesh: Path | None, device: str
) -> "list[ViewScore]":
    """Scores pictures under the decoded light; 50 of them if `views` is 0."""
    from wlm.formats.geometry import read_geometry
    from wlm.probe.views import VIEWS, score_views

    geometry = None if mesh is None else read_geometry(mesh, with_uv=False)
    decoded = model.decoder(device, position=probes.position).decode_probes()
    with running("views") as progress:
        return score_views(probes, decoded, geometry, views=views or VIEWS, device=device, progress=progress)


def show_pictures(scores: "list[ViewScore]") -> None:
    """Shows the scores of pictures, if there are any."""
    if not scores:
        return
    rows = table("pictures under the light", ["drawn", "light", "views", "MSE", "PSNR, dB", "SSIM", "FLIP"])
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
    times = {"update, ms": "update_ms", "sampling, ms": "read_ms"}
    errors = {"error, RMS": "rmse", "light, RMS": "rms"}
    for names, form in ((counts, ".1f"), (times, ".3f"), (errors, ".4g")):
        for name, key in names.items():
            values = figures[key] or {}
            rows.add_row(name, *(number(values.get(part), form) for part in ("mean", "p95", "max")))
        rows.add_section()
    coverage = figures["coverage"] or {}
    rows.add_row("points inside the volume", *(number(coverage.get(part), ".2%") for part in ("mean", "p5", "min")))
    rows.add_section()
    for name, key in _DECIBELS.items():
        if key in figures:
            rows.add_row(name, number(figures[key], ".2f"))
    rows.add_row("frames until the volume is complete", str(figures["first_frames"]))
    rows.add_row("volume, bytes", f"{figures['volume_bytes']:,}")
    rows.add_row("model, bytes", f"{figures['model_bytes']:,}")
    show(rows)
