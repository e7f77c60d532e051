"""`wlm smoke`: simulate smoke, render guiding maps, bake six-way lightmaps, light them, pack them for an engine."""

from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wlm.cli.console import (
    escape,
    exclusive,
    note,
    number,
    quiet_warp,
    running,
    show,
    show_figures,
    table,
)
from wlm.cli.options import CheckpointEvery, Device, Resume, output_option
from wlm.cli.smoke_book import (
    Baked,
    BakeStep,
    BakeSupersample,
    Cells,
    From,
    Straight,
    With,
    opened_book,
    shots_of,
    source_of,
)
from wlm.cli.smoke_book import register as register_book
from wlm.cli.smoke_export import register as register_export
from wlm.cli.smoke_light import register as register_light
from wlm.cli.smoke_network import register
from wlm.cli.smoke_options import (
    SHEET,
    Input,
    SmokeOptions,
    march_frames,
    outputs,
    place_and_colour,
    vector,
    with_smoke,
    write_lightmaps,
)
from wlm.cli.smoke_run import register as register_run
from wlm.errors import WlmError
from wlm_kernels.smoke.settings import March

if TYPE_CHECKING:
    from collections.abc import Callable

    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.camera import Camera
    from wlm.smoke.shading import Light

app = typer.Typer(help="Smoke: simulated, and rendered through six-way lightmaps.")

_Output = Annotated[Path, output_option("OUT", "A .exr, or for frames a folder.")]
_G = Annotated[float, typer.Option(min=-0.99, max=0.99, help="Mean cosine of the Henyey-Greenstein phase function.")]


@app.command()
@exclusive
def simulate(
    scene_name: Annotated[
        str, typer.Argument(metavar="SCENE", help="jet-sphere, jet-moving, explosion, chimney, or a YAML.")
    ],
    output: Annotated[Path, output_option("DIR", "The folder of frames to write.")],
    frames: Annotated[int | None, typer.Option(min=1, max=9999, help="How many; default the scene's.")] = None,
    scale: Annotated[
        float, typer.Option(min=0.001, max=100.0, help="Cells along each axis, as a multiple of the scene's.")
    ] = 1.0,
    velocity: Annotated[
        bool, typer.Option("--velocity", help="Keep the air's velocity too, for a flip book's --motion.")
    ] = False,
    resume: Resume = False,
    checkpoint_every: CheckpointEvery = 30.0,
    device: Device = "cpu",
) -> None:
    """Simulate a scene into a folder of volumes, one a frame.

    The state is kept in DIR from time to time, and by Ctrl-C and SIGTERM; the same command with --resume goes on to the
    same frames.
    """
    quiet_warp()
    from wlm.interop import check_device
    from wlm.smoke.data import CHECKPOINT, open_frames
    from wlm.smoke.scene import load_scene
    from wlm.smoke.simulation import make_solver, simulate
    from wlm.system import Progress

    device = check_device(device)
    scene = load_scene(scene_name)
    if scale != 1.0:
        scene = scene.scaled(scale)
    if frames is not None:
        scene = scene.model_copy(update={"frames": frames})
    # First: earlier frames aren't removed for a simulation that can't be.
    solver = make_solver(scene, device=device)
    folder = open_frames(output, scene, resume=resume)
    figures: dict[str, float] = {}
    with running("simulate", output / CHECKPOINT, unit="frame") as report:

        def progress(now: Progress) -> None:
            figures.update(now.figures)
            report(now)

        options = {"resume": resume, "checkpoint_every": checkpoint_every, "velocity": velocity}
        first = simulate(folder, solver=solver, progress=progress, **options)
    if resume and first == 1:
        note(f"{output}: there was nothing to resume; started at frame 1")
    rows = [
        ("frames", scene.frames),
        ("velocity", " x ".join(map(str, scene.grid.cells))),
        ("density", " x ".join(map(str, scene.grid.shape))),
        ("steps a frame", scene.steps),
    ]
    if figures:
        rows += [("smoke in the last frame", figures["smoke"]), ("seconds a frame", figures["frame s"])]
    show_figures(f"{output}: {scene.name}", ["", "value"], rows)


@app.command()
@with_smoke
@exclusive
def guide(
    smoke: Input,
    output: _Output,
    options: SmokeOptions,
    step: Annotated[float, typer.Option(min=0.01, max=1000.0, help="In voxels.")] = March.step,
    jitter: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Share of a step by which samples are shifted at random.")
    ] = March.jitter,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="Of the jitter.")] = March.seed,
    threshold: Annotated[
        float, typer.Option(min=0.0, help="Optical depth of a voxel from which on smoke has a surface.")
    ] = March.threshold,
    g: _G = March.g,
    perspective: Annotated[bool, typer.Option("--perspective", help="Rays meet in the eye.")] = False,
    resume: Resume = False,
) -> None:
    """Make guiding maps: light, transparency and depth, by a march in large steps (algorithm 1).

    Of frames, those done are kept when it is stopped; the same command with --resume makes the others.
    """
    quiet_warp()
    from wlm.smoke.data import write_guide
    from wlm.smoke.march.coarse import guide

    march = March(step, jitter=jitter, seed=seed, threshold=threshold, g=g)
    frames = options.open(smoke)
    camera = options.camera(frames, orthographic=False, perspective=perspective)
    rows = table(str(smoke), ["file", "covered", "mean light", "nearest", "farthest"])

    def make(frame: int, file: "Callable[[], Path]", volume: "DensityVolume", view: "Camera") -> None:
        maps = guide(volume, view, march)
        path = file()
        write_guide(path, maps)
        depth = maps.depth[maps.depth > 0]
        covered = maps.transparency < 0.99
        rows.add_row(
            escape(path.name),
            f"{float(covered.float().mean()):.1%}",
            number(float(maps.light[covered].mean()) if covered.any() else None, ".4g"),
            number(float(depth.min()) if len(depth) else None, ".4g"),
            number(float(depth.max()) if len(depth) else None, ".4g"),
        )

    march_frames(frames, camera, output, "guide", make, asdict(march), resume=resume)
    show(rows)


