"""`wlm smoke`: simulate smoke, look at it roughly, bake its six-way lightmaps, light them, pack them for an engine."""

import math
from collections.abc import Iterator
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
)
from wlm.cli.smoke_network import register
from wlm.cli.smoke_options import (
    SHEET,
    Device,
    Distance,
    Emission,
    Extent,
    Extinction,
    Input,
    Resolution,
    Toward,
    Turn,
    camera_of,
    cleared,
    load,
    made_of,
    open_smoke,
    places,
    vector,
    volumes,
    write_lightmaps,
)
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.smoke.baking import SixWay
    from wlm.smoke.camera import Camera
    from wlm.smoke.scene import Scene
    from wlm.smoke.shading import Light

__all__ = ["app"]

app = typer.Typer(help="Smoke: simulated, and seen through six-way lightmaps.")

_Baked = Annotated[
    Path,
    typer.Argument(metavar="SMOKE", help="A .npz or .nvdb volume, a folder of simulate, bake or predict, or an EXR."),
]
_Step = Annotated[float, typer.Option(min=0.01, max=1000.0, help="The longest step in voxels.")]
_Supersample = Annotated[int, typer.Option(min=1, max=16, help="Rays along a pixel's edge.")]
# Smoke that was baked has them already.
_BakeStep = Annotated[
    float | None,
    typer.Option(min=0.01, max=1000.0, help="The longest step in voxels; default 1 to shade, 0.5 for a flipbook."),
]
_BakeSupersample = Annotated[int | None, typer.Option(min=1, max=16, help="Rays along a pixel's edge; default 1.")]
_G = Annotated[float, typer.Option(min=-0.99, max=0.99, help="Henyey and Greenstein's mean cosine.")]


@app.command()
def simulate(
    scene_name: Annotated[str, typer.Argument(metavar="SCENE", help="jet-sphere, jet-moving, explosion, or a YAML.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="The folder of frames to write.")],
    frames: Annotated[int | None, typer.Option(min=1, max=9999, help="How many; default the scene's.")] = None,
    scale: Annotated[
        float, typer.Option(min=0.001, max=100.0, help="Cells along each axis, as a multiple of the scene's.")
    ] = 1.0,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted simulation in DIR.")] = False,
    device: Device = "cpu",
) -> None:
    """Simulate a scene into a folder of volumes, one a frame.

    Ctrl-C keeps the state in DIR; the same command with --resume goes on to the same frames.
    """
    quiet_warp()
    from wlm.interop import check_device
    from wlm.smoke.data import open_frames
    from wlm.smoke.scene import load_scene
    from wlm.smoke.simulate import make_solver, simulate

    device = check_device(device)
    scene = load_scene(scene_name)
    if scale != 1.0:
        scene = _scaled(scene, scale)
    if frames is not None:
        scene = scene.model_copy(update={"frames": frames})
    # First: earlier frames aren't removed for a simulation that can't be.
    solver = make_solver(scene, device=device)
    folder = open_frames(output, scene, resume=resume)
    done: dict[str, float] = {}
    try:
        with deferred_interrupt() as check_interrupt, progress_bar("simulate") as bar:

            def report(frame: int, figures: dict[str, float]) -> None:
                done.update(figures, frame=frame)
                bar(frame, scene.frames, f"smoke {figures['smoke']:.4g}")
                check_interrupt()

            first = simulate(folder, solver=solver, resume=resume, progress=report)
    except KeyboardInterrupt:
        note(f"stopped at frame {done['frame']:g}: the same command with --resume goes on from {output}")
        raise
    if resume and first == 1:
        note(f"{output}: there was nothing to resume; started at frame 1")
    rows = table(f"{output}: {scene.name}", ["", "value"])
    rows.add_row("frames", f"{scene.frames:,}")
    rows.add_row("velocity", " x ".join(map(str, scene.grid.cells)))
    rows.add_row("density", " x ".join(map(str, scene.grid.shape)))
    rows.add_row("steps a frame", f"{scene.steps:,}")
    if done:
        rows.add_row("smoke in the last frame", f"{done['smoke']:.4g}")
        rows.add_row("seconds a frame", f"{done['seconds']:.3g}")
    show(rows)


@app.command()
def guide(
    smoke: Input,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="A .exr, or of frames a folder.")],
    resolution: Resolution = None,
    step: Annotated[float, typer.Option(min=0.01, max=1000.0, help="In voxels.")] = 10.0,
    jitter: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of a step by which samples are shifted at random.")
    ] = 1.0,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the jitter.")] = 0,
    threshold: Annotated[
        float, typer.Option(min=0.0, help="Optical depth of a voxel from which on smoke has a surface.")
    ] = 0.01,
    g: _G = 0.0,
    toward: Toward = None,
    turn: Turn = 0.0,
    extent: Extent = None,
    distance: Distance = None,
    perspective: Annotated[bool, typer.Option("--perspective", help="Rays meet in the eye.")] = False,
    extinction: Extinction = None,
    emission: Emission = None,
    device: Device = "cpu",
) -> None:
    """Make guiding maps: light, transparency and depth, by a march in large steps (algorithm 1)."""
    quiet_warp()
    from wlm.smoke.data import write_guide
    from wlm.smoke.guide import guide

    footage = open_smoke(smoke, extinction, emission, device)
    view = {"resolution": resolution, "toward": toward, "turn": turn, "extent": extent, "distance": distance}
    if perspective:
        view["perspective"] = True
    rows = table(str(smoke), ["file", "covered", "mean light", "nearest", "farthest"])
    for path, volume, camera in volumes(footage, output, "guide", ".exr", view):
        found = guide(volume, camera, step=step, jitter=jitter, seed=seed, threshold=threshold, g=g)
        write_guide(path, found)
        depth = found.depth[found.depth > 0]
        covered = found.transparency < 0.99
        rows.add_row(
            escape(path.name),
            f"{float(covered.float().mean()):.1%}",
            number(float(found.light[covered].mean()) if covered.any() else None, ".4g"),
            number(float(depth.min()) if len(depth) else None, ".4g"),
            number(float(depth.max()) if len(depth) else None, ".4g"),
        )
    show(rows)


