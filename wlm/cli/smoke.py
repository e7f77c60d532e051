"""`wlm smoke`: simulate smoke, render guiding maps, bake six-way lightmaps, light them, pack them for an engine."""

from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

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
    show_figures,
    table,
)
from wlm.cli.options import CheckpointEvery, Device, Resume, output_option
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
    from collections.abc import Callable, Iterator

    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.camera import Camera
    from wlm.smoke.shading import Light
    from wlm.smoke.shots import BakedFiles, FlipBook, FramesToBake, Shot
    from wlm.system import OnProgress

app = typer.Typer(help="Smoke: simulated, and rendered through six-way lightmaps.")

_Baked = Annotated[
    Path,
    typer.Argument(
        metavar="SMOKE",
        help="A .npz, .nvdb or .vdb volume, a folder of frames, what bake wrote, or a flip book's first texture.",
    ),
]
_With = Annotated[
    list[Path] | None,
    typer.Option("--with", metavar="TEXTURE", help="A flip book's second texture; again: one of its opacity."),
]
_Cells = Annotated[str | None, typer.Option(metavar="ROWSxCOLUMNS", help="Of a flip book, such as 8x8.")]
_From = Annotated[
    str | None,
    typer.Option("--from", metavar="LAYOUT", help="Of a flip book: unity, the default, o3de, o3de-tlrb or embergen."),
]
_Straight = Annotated[bool, typer.Option("--straight", help="A flip book's light isn't multiplied by its opacity yet.")]
_Output = Annotated[Path, output_option("OUT", "A .exr, or for frames a folder.")]
# Baked smoke has both already.
_BakeStep = Annotated[
    float | None,
    typer.Option(min=0.01, max=1000.0, help="The longest step in voxels; default 1 to shade, 0.5 for a flipbook."),
]
_BakeSupersample = Annotated[int | None, typer.Option(min=1, max=16, help="Rays along a pixel's edge; default 1.")]
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
    from wlm.smoke.guiding import guide

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
    from wlm.smoke.baking import bake

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
    smoke: _Baked,
    output: Annotated[Path, output_option("OUT", "A .png, or for frames a folder.")],
    options: SmokeOptions,
    light: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z[:R,G,B]", help="Direction to a light and its irradiance; repeat for more."),
    ] = None,
    background: Annotated[str | None, typer.Option(metavar="R,G,B", help="Linear colour behind the smoke.")] = None,
    white: Annotated[float, typer.Option(help="The light that becomes white.")] = 1.0,
    rule: Annotated[str, typer.Option(help="Weights of the lightmaps: squared, absolute or normalised.")] = "squared",
    textures: _With = None,
    cells: _Cells = None,
    source_layout: _From = None,
    straight: _Straight = False,
    step: _BakeStep = None,
    supersample: _BakeSupersample = None,
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
    from wlm.view.atlas import save_png
    from wlm.view.smoke import contact_sheet, picture, to_bytes

    book = _book(smoke, textures, cells, source_layout, straight)
    source = _source(smoke, options, step, supersample, 1.0, book)
    plain = Looks(lights=[LightSettings(toward=(1, 1, 1))])
    file = outputs(smoke, source.single, output, "shade", ".png")
    rows = table(str(smoke), ["file", "covered", "mean", "largest", "clipped"])
    pictures = []
    with running("shade") as progress:
        for shot in _shots(source, progress):
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


