"""`wlm smoke`: simulates and lights smoke, and makes six-way lightmaps by ray marching or with a network."""

from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape

from wlm.cli import console, smoke_book, smoke_network
from wlm.cli.options import CheckpointEvery, Device, Resume, Seed, output_option, with_options
from wlm.cli.smoke_network import evaluate, info
from wlm.cli.smoke_options import (
    SHEET,
    Background,
    FrameOptions,
    Input,
    Lights,
    Network,
    SmokeOptions,
    White,
    check_positive,
    note_thickness,
    outputs,
    parse_lights,
    vector,
    write_lightmaps,
)
from wlm.errors import WlmError
from wlm_kernels.smoke.settings import March

if TYPE_CHECKING:
    from wlm.smoke.scene import Scene

__all__ = ["INSTEAD", "app", "evaluate", "info"]

INSTEAD = {
    "compress": "wlm smoke bake or predict, which make six-way lightmaps of smoke",
    "decode": "wlm smoke predict SMOKE --network FILE",
    "export": "wlm smoke export-onnx FILE or export-three FILE",
}
_WARM = 2  # first frames of `run`, which compile kernels and are not timed if there are others

app = typer.Typer(help="Smoke: simulation, six-way lightmaps, and pictures.")

_SceneName = Annotated[
    str, typer.Argument(metavar="SCENE", help="Scene: a shipped one such as chimney, or a YAML file.")
]
_SceneFrames = Annotated[int | None, typer.Option(min=1, max=9999, help="Number of frames; default the scene's.")]
_SceneScale = Annotated[
    float, typer.Option(min=0.001, max=100.0, help="Factor on the scene's number of cells along each axis.")
]
_Albedo = Annotated[
    str | None,
    typer.Option(metavar="R,G,B", help="Single scattering albedo, one number or three; default the scene's, or 1."),
]
_G = Annotated[float, typer.Option(min=-0.99, max=0.99, help="Mean cosine of the Henyey-Greenstein phase function.")]
_Lightmaps = Annotated[Path, output_option("OUT", "The .exr to write; for a folder of frames, a folder.")]


@app.command()
@console.exclusive
def simulate(
    scene_name: _SceneName,
    output: Annotated[Path, output_option("DIR", "The folder of frames to write.")],
    frames: _SceneFrames = None,
    scale: _SceneScale = 1.0,
    volumes: Annotated[
        Literal["vdb", "nvdb", "nvdb-raw"] | None,
        typer.Option(
            help="Also write each frame, with velocities, as OpenVDB (vdb) or NanoVDB (nvdb; nvdb-raw: not compressed)."
        ),
    ] = None,
    resume: Resume = False,
    checkpoint_every: CheckpointEvery = 30.0,
    device: Annotated[
        str, typer.Option(help='Device: "cpu", "cuda", "cuda:N", or GPUs that share the work: "cuda:0,cuda:1".')
    ] = "cpu",
) -> None:
    """Simulate a scene into a folder of volumes, one for each frame.

    The state is saved in DIR from time to time and on Ctrl-C or SIGTERM; repeat the command with --resume to continue
    exactly.
    """
    console.quiet_warp()
    from wlm.interop import check_device
    from wlm.smoke.data import CHECKPOINT, open_frames
    from wlm.smoke.simulation import make_solver, simulate, warnings_of
    from wlm.system import Progress

    device = ",".join(map(check_device, device.split(",")))
    scene = _scene(scene_name, scale, frames)
    # The solver comes first, so that a simulation that cannot start removes no earlier frames.
    solver = make_solver(scene, device=device)
    console.note_warnings(warnings := warnings_of(scene))
    folder = open_frames(output, scene, resume=resume)
    figures: dict[str, float] = {}
    most = 0.0
    with console.running("simulate", output / CHECKPOINT, unit="frame") as report:

        def progress(now: Progress) -> None:
            nonlocal most
            figures.update(now.figures)
            most = max(most, figures.get("smoke m³", 0.0))
            report(now)

        options = {"resume": resume, "checkpoint_every": checkpoint_every, "volumes": volumes}
        first = simulate(folder, solver=solver, progress=progress, **options)
    if resume and first == 1:
        console.note(f"{output}: there was nothing to resume; started at frame 1")
    facts: dict[str, Any] = {
        "frames": scene.frames,
        "cells of the air": " x ".join(map(str, scene.grid.cells)),
        "voxels of the smoke": " x ".join(map(str, scene.grid.shape)),
        "steps per frame": round(1.0 / (scene.rate * solver.duration)),
    }
    if figures:
        facts |= {"smoke at the end, m³ of density 1": figures["smoke m³"], "seconds per frame": figures["frame s"]}
        if first == 1 and not most and not warnings:
            _note_no_smoke(scene)
    console.show_facts(f"{output}: {scene.name}", facts)


def _scene(name: str, scale: float, frames: int | None) -> "Scene":
    from wlm.smoke.scene import load_scene

    scene = load_scene(name)
    if scale != 1.0:
        scene = scene.scaled(scale)
    return scene if frames is None else scene.model_copy(update={"frames": frames})