@app.command()
def bake(
    smoke: Input,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="A .exr, or of frames a folder.")],
    resolution: Resolution = None,
    step: _Step = 0.5,
    supersample: _Supersample = 1,
    g: _G = 0.0,
    toward: Toward = None,
    turn: Turn = 0.0,
    extent: Extent = None,
    distance: Distance = None,
    extinction: Extinction = None,
    emission: Emission = None,
    device: Device = "cpu",
) -> None:
    """Make six-way lightmaps by a fine march, and say how far a step twice as long is from them.

    An EXR has the channels right, left, top, bottom, front, back, transparency and, of hot smoke, emission.
    """
    quiet_warp()
    from wlm.smoke.baking import six_way

    footage = open_smoke(smoke, extinction, emission, device)
    view = {"resolution": resolution, "toward": toward, "turn": turn, "extent": extent, "distance": distance}
    write_lightmaps(
        footage, output, view, lambda *seen: six_way(*seen, step=step, g=g, supersample=supersample), errors=True
    )


@app.command()
def shade(
    smoke: _Baked,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT", help="A .png, or of frames a folder.")],
    light: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z[:R,G,B]", help="Direction to a light and its irradiance; repeat for more."),
    ] = None,
    background: Annotated[str | None, typer.Option(metavar="R,G,B", help="Linear colour behind the smoke.")] = None,
    white: Annotated[float, typer.Option(help="The light that is shown as white.")] = 1.0,
    rule: Annotated[str, typer.Option(help="Weights of the lightmaps: squared, absolute or normalised.")] = "squared",
    resolution: Resolution = None,
    step: _BakeStep = None,
    supersample: _BakeSupersample = None,
    toward: Toward = None,
    turn: Turn = 0.0,
    extent: Extent = None,
    distance: Distance = None,
    extinction: Extinction = None,
    emission: Emission = None,
    device: Device = "cpu",
) -> None:
    """Light the smoke into PNGs, of frames with the scene's obstacles and a contact sheet.

    The lights are those given, else the scene's, else one from 1,1,1; an irradiance of 4 pi, the default, shows a
    lightmap as it is.
    """
    from wlm.smoke.camera import RULES

    if rule not in RULES:
        raise WlmError(f"--rule: expected one of {', '.join(RULES)}, got {rule!r}")
    if not 0 < white < float("inf"):
        raise WlmError(f"--white: expected a number above 0, got {white}")
    lights = [_light(text) for text in light or ()]
    behind = None if background is None else vector("--background", background)
    quiet_warp()
    from wlm.view.atlas import save_png
    from wlm.view.smoke import contact_sheet, picture, to_bytes

    view = {"resolution": resolution, "toward": toward, "turn": turn, "extent": extent, "distance": distance}
    marching = {"step": step, "supersample": supersample}
    shots, scene = _shots(smoke, output, "shade", view, marching, 1.0, extinction, emission, device)
    if not lights:
        lights = [given.light() for given in scene.lights] if scene is not None else [_light("1,1,1")]
    if behind is None:
        behind = (0.0, 0.0, 0.0) if scene is None else scene.background
    rows = table(str(smoke), ["file", "covered", "mean", "largest", "clipped"])
    drawn = []
    for path, six, camera, extra in shots:
        shaded = picture(six, camera, lights, background=behind, rule=rule, **extra)
        pixels = to_bytes(shaded, white)
        save_png(path, pixels)
        drawn.append(pixels)
        covered = float((six.transparency < 0.99).float().mean())
        clipped = float((shaded > white).any(-1).float().mean())
        rows.add_row(
            escape(path.name), f"{covered:.1%}", f"{shaded.mean():.4g}", f"{shaded.max():.4g}", f"{clipped:.1%}"
        )
    if output.is_dir():
        contact_sheet(output / SHEET, {"": drawn})
    show(rows)


