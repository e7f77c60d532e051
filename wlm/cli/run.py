"""`wlm run`: draws a scene over its day into a folder, or opens it in a window."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import exclusive, note, note_warnings, quiet_warp, running, show_facts, show_figures
from wlm.cli.options import Colours, Device, Weights, output_option
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.scene import Scene


def run(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.yaml", help="File of a scene; docs/scene.md describes it.")],
    output: Annotated[
        Path | None, output_option("DIR", "Folder for the pictures, the film and report.json; needed without --window.")
    ] = None,
    hours: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Hours of the pictures, such as 7,12,18.75; default those of the originals."),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=0, help="Frames of the film, 0 for none; default 24 for each of its seconds.")
    ] = None,
    width: Annotated[int, typer.Option(min=1, help="Width in pixels.")] = 960,
    height: Annotated[int, typer.Option(min=1, help="Height in pixels.")] = 540,
    samples: Annotated[
        int | None, typer.Option(min=1, max=4, help="Points along a side of a pixel; default 2.")
    ] = None,
    weights: Weights = None,
    colours: Colours = None,
    window: Annotated[
        bool, typer.Option("--window", help="Open a window instead, with sliders for the hour and the light groups.")
    ] = False,
    device: Device = "cpu",
) -> None:
    """Draw a scene over its day: lightmaps, moving objects under probes, and smoke, from a path of the camera.

    Writes pictures at hours, a film of the day (H.264 with the extra "film", else an animated WebP), and report.json
    with times by stage, memory by part, and errors against the original lightmaps.
    """
    if output is None and not window:
        raise WlmError("wlm run: expected --output DIR, or --window")
    drawn = {"output": output, "hours": hours, "frames": frames, "samples": samples}
    if window and (name := next((name for name, value in drawn.items() if value is not None), None)):
        raise WlmError(f"wlm run: --{name} has no meaning with --window; leave it out")
    quiet_warp()
    from wlm.cli.lightmap import group_weights
    from wlm.lightmap.data import parse_times
    from wlm.scene import load

    given = {"weights": group_weights(weights, colours), "height": height, "width": width, "device": device}
    with load(scene) as content:
        if window:
            _open(content, **given)
            return
        given |= {"hours": None if hours is None else parse_times(hours), "frames": frames, "samples": samples or 2}
        _draw(scene=content, output=output, **given)


def _open(scene: "Scene", weights: Any, height: int, width: int, device: str) -> None:
    from wlm.formats.hdr_blocks import need
    from wlm.view.scene_window import day_scene
    from wlm.view.window import Window

    need("pyvista", "view")
    shown = Window(day_scene(scene, weights, device), size=(width, height), off_screen=False)
    try:
        shown.tone("filmic")
        shown.show()
    finally:
        shown.close()


@exclusive
def _draw(scene: "Scene", output: Path, **options: Any) -> None:
    from wlm.view.scene_run import run as draw

    with running("run") as progress:
        report = draw(scene, output, **options, progress=progress)
    if "frame_ms" in report:
        rows = [(name, *(each[key] for key in ("mean", "p95", "most"))) for name, each in report["frame_ms"].items()]
        show_figures(f"{scene.title}: milliseconds of a frame", ["stage", "mean", "95% are below", "longest"], rows)
        pages = {"pages decoded per frame": report["decoded"], "share of points at full detail": report["current"]}
        show_facts(report["film"]["file"], {"frames": report["film"]["frames"]} | pages)
    show_facts("bytes on the device", report["memory"])
    if report["views"]:
        rows = [(row["hour"], row["psnr"], row["flip"]) for row in report["views"]]
        show_figures("views against the original lightmaps", ["hour", "PSNR, dB", "FLIP"], rows)
    note_warnings(report["warnings"])
    note(f"written to {output}")
