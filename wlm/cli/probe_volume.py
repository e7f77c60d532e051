"""`wlm probe volume`: writes the cascaded lighting volume around a viewer; also its scores for `wlm evaluate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import number, quiet_warp, running, show, show_files, table
from wlm.cli.options import Device, Key, ModelFile, ShaderLanguage, Time, output_option

if TYPE_CHECKING:
    from wlm.probe import ProbeModel, ProbeSet
    from wlm.probe.views import ViewScore

_DECIBELS = {
    "sampled near the viewer, dB": "psnr",
    "decoded at the same points, dB": "light_psnr",
    "sampled farther away, dB": "far_psnr",
}
_COSTS = {"blocks decoded per frame": "updated", "frame, ms": "update_ms"}

# The callback keeps the name of the only command in the command line.
app = typer.Typer(help="Light probes: the cascaded volume that a renderer samples.", callback=lambda: None)


@app.command()
def volume(
    file: ModelFile,
    output: Annotated[Path, output_option("DIR", "The folder to write to.")],
    probes_path: Annotated[
        Path | None,
        typer.Argument(
            metavar="PROBES",
            help="File that was compressed, for its positions and normals; default FILE.wlm's positions.",
        ),
    ] = None,
    at: Annotated[
        tuple[float, float, float] | None,
        typer.Option(metavar="X Y Z", help="Position of the viewer; default the centre of the probes."),
    ] = None,
    block: Annotated[
        float | None, typer.Option(help="Side of the finest blocks in world units; default by the probes' spacing.")
    ] = None,
    update: Annotated[
        bool, typer.Option("--update", help="Also write compute shaders that update the volume, to DIR/update.")
    ] = False,
    shader: ShaderLanguage = None,
    key: Key = None,
    time: Time = None,
    device: Device = "cpu",
) -> None:
    """Write a volume of light around a viewer, coarser farther away: buffers, an index, and a shader that reads them.

    Normals of PROBES keep light from passing through walls. wlm evaluate --volume scores such a volume.
    """
    quiet_warp()
    from dataclasses import replace

    import numpy as np

    from wlm.export import export
    from wlm.export.engines.volume import volume_module
    from wlm.probe.places import probes_of
    from wlm.probe.volume.bundle import volume_bundle
    from wlm.probe.volume.cascade import Volume
    from wlm.probe.volume.shader import volume_glsl
    from wlm.probe.volume.update import update_bundle
    from wlm.probe.volume.walk import settle
    from wlm.system import load

    model = load(file, "probe").at(time)
    known = probes_of(model, probes_path, key, time)
    light = model.decoder(device).light(known.position)
    made = Volume(known.position, light, live=known.live, normal=known.normal, block=block)
    # Without any light yet, it makes the example of the update.
    parts = {"update": update_bundle(made, model)} if update else {}
    if update and shader == "wgsl":
        parts["update"] = replace(parts["update"], files=volume_module(volume_glsl(made.channels)))
    lit = known.position[known.live]
    settle(made, (lit.min(0) + lit.max(0)) / 2 if at is None else np.array(at))
    show_files(output, export(replace(volume_bundle(made), parts=parts), output, shader=shader or "glsl"))
    rows = table("the volume on the device", ["part", "bytes"])
    for part, size in (made.memory | {"in all": made.memory_bytes}).items():
        rows.add_row(part, f"{size:,}")
    show(rows)


def score_walks(model: "ProbeModel", probes: "ProbeSet", device: str) -> dict[str, dict[str, Any]]:
    """Scores light sampled from the volume along a walk through the scene, for original and decoded probes."""
    from wlm.probe.volume.light import StoredLight
    from wlm.probe.volume.walk import score_volume

    decoder = model.decoder(device, position=probes.position)
    lights = {"original": StoredLight(probes.values, decoder.device), "decoded": decoder.light(probes.position)}
    with running("walk") as progress:
        return {name: score_volume(probes, light, progress=progress) for name, light in lights.items()}


def show_walks(walks: dict[str, dict[str, Any]]) -> None:
    """Prints the scores of walks as a table; nothing if there are none."""
    if not walks:
        return
    rows = table("sampled from the cascaded volume", ["along a walk", *walks])
    for name, key in _DECIBELS.items():
        rows.add_row(name, *(number(figures[key], ".2f") for figures in walks.values()))
    for name, key in _COSTS.items():
        rows.add_row(name, *(number(figures[key]["mean"], ".3g") for figures in walks.values()))
    for part in next(iter(walks.values()))["memory"]:
        rows.add_row(f"bytes of the {part}", *(f"{figures['memory'][part]:,}" for figures in walks.values()))
    rows.add_row("bytes of the volume", *(f"{figures['memory_bytes']:,}" for figures in walks.values()))
    show(rows)


def score_pictures(
    model: "ProbeModel", probes: "ProbeSet", views: int, mesh: Path | None, device: str
) -> "list[ViewScore]":
    """Scores rendered pictures under the decoded light: `views` of them, or 50 if `views` is 0."""
    from wlm.formats.geometry import read_geometry
    from wlm.probe.views import VIEWS, score_views

    geometry = None if mesh is None else read_geometry(mesh, with_uv=False)
    decoded = model.decoder(device, position=probes.position).decode_probes()
    with running("views") as progress:
        return score_views(probes, decoded, geometry, views=views or VIEWS, device=device, progress=progress)


def show_pictures(scores: "list[ViewScore]") -> None:
    """Prints the scores of pictures as a table; nothing if there are none."""
    if not scores:
        return
    rows = table("pictures under the light", ["drawn", "light", "views", "MSE", "PSNR, dB", "SSIM", "FLIP"])
    for score in scores:
        figures = (number(score.mse, ".3g"), number(score.psnr, ".2f"), number(score.ssim, ".4f"))
        rows.add_row(score.drawn, score.light, str(score.views), *figures, number(score.flip, ".4f"))
    show(rows)