@app.command()
def flipbook(
    smoke: _Baked,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="OUT", help="A .exr, .png or .tga: becomes OUT_1 and OUT_2.")
    ],
    layout: Annotated[str, typer.Option(help="unity, o3de, o3de-tlrb or embergen.")] = "unity",
    columns: Annotated[int | None, typer.Option(min=1, max=64, help="Of cells; default as square as can be.")] = None,
    count: Annotated[int | None, typer.Option(min=1, max=4096, help="Frames, evenly spread; default all.")] = None,
    gain: Annotated[
        float | None, typer.Option(help="Factor on the light; default 1 in an EXR, else what just doesn't clip.")
    ] = None,
    resolution: Resolution = None,
    step: _BakeStep = None,
    supersample: _BakeSupersample = None,
    toward: Toward = None,
    turn: Turn = 0.0,
    extent: Extent = None,
    distance: Distance = None,
    extinction: Extinction = None,
    emission: Emission = None,
    device: Device = "cpu",
) -> None:
    """Pack six-way lightmaps into the two textures that an engine reads."""
    check_output(output, ".exr", ".png", ".tga")
    from wlm.smoke.camera import EMISSION, LAYOUTS

    if layout not in LAYOUTS:
        raise WlmError(f"--layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    if gain is not None and not 0 < gain < float("inf"):
        raise WlmError(f"--gain: expected a number above 0, got {gain}")
    quiet_warp()
    from wlm.smoke.exporter import write_flipbook

    view = {"resolution": resolution, "toward": toward, "turn": turn, "extent": extent, "distance": distance}
    marching = {"step": step, "supersample": supersample}
    shots, _ = _shots(smoke, None, "six", view, marching, 0.5, extinction, emission, device, count=count)
    frames = [six for _, six, _, _ in shots]
    if any(frame.lightmaps.shape != frames[0].lightmaps.shape for frame in frames):
        raise WlmError(f"{smoke}: expected lightmaps of one size")
    columns = min(columns or math.ceil(len(frames) ** 0.5), len(frames))
    rows_of_cells = -(-len(frames) // columns)
    if gain is None:
        planes = [plane for six in frames for plane in (six.lightmaps, six.emission) if plane is not None]
        brightest = max(float(plane.max()) for plane in planes)
        gain = 1.0 / brightest if output.suffix.lower() != ".exr" and brightest > 0 else 1.0
    paths = tuple(output.with_name(f"{output.stem}_{i}{output.suffix}") for i in (1, 2))
    clipped = write_flipbook(paths, frames, layout, rows=rows_of_cells, columns=columns, gain=gain)
    height, width = frames[0].lightmaps.shape[1:]
    rows = table(str(smoke), ["file", "bytes", "channels"], text=["channels"])
    hot = any(six.emission is not None for six in frames)
    for path, names in zip(paths, LAYOUTS[layout], strict=True):
        names = names if hot or names[-1] != EMISSION else names[:-1]
        rows.add_row(escape(str(path)), f"{path.stat().st_size:,}", " ".join(names))
    rows.add_section()
    rows.add_row("frames", f"{len(frames):,}", f"{rows_of_cells} x {columns} cells of {width} x {height}")
    rows.add_row("gain", f"{gain:.4g}", f"{clipped:,} numbers clipped")
    show(rows)


def _scaled(scene: "Scene", scale: float) -> "Scene":
    from pydantic import ValidationError

    try:
        return scene.scaled(scale)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        expected = problem["msg"].replace("Input should be", "expected", 1)
        raise WlmError(f"--scale: {expected} cells along an axis, got {problem['input']}") from error


def _light(text: str) -> "Light":
    toward, colon, irradiance = text.partition(":")
    from wlm.smoke.scene import LightSettings

    given: dict[str, Any] = {"toward": vector("--light", toward)}
    if colon:
        # One number is a white light.
        given["irradiance"] = vector("--light", irradiance if "," in irradiance else ",".join([irradiance] * 3))
    return made_of(LightSettings, given, {"toward": "--light", "irradiance": "--light"}).light()


def _shots(
    smoke: Path,
    output: Path | None,
    stem: str,
    view: dict[str, Any],
    marching: dict[str, Any],
    usual_step: float,
    extinction: float | None,
    emission: float | None,
    device: str,
    count: int | None = None,
) -> "tuple[Iterator[tuple[Path, SixWay, Camera, dict[str, Any]]], Scene | None]":
    """Lightmaps that were baked, or are now, with their cameras and, of frames, what else is in the picture."""
    from wlm.interop import check_device
    from wlm.smoke.data import SCENE_FILE, numbered, read_six_way

    folder = smoke.is_dir()
    if smoke.suffix.lower() == ".exr" or (folder and not (smoke / SCENE_FILE).exists()):
        options = view | marching | {"extinction": extinction, "emission": emission}
        # A camera that isn't turned is turned by 0.
        options["turn"] = options["turn"] or None
        if given := next((name for name, value in options.items() if value is not None), None):
            raise WlmError(f"{smoke}: was baked: --{given} has to be given to bake")
        device = check_device(device)
        files = numbered(smoke, "six", ".exr") if folder else {1: smoke}
        if not files:
            raise WlmError(f"{smoke}: expected a folder that simulate or bake wrote")
        chosen, single, scene = _spread(tuple(files), count), not folder, None

        def baked() -> "Iterator[tuple[Path, SixWay, Camera, dict[str, Any]]]":
            for path, frame in zip(paths, chosen, strict=True):
                yield path, *read_six_way(files[frame], device), {}

        shots = baked()
    else:
        footage = open_smoke(smoke, extinction, emission, device)
        chosen, single, scene = _spread(footage.numbers, count), footage.scene is None, footage.scene
        fine = {"step": usual_step, "supersample": 1} | {k: v for k, v in marching.items() if v is not None}

        def made() -> "Iterator[tuple[Path, SixWay, Camera, dict[str, Any]]]":
            from wlm.smoke.baking import six_way
            from wlm.smoke.guide import guide

            with progress_bar(stem) as bar:
                for done, (path, frame) in enumerate(zip(paths, chosen, strict=True), 1):
                    volume = load(footage, frame)
                    camera = camera_of(footage, volume, view, flat=True)
                    extra: dict[str, Any] = {}
                    if scene is not None:
                        extra = {"ramp": scene.smoke.ramp, "obstacles": scene.obstacles, "time": footage.time(frame)}
                        extra["depth"] = guide(volume, camera, step=1.0, jitter=0.0).depth if scene.obstacles else None
                    yield path, six_way(volume, camera, estimate=False, **fine), camera, extra
                    bar(done, len(paths), "")

        shots = made()
    if output is None:
        paths = [smoke] * len(chosen)
        return shots, scene
    paths = places(smoke, chosen, single, output, stem, ".png")
    return cleared(shots, single, output, stem, ".png"), scene


def _spread(numbers: tuple[int, ...], count: int | None) -> tuple[int, ...]:
    """As many of the frames as asked for, the first and the last among them."""
    if count is None or count >= len(numbers):
        return numbers
    last = len(numbers) - 1
    return tuple(numbers[round(i * last / max(count - 1, 1))] for i in range(count))


register(app)