def _note_no_smoke(scene: "Scene") -> None:
    console.note_warnings([f"{scene.name}: no frame has smoke: is each source inside an obstacle?"])


@app.command()
@with_options
@console.exclusive
def bake(
    smoke: Input,
    output: _Lightmaps,
    options: FrameOptions,
    step: Annotated[float, typer.Option(min=0.01, max=1000.0, help="Longest step of the ray march in voxels.")] = 0.5,
    supersample: Annotated[int, typer.Option(min=1, max=16, help="N: a pixel is the mean of N x N rays.")] = 1,
    g: _G = 0.0,
    fit: Annotated[
        Literal["axes", "sphere"],
        typer.Option(
            help="Best lightmaps for: axes, lights along the camera's axes (exact); sphere, lights from all sides."
        ),
    ] = "axes",
    albedo: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="With --fit sphere: add multiple scattering of this albedo; default none."),
    ] = None,
) -> None:
    """Make six-way lightmaps by fine ray marching, and estimate the error due to the step length.

    An EXR has the channels right, left, top, bottom, front, back, transparency, and emission of hot smoke. Finished
    frames are kept when the command is stopped; repeat it with --resume to make the others.
    """
    if fit == "sphere" and supersample > 1:
        raise WlmError(f"--supersample: expected 1 with --fit sphere, got {supersample}")
    if albedo is not None and fit == "axes":
        raise WlmError("--albedo needs --fit sphere: with --fit axes lightmaps have single scattering only")
    console.quiet_warp()
    settings: dict[str, Any] = {"step": step, "g": g, "supersample": supersample}
    method, made = "bake", {"made": "bake"} | settings
    if fit == "sphere":
        method, settings = fit, {"march": March(step, jitter=0.0, g=g), "albedo": albedo}
        made |= {"fit": fit, "albedo": albedo}
    write_lightmaps(options, smoke, output, (method, settings), made, errors=fit == "axes")


@app.command()
@with_options
@console.exclusive
def predict(smoke: Input, output: _Lightmaps, options: FrameOptions, network: Network = None, seed: Seed = 0) -> None:
    """Predict six-way lightmaps by a ray march in large steps: like bake, in less time.

    With --network a network removes the noise of a coarse march. The table names the method; the files are like those
    of bake. Finished frames are kept when the command is stopped; repeat it with --resume to make the others.
    """
    console.quiet_warp()
    from wlm.smoke.codec import open_network

    method: Any = "coarse" if network is None else open_network(network)
    made = {"made": "coarse"} if network is None else {"made": "network", "of": dict(method.summary)}
    write_lightmaps(options, smoke, output, (method, {"seed": seed}), made | {"seed": seed})


@app.command()
@with_options
@console.exclusive
def light(
    smoke: Input,
    output: Annotated[Path, output_option("OUT", "The .png or .exr to write; for a folder of frames, a folder.")],
    options: SmokeOptions,
    lights: Lights = None,
    points: Annotated[
        list[str] | None,
        typer.Option(
            "--point",
            metavar="X,Y,Z[:R,G,B]",
            help="Point light, repeatable: position in the world, and intensity, one number or three; default 1.",
        ),
    ] = None,
    sky: Annotated[
        str | None, typer.Option(metavar="R,G,B", help="Radiance of a uniform sky, also visible as the background.")
    ] = None,
    albedo: _Albedo = None,
    g: _G = 0.0,
    orders: Annotated[
        Literal["all", "single"], typer.Option(help="Orders of scattering: all, or single scattering only.")
    ] = "all",
    background: Background = None,
    white: White = 1.0,
) -> None:
    """Draw lit smoke by a ray march towards each light, with predicted multiple scattering.

    Without --light, --point and --sky the lights of the scene are used, or else one from 1,1,1. Twelve lights stand for
    a sky. A scene's obstacles are drawn with their shadows.
    """
    colour, around = _given_albedo(albedo), None if sky is None else vector("--sky", sky)
    behind = around if background is None else vector("--background", background)
    check_positive(white=white)
    own, twelve = parse_lights(lights, points, around)
    console.quiet_warp()
    from wlm.formats.exr import write_exr
    from wlm.interop import device_name
    from wlm.smoke.shading import Light
    from wlm.smoke.transport.lighting import LitSmoke, light_smoke
    from wlm.smoke.transport.orders import ScatteredSmoke, orders_march, scatter
    from wlm.view.pictures import contact_sheet, save_png, to_bytes
    from wlm.view.smoke import Drawing

    frames = options.open(smoke)
    camera = options.view(frames, orthographic=False)
    if frames.scene is not None:
        colour = colour or frames.scene.smoke.albedo
    if not own and around is None:
        own = [Light((1.0, 1.0, 1.0))] if frames.scene is None else [each.light() for each in frames.scene.lights]
    colour = colour or (1.0, 1.0, 1.0)
    file = outputs(smoke, frames.single, output, "light", ".png", ".exr")
    rows = console.table(str(smoke), ["file", "mean radiance", "largest", "pixels above white"])
    pictures, thickness = [], 0.0
    with console.running("light") as progress:
        for frame, volume in frames.volumes(progress=progress):
            console.note_warnings(volume.warnings)
            thickness = max(thickness, volume.thickness)
            view, looks = frames.view(camera, volume), frames.looks(frame)
            march, lamps = orders_march(volume, g), [*own, *twelve]
            extra: dict[str, Any] = {"albedo": colour, "device": device_name(volume.device)}
            if looks is not None:
                extra |= {"background": looks.background, "ramp": looks.ramp, "obstacles": looks.obstacles}
            if behind is not None:
                extra["background"] = behind
            drawing = Drawing(view, lamps, **extra)
            drawing.move(0.0 if looks is None else looks.time)
            volume = drawing.among(volume)
            if orders == "single":
                made: LitSmoke | ScatteredSmoke = light_smoke(volume, view, lamps, march)
            else:
                made = scatter(volume, view, lamps, colour, march=march)
            image = drawing(made)
            path = file(frame)
            if path.suffix.lower() == ".exr":
                write_exr(path, image.cpu().numpy())
            else:
                pictures.append(to_bytes(image, white))
                save_png(path, pictures[-1])
            clipped = float((image > white).any(-1).float().mean())
            rows.add_row(escape(path.name), f"{image.mean():.4g}", f"{image.max():.4g}", f"{clipped:.1%}")
    if not frames.single:
        contact_sheet(output / SHEET, {"": pictures})
    console.show(rows)
    note_thickness(frames, thickness)