@app.command()
@with_smoke
@exclusive
def bake(
    smoke: Input,
    output: _Output,
    options: SmokeOptions,
    step: Annotated[float, typer.Option(min=0.01, max=1000.0, help="The longest step in voxels.")] = 0.5,
    supersample: Annotated[int, typer.Option(min=1, max=16, help="Rays along a pixel's edge.")] = 1,
    g: _G = March.g,
    fit: Annotated[
        str, typer.Option(help="axes: exact for lights along these; sphere: nearest to lights all round.")
    ] = "axes",
    albedo: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="With --fit sphere: light of all orders; default once."),
    ] = None,
    resume: Resume = False,
) -> None:
    """Make six-way lightmaps by a fine march, and say how far a step twice as long is from them.

    An EXR has the channels right, left, top, bottom, front, back, transparency and, of hot smoke, emission. Of frames,
    those done are kept when it is stopped; the same command with --resume makes the others.
    """
    quiet_warp()
    from wlm.smoke.march.fine import bake

    if fit not in ("axes", "sphere"):
        raise WlmError(f"--fit: expected axes or sphere, got {fit!r}")
    if fit == "sphere" and supersample > 1:
        raise WlmError("--supersample: expected 1 with --fit sphere")
    if albedo is not None and fit == "axes":
        raise WlmError("--albedo: expected --fit sphere beside it: along the axes light is scattered once")
    frames = options.open(smoke)
    settings = {"step": step, "g": g, "supersample": supersample}
    make, made = partial(bake, **settings), {"made": "bake"} | settings
    if fit == "sphere":
        from wlm.smoke.transport.sphere import bake_sphere

        make = partial(bake_sphere, march=March(step, jitter=0.0, g=g), albedo=albedo)
        made |= {"fit": fit, "albedo": albedo}
    write_lightmaps(frames, options.camera(frames), output, make, made, resume=resume, errors=fit == "axes")


@app.command()
@with_smoke
@exclusive
def shade(
    smoke: Baked,
    output: Annotated[Path, output_option("OUT", "A .png, or for frames a folder.")],
    options: SmokeOptions,
    light: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z[:R,G,B]", help="Direction to a light and its irradiance; repeat for more."),
    ] = None,
    background: Annotated[str | None, typer.Option(metavar="R,G,B", help="Linear colour behind the smoke.")] = None,
    white: Annotated[float, typer.Option(help="The light that becomes white.")] = 1.0,
    rule: Annotated[str, typer.Option(help="Weights of the lightmaps: squared, absolute or normalised.")] = "squared",
    textures: With = None,
    cells: Cells = None,
    source_layout: From = None,
    straight: Straight = False,
    step: BakeStep = None,
    supersample: BakeSupersample = None,
) -> None:
    """Light the smoke into PNGs, of frames with the scene's obstacles and a contact sheet.

    Without --light the lights are the scene's, or one from 1,1,1; an irradiance of 4 pi, the default, shows a lightmap
    as it is.
    """
    from wlm.smoke.camera import RULES

    if rule not in RULES:
        raise WlmError(f"--rule: expected one of {', '.join(RULES)}, got {rule!r}")
    if not 0 < white < float("inf"):
        raise WlmError(f"--white: expected a number above 0, got {white}")
    lights = [_light(text) for text in light or ()]
    behind = None if background is None else vector("--background", background)
    quiet_warp()
    from wlm.smoke.scene import LightSettings, Looks
    from wlm.view.pictures import contact_sheet, save_png, to_bytes
    from wlm.view.smoke import picture

    book = opened_book(smoke, textures, cells, source_layout, straight)
    source = source_of(smoke, options, step, supersample, 1.0, book)
    plain = Looks(lights=[LightSettings(toward=(1, 1, 1))])
    file = outputs(smoke, source.single, output, "shade", ".png")
    rows = table(str(smoke), ["file", "covered", "mean", "largest", "clipped"])
    pictures = []
    with running("shade") as progress:
        for shot in shots_of(source, progress):
            if shot.six.transparency is None:
                raise WlmError(f"{smoke}: has no opacity: expected an alpha, or a third texture by a second --with")
            looks = shot.looks or plain
            given = lights or [settings.light() for settings in looks.lights]
            extra = {"albedo": looks.albedo, "ramp": looks.ramp, "obstacles": looks.obstacles, "time": looks.time}
            extra["rule"] = rule
            shaded = picture(shot.six, given, background=looks.background if behind is None else behind, **extra)
            pictures.append(to_bytes(shaded, white))
            path = file(shot.number)
            save_png(path, pictures[-1])
            covered = float((shot.six.transparency < 0.99).float().mean())
            clipped = float((shaded > white).any(-1).float().mean())
            figures = (f"{covered:.1%}", f"{shaded.mean():.4g}", f"{shaded.max():.4g}", f"{clipped:.1%}")
            rows.add_row(escape(path.name), *figures)
    if not source.single:
        contact_sheet(output / SHEET, {"": pictures})
    show(rows)


def _light(text: str) -> "Light":
    """A light of `place_and_colour`."""
    from wlm.config import check_settings
    from wlm.smoke.scene import LightSettings

    values = dict(zip(("toward", "irradiance"), place_and_colour("--light", text), strict=False))
    return check_settings(LightSettings, values, "--light: ").light()


register_book(app)
register(app)
register_export(app)
register_light(app)
register_run(app)
