"""`wlm view`: shows a file in a window, or writes a picture of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.markup import escape

from wlm.cli import options as opt
from wlm.cli.console import begin, show, table
from wlm.errors import WlmError

_SLIDERS = ("hour", "sigma", "exposure", "error")


def view(
    file: opt.ModelFile,
    mesh: opt.SceneFile = None,
    original: opt.Original = None,
    key: opt.Key = None,
    time: opt.Time = None,
    view: Annotated[
        str | None, typer.Option(help="Picture to show: light or tiles of lightmaps; balls or gaussians of probes.")
    ] = None,
    flat: Annotated[bool, typer.Option("--flat", help="Show a lightmap as a texture, not on its mesh.")] = False,
    sliders: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Slider or setting, repeatable: hour=18.5 of lightmaps; turn=DEGREES of the camera; "
            "sigma=SIZE of Gaussians in standard deviations; exposure=STOPS; error=FACTOR, 1 to 64.",
        ),
    ] = None,
    tone: Annotated[
        Literal["clamped", "filmic"],
        typer.Option(help="Light above white: cut off (clamped), or up to 4 times white compressed (filmic)."),
    ] = "clamped",
    up: opt.Up = "y",
    size: Annotated[str, typer.Option(metavar="WxH", help="Size of the window in pixels.")] = "1280x720",
    screenshot: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="Write a picture instead of opening a window; needs no display."),
    ] = None,
) -> None:
    """Show compressed lightmaps or probes in a window; with --original, beside the original and the error."""
    pixels = _size(size)
    values = _values(sliders or ())
    begin(screenshot, ".png")
    from wlm.formats.hdr_blocks import need
    from wlm.view.opening import open_scene
    from wlm.view.window import Window

    need("pyvista", "view")
    options = {"mesh": mesh, "original": original, "key": key, "time": time, "flat": flat, "up": up}
    scene = open_scene(file, **options)
    window = Window(scene, size=pixels, off_screen=screenshot is not None)
    try:
        window.tone(tone)
        if view is not None:
            window.choose(view)
        window.look()
        if "turn" in values and not scene.flat:
            window.turn(values.pop("turn"))
        for name, value in values.items():
            window.set(name, value)
        if screenshot is None:
            window.show()
            return
        rows = table(scene.title, ["written", "bytes"])
        window.screenshot(screenshot)
        rows.add_row(escape(str(screenshot)), f"{screenshot.stat().st_size:,}")
        show(rows)
    finally:
        window.close()


def _values(texts: Sequence[str]) -> dict[str, float]:
    values = {}
    for text in texts:
        name, _, number = text.partition("=")
        try:
            values[name] = float(number)
        except ValueError:
            name = ""
        if name not in (known := (*_SLIDERS, "turn")):
            raise WlmError(f"--set: expected NAME=NUMBER with a name of {', '.join(known)}, got {text!r}")
    return values


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = map(int, text.lower().split("x"))
    except ValueError:
        width = height = 0
    if not (200 <= width <= 7680 and 200 <= height <= 7680):
        raise WlmError(f"--size: expected a width and a height of 200 to 7680 pixels such as 1280x720, got {text!r}")
    return width, height
