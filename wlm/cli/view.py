"""`wlm view`: a window that shows a file, or a picture or a movie of it."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from wlm.cli.console import check_output, escape, quiet_warp, running, show, table
from wlm.cli.options import Original, SceneFile, Up
from wlm.errors import WlmError


def view(
    files: Annotated[
        list[Path],
        typer.Argument(
            metavar="FILE...",
            help="A .wlm, the folder of wlm atlas compress, an input of ours, or six-way EXRs, one a frame.",
        ),
    ],
    mesh: SceneFile = None,
    original: Original = None,
    key: Annotated[str | None, typer.Option(help="Which of a file's arrays of probes.")] = None,
    view: Annotated[str | None, typer.Option(help="light or tiles; of probes balls, gaussians or volume.")] = None,
    outside: Annotated[
        bool, typer.Option("--outside", help="Draw a room's walls from outside too, where they hide it.")
    ] = False,
    flat: Annotated[bool, typer.Option("--flat", help="Show a lightmap unwrapped, not on its mesh.")] = False,
    hour: Annotated[float | None, typer.Option(help="Of lightmaps; half past six in the evening is 18.5.")] = None,
    frame: Annotated[float | None, typer.Option(help="Of smoke, or of the walk; the first is 1.")] = None,
    turn: Annotated[
        float | None, typer.Option(help="Of smoke's light, degrees to the right; else of the camera.")
    ] = None,
    height: Annotated[float | None, typer.Option(help="Of smoke's light, degrees up.")] = None,
    sigma: Annotated[float | None, typer.Option(help="How large Gaussians are drawn, in standard deviations.")] = None,
    exposure: Annotated[float | None, typer.Option(help="Stops above or below what fits the light.")] = None,
    error: Annotated[float | None, typer.Option(help="Factor on the error, 1 to 64.")] = None,
    tone: Annotated[Literal["clamped", "filmic"], typer.Option(help="What becomes of light above white.")] = "clamped",
    walk: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Viewpoints of the volume, as wlm probe walk --path takes.")
    ] = None,
    block: Annotated[
        float | None, typer.Option(help="Side of the volume's finest blocks; default from the probes' spacing.")
    ] = None,
    extinction: Annotated[float | None, typer.Option(help="Of a volume of smoke, at density 1.")] = None,
    up: Up = "y",
    rate: Annotated[float, typer.Option(help="Frames a second of a movie, and of frames that are played.")] = 24.0,
    frames: Annotated[int | None, typer.Option(help="Pictures of a movie; default 48, or all frames.")] = None,
    size: Annotated[str, typer.Option(metavar="WxH", help="Of the window, pixels.")] = "1280x720",
    screenshot: Annotated[
        Path | None, typer.Option(metavar="OUT.png", help="Write a picture; needs no display.")
    ] = None,
    movie: Annotated[
        Path | None, typer.Option(metavar="OUT.gif", help="Write it played, .gif or .webp; needs no display.")
    ] = None,
) -> None:
    """Show a file in a window: its light at any hour, beside the original and the error, tiles, probes, smoke."""
    pixels = _size(size)
    if not 0 < rate <= 1000:
        raise WlmError(f"--rate: expected a number above 0, at most 1000, got {rate:g}")
    if screenshot is not None:
        check_output(screenshot, ".png")
    if movie is not None:
        check_output(movie, ".gif", ".webp")
    elif frames is not None:
        raise WlmError("--frames: means nothing without --movie")
    quiet_warp()
    from wlm.view.opening import open_scene
    from wlm.view.rendering import import_pyvista
    from wlm.view.window import Window

    import_pyvista("view")
    with running("view") as progress:
        scene = open_scene(
            files,
            mesh=mesh,
            original=original,
            key=key,
            walk=walk,
            block=block,
            extinction=extinction,
            flat=flat,
            up=up,
            progress=progress if len(files) > 1 or files[0].is_dir() else None,
        )
    window = Window(scene, size=pixels, rate=rate, off_screen=screenshot is not None or movie is not None)
    try:
        window.tone(tone)
        if outside:
            window.outside(True)
        if view is not None or walk is not None:
            window.choose(view or "volume")
        window.look()
        values = {"hour": hour, "frame": frame, "height": height, "sigma": sigma, "exposure": exposure, "error": error}
        if turn is not None and "turn" not in window.sliders and not scene.flat:
            window.turn(turn)
        else:
            values["turn"] = turn
        for name, value in values.items():
            if value is not None:
                window.set(name, value)
        if screenshot is None and movie is None:
            window.show()
            return
        rows = table(scene.title, ["written", "bytes"])
        if screenshot is not None:
            window.screenshot(screenshot)
            rows.add_row(escape(str(screenshot)), f"{screenshot.stat().st_size:,}")
        if movie is not None:
            with running("movie") as progress:
                window.movie(movie, frames, progress=progress)
            rows.add_row(escape(str(movie)), f"{movie.stat().st_size:,}")
        show(rows)
    finally:
        window.close()


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not (200 <= width <= 7680 and 200 <= height <= 7680):
        raise WlmError(f"--size: expected a width and a height of 200 to 7680 pixels such as 1280x720, got {text!r}")
    return width, height