@app.command()
@console.exclusive
def run(
    scene_name: _SceneName,
    output: Annotated[Path, output_option("OUT", "A folder of PNGs, or an .mp4.")],
    frames: _SceneFrames = None,
    scale: _SceneScale = 1.0,
    resolution: Annotated[
        int | None, typer.Option(min=1, max=16384, help="Height of the image in pixels; default the scene's.")
    ] = None,
    orders: Annotated[
        Literal["all", "single"] | None,
        typer.Option(
            help="Scattering: all orders, or single, by six-way lightmaps; default all, but single with --network."
        ),
    ] = None,
    albedo: _Albedo = None,
    network: Network = None,
    white: White = 1.0,
    device: Device = "cpu",
) -> None:
    """Simulate a scene, light it and draw it frame by frame, without intermediate files.

    The lights and the fire of the scene illuminate the smoke with all orders of scattering. A table shows the median
    time of each stage.
    """
    check_positive(white=white)
    if orders == "all" and network is not None:
        raise WlmError("--network: expected --orders single, since the network makes six-way lightmaps")
    colour = _given_albedo(albedo)
    film_file = output.suffix.lower() == ".mp4"
    console.begin(output if film_file else None, ".mp4")
    from wlm.formats.film import film
    from wlm.interop import check_device
    from wlm.smoke.data import NumberedFiles
    from wlm.smoke.network.prediction import SmokePredictor
    from wlm.smoke.simulation import warnings_of
    from wlm.view.pictures import save_png
    from wlm.view.smoke_run import Lighting, write_all
    from wlm.view.smoke_run import run as frames_of

    device = check_device(device)
    scene = _scene(scene_name, scale, frames)
    single = orders == "single" or network is not None
    camera = scene.camera if resolution is None else scene.camera.model_copy(update={"resolution": resolution})
    if film_file:  # whose width must be even
        width = 2 * max(round(0.5 * camera.resolution * camera.aspect), 1)
        camera = camera.model_copy(update={"aspect": width / camera.resolution})
    if camera.perspective and single:
        raise WlmError(f"{scene_name}: camera.perspective: expected false for six-way lightmaps, found true")
    scene = scene.model_copy(update={"camera": camera})
    if colour is not None:
        scene = scene.model_copy(update={"smoke": scene.smoke.model_copy(update={"albedo": colour})})
    console.note_warnings(warnings := warnings_of(scene))
    predictor = None if network is None else SmokePredictor(network, device)
    lighting = Lighting(None if single else scene.smoke.albedo, predictor)
    with console.running("run", unit="frame") as progress:
        made = frames_of(scene, lighting, white=white, device=device, progress=progress)
        if film_file:
            with film(output, camera.resolution, width, scene.rate) as add:
                seconds, smoke = write_all(made, lambda number, pixels: add(pixels))
        else:
            files = NumberedFiles(output, "run", ".png")
            seconds, smoke = write_all(made, lambda number, pixels: save_png(files.file(number), pixels))
    if not smoke and not warnings:
        _note_no_smoke(scene)
    rows = console.table(f"{output}: {scene.name}, {scene.frames} frames", ["stage", "ms per frame", "frames"])
    for stage, taken in seconds.items():
        counted = taken[_WARM:] or taken
        rows.add_row(stage, console.number(1e3 * median(counted), ".4g"), f"{len(taken)}")
    console.show(rows)


def _given_albedo(text: str | None) -> tuple[float, float, float] | None:
    if text is None:
        return None
    values = vector("--albedo", text if "," in text else ",".join([text] * 3))
    if not all(0 <= value <= 1 for value in values):
        raise WlmError(f"--albedo: expected numbers of 0 to 1, got {text!r}")
    return values


for _module in (smoke_book, smoke_network):
    _module.register(app)