@app.command()
@with_smoke
def flipbook(
    smoke: _Baked,
    output: Annotated[Path, output_option("OUT", "A .exr, .png or .tga: becomes OUT_1 and OUT_2.")],
    options: SmokeOptions,
    layout: Annotated[str, typer.Option(help="unity, o3de, o3de-tlrb or embergen.")] = "unity",
    columns: Annotated[int | None, typer.Option(min=1, max=64, help="Of cells; default as square as can be.")] = None,
    count: Annotated[int | None, typer.Option(min=1, max=4096, help="Frames, evenly spread; default all.")] = None,
    gain: Annotated[
        float | None,
        typer.Option(help="Factor on the light; default 1 in an EXR, else the greatest without clipping."),
    ] = None,
    textures: _With = None,
    cells: _Cells = None,
    source_layout: _From = None,
    straight: _Straight = False,
    padding: Annotated[int, typer.Option(min=0, max=64, help="Pixels around each cell that repeat its border.")] = 0,
    mips: Annotated[
        int | None, typer.Option(min=1, max=6, help="Pad such that so many halvings of the textures stay clean.")
    ] = None,
    motion: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Frames of simulate --velocity: write OUT_motion too.")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="SMOKE", help="The smoke itself: write OUT_depth too, for point lights.")
    ] = None,
    shader: Annotated[
        bool, typer.Option("--shader", help="Write OUT.glsl, OUT.hlsl, OUT.metal and OUT.wgsl too.")
    ] = False,
    step: _BakeStep = None,
    supersample: _BakeSupersample = None,
) -> None:
    """Pack six-way lightmaps into the two textures that an engine reads."""
    check_output(output, ".exr", ".png", ".tga")
    from wlm.smoke.camera import LAYOUTS

    if layout not in LAYOUTS:
        raise WlmError(f"--layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    if gain is not None and not 0 < gain < float("inf"):
        raise WlmError(f"--gain: expected a number above 0, got {gain}")
    if mips is not None and padding:
        raise WlmError("--mips: expected without --padding, which it chooses")
    for option, given in (("motion", motion), ("depth", depth)):
        if given is not None and textures:
            reason = "expected lightmaps of bake or predict, or frames: a flip book's camera isn't known"
            raise WlmError(f"--{option}: {reason}")
    if depth is not None and not depth.exists():
        raise WlmError(f"{depth}: expected the flip book's smoke, found none")
    quiet_warp()
    from wlm.formats.atomic import atomic_write
    from wlm.shading import ENDINGS
    from wlm.smoke.exporter import brightest_gain, channels, lay_out, write_flipbook, write_page
    from wlm.smoke.exporter import cells as cells_for
    from wlm.smoke.flipbook_depth import encoded_depth, frames_depth
    from wlm.smoke.flipbook_motion import ZERO, encoded, frames_motion, mip_padding, open_motion, scale_of
    from wlm.smoke.shader import smoke_shader

    book = _book(smoke, textures, cells, source_layout, straight)
    source = _source(smoke, options, step, supersample, 0.5, book)
    # Before what takes long.
    air = None if motion is None else open_motion(motion, options.device)
    deep = None if depth is None else options.open(depth)
    with running("flipbook") as progress:
        shots = list(_shots(source, progress, count))
        frames = [shot.six for shot in shots]
    if any(frame.lightmaps.shape != frames[0].lightmaps.shape for frame in frames):
        raise WlmError(f"{smoke}: expected lightmaps of one size")
    rows_of_cells, columns = cells_for(len(frames), columns)
    if gain is None:
        gain = 1.0 if output.suffix.lower() == ".exr" else brightest_gain(frames)
    paths = tuple(output.with_name(f"{output.stem}_{i}{output.suffix}") for i in (1, 2))
    height, width = frames[0].lightmaps.shape[1:]
    if mips is not None:
        padding = mip_padding(height, width, mips)
    placed = {"rows": rows_of_cells, "columns": columns, "gain": gain, "padding": padding}
    numbers, scale, reach = [shot.number for shot in shots], None, None
    moving, depths = (output.with_name(f"{output.stem}_{name}{output.suffix}") for name in ("motion", "depth"))
    if air is not None:
        with running("motion") as progress:
            moved = frames_motion(air, numbers, frames, progress)
        scale = scale_of(moved)
        write_page(moving, lay_out(encoded(moved, scale), rows_of_cells, columns, padding, ZERO))
    if deep is not None:
        with running("depth") as progress:
            away = frames_depth(deep, numbers, frames, progress)
        reach = scale_of(away)
        write_page(depths, lay_out(encoded_depth(away, reach), rows_of_cells, columns, padding, ZERO))
    clipped = write_flipbook(paths, frames, layout, **placed)
    if shader:
        placed |= {"motion": scale, "depth": reach}
        hot = any(frame.emission is not None for frame in frames)
        for language in ("glsl", "hlsl", "msl", "wgsl"):
            text = smoke_shader(language, layout, **placed, count=len(frames), size=(height, width), hot=hot)
            atomic_write(output.with_suffix(ENDINGS[language]), text.encode())
    rows = table(str(smoke), ["file", "bytes", "channels"], text=["channels"])
    for path, names in zip(paths, channels(frames, layout), strict=True):
        rows.add_row(escape(str(path)), f"{path.stat().st_size:,}", " ".join(names))
    if scale is not None:
        rows.add_row(escape(str(moving)), f"{moving.stat().st_size:,}", "right up")
    if reach is not None:
        rows.add_row(escape(str(depths)), f"{depths.stat().st_size:,}", "depth")
    rows.add_section()
    around = f", {padding} around each" if padding else ""
    rows.add_row("frames", f"{len(frames):,}", f"{rows_of_cells} x {columns} cells of {width} x {height}{around}")
    rows.add_row("gain", f"{gain:.4g}", f"{clipped:,} numbers clipped")
    if scale is not None:
        rows.add_row("motion", f"{scale:.4g}", "of a frame, at most, to the next")
    if reach is not None:
        rows.add_row("depth", f"{reach:.4g}", "of a frame's height, at most, before or behind the billboard")
    show(rows)


def _light(text: str) -> "Light":
    """A light of `place_and_colour`."""
    from wlm.config import check_settings
    from wlm.smoke.scene import LightSettings

    values = dict(zip(("toward", "irradiance"), place_and_colour("--light", text), strict=False))
    return check_settings(LightSettings, values, "--light: ").light()


def _book(
    smoke: Path, textures: list[Path] | None, cells: str | None, layout: str | None, straight: bool
) -> "FlipBook | None":
    """The flip book that the options tell; None where they tell none."""
    from wlm.smoke.camera import LAYOUTS
    from wlm.smoke.shots import FlipBook

    if not textures:
        for option, given in (("cells", cells), ("from", layout), ("straight", straight)):
            if given:
                raise WlmError(f"--{option}: means nothing without --with, a flip book's second texture")
        return None
    if len(textures) > 2:
        raise WlmError(f"--with: expected a second texture and maybe one of opacity, got {len(textures)}")
    layout = "unity" if layout is None else layout
    if layout not in LAYOUTS:
        raise WlmError(f"--from: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    rows, cross, columns = (cells or "").partition("x")
    if not (cross and rows.isdecimal() and columns.isdecimal() and 0 < int(rows) <= 64 and 0 < int(columns) <= 64):
        raise WlmError(f"--cells: expected rows and columns of 1 to 64, such as 8x8, got {cells}")
    return FlipBook((smoke, *textures), layout, int(rows), int(columns), straight)


def _source(
    smoke: Path,
    options: SmokeOptions,
    step: float | None,
    supersample: int | None,
    default_step: float,
    book: "FlipBook | None",
) -> "BakedFiles | FlipBook | FramesToBake":
    """The lightmaps to shade or pack: a flip book's, those of bake or predict, else of smoke that is baked now."""
    from wlm.interop import check_device
    from wlm.smoke.shots import FramesToBake, baked_files

    device = check_device(options.device)
    baked = baked_files(smoke, device) if book is None else replace(book, device=device)
    if baked is not None:
        changes = options.given() | {"step": step, "supersample": supersample}
        if option := next((name for name, value in changes.items() if value is not None), None):
            kind = "was baked" if book is None else "is a flip book"
            remedy = "has to be given to bake" if book is None else "means nothing for it"
            raise WlmError(f"{smoke}: {kind}: --{option} {remedy}")
        return baked
    frames = options.open(smoke)
    return FramesToBake(frames, options.camera(frames), step or default_step, supersample or 1)


def _shots(
    source: "BakedFiles | FlipBook | FramesToBake", progress: "OnProgress", count: int | None = None
) -> "Iterator[Shot]":
    """The source's shots; notes repairs of their volumes."""
    for shot in source.shots(count, progress):
        for warning in shot.warnings:
            note(f"warning: {warning}")
        yield shot


register(app)
register_light(app)
register_run(app)
