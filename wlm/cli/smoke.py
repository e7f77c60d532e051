"""`wlm smoke`: simulate smoke, render guiding maps, and make six-way lightmaps by a march or by the network."""

from collections.abc import Callable
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli import smoke_book, smoke_light, smoke_network, smoke_run
from wlm.cli.console import escape, exclusive, note, number, quiet_warp, running, show, show_facts, table
from wlm.cli.options import CheckpointEvery, Device, Resume, Seed, output_option
from wlm.cli.smoke_network import evaluate, info
from wlm.cli.smoke_options import (
    G,
    Input,
    SceneFrames,
    SceneName,
    SceneScale,
    SmokeOptions,
    check_choice,
    march_frames,
    with_smoke,
    write_lightmaps,
)
from wlm.errors import WlmError
from wlm_kernels.smoke.settings import March

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.camera import Camera
    from wlm.smoke.lightmaps import SixWay
    from wlm.smoke.model import SmokeModel

__all__ = ["INSTEAD", "app", "evaluate", "info"]

INSTEAD = {
    "compress": "wlm smoke bake or predict, which make six-way lightmaps of smoke",
    "decode": "wlm smoke predict SMOKE --network FILE",
    "export": "wlm smoke export-onnx FILE",
}
_MARCH = 130  # steps of `predict --coarse` along the longest edge

app = typer.Typer(help="Smoke: simulation, six-way lightmaps, and pictures.")

_Output = Annotated[Path, output_option("OUT", "A .exr, or for frames a folder.")]


@app.command()
@exclusive
def simulate(
    scene_name: SceneName,
    output: Annotated[Path, output_option("DIR", "The folder of frames to write.")],
    frames: SceneFrames = None,
    scale: SceneScale = 1.0,
    velocity: Annotated[
        bool, typer.Option("--velocity", help="Also keep the velocity of the air, for flipbook --motion.")
    ] = False,
    resume: Resume = False,
    checkpoint_every: CheckpointEvery = 30.0,
    device: Device = "cpu",
) -> None:
    """Simulate a scene into a folder of volumes, one for each frame.

    The state is saved in DIR from time to time and on Ctrl-C or SIGTERM; repeat the command with --resume to continue
    exactly.
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
    # The solver comes first, so that a simulation that cannot start removes no earlier frames.
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
    facts: dict[str, Any] = {
        "frames": scene.frames,
        "cells of the air": " x ".join(map(str, scene.grid.cells)),
        "voxels of the smoke": " x ".join(map(str, scene.grid.shape)),
        "steps per frame": scene.steps,
    }
    if figures:
        facts |= {"smoke in the last frame": figures["smoke"], "seconds per frame": figures["frame s"]}
    show_facts(f"{output}: {scene.name}", facts)


@app.command()
@with_smoke
@exclusive
def guide(
    smoke: Input,
    output: _Output,
    options: SmokeOptions,
    step: Annotated[float, typer.Option(min=0.01, max=1000.0, help="Step of the march in voxels.")] = March.step,
    jitter: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="Largest random shift of the samples, as a share of a step.")
    ] = March.jitter,
    seed: Seed = March.seed,
    threshold: Annotated[
        float, typer.Option(min=0.0, help="Optical depth of a voxel from which smoke has a surface.")
    ] = March.threshold,
    g: G = March.g,
    resume: Resume = False,
) -> None:
    """Render guiding maps, the input of the network: light, transparency and depth of a coarse march (algorithm 1).

    Finished frames are kept when the command is stopped; repeat it with --resume to make the others.
    """
    quiet_warp()
    from wlm.smoke.data import write_guide
    from wlm.smoke.march.coarse import guide

    march = March(step, jitter=jitter, seed=seed, threshold=threshold, g=g)
    frames = options.open(smoke)
    camera = options.view(frames, orthographic=False)
    rows = table(str(smoke), ["file", "covered pixels", "mean light", "nearest depth", "farthest depth"])

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
    step: Annotated[float, typer.Option(min=0.01, max=1000.0, help="Longest step of the march in voxels.")] = 0.5,
    supersample: Annotated[int, typer.Option(min=1, max=16, help="Rays along the edge of a pixel.")] = 1,
    g: G = March.g,
    fit: Annotated[
        str,
        typer.Option(help="axes: exact for lights along the six axes; sphere: least error over all light directions."),
    ] = "axes",
    albedo: Annotated[
        float | None,
        typer.Option(min=0.0, max=1.0, help="With --fit sphere: include multiple scattering of this albedo."),
    ] = None,
    resume: Resume = False,
) -> None:
    """Make six-way lightmaps by a fine march and estimate the error of its step.

    An EXR has the channels right, left, top, bottom, front, back, transparency, and emission of hot smoke. Finished
    frames are kept when the command is stopped; repeat it with --resume to make the others.
    """
    check_choice("--fit", fit, ("axes", "sphere"))
    if fit == "sphere" and supersample > 1:
        raise WlmError("--supersample: expected 1 with --fit sphere")
    if albedo is not None and fit == "axes":
        raise WlmError("--albedo: expected --fit sphere: lightmaps of the axes have single scattering only")
    quiet_warp()
    from wlm.smoke.march.fine import bake

    frames = options.open(smoke)
    settings = {"step": step, "g": g, "supersample": supersample}
    make, made = partial(bake, **settings), {"made": "bake"} | settings
    if fit == "sphere":
        from wlm.smoke.transport.sphere import bake_sphere

        make = partial(bake_sphere, march=March(step, jitter=0.0, g=g), albedo=albedo)
        made |= {"fit": fit, "albedo": albedo}
    write_lightmaps(frames, options.view(frames), output, make, made, resume=resume, errors=fit == "axes")


@app.command()
@with_smoke
@exclusive
def predict(
    smoke: Input,
    output: _Output,
    options: SmokeOptions,
    network: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Network that wlm smoke train wrote; default the shipped one.")
    ] = None,
    coarse: Annotated[bool, typer.Option("--coarse", help="Use a coarse march alone, without a network.")] = False,
    step: Annotated[
        float | None,
        typer.Option(min=0.01, max=1000.0, help=f"Step of --coarse in voxels; default 1/{_MARCH} of the longest edge."),
    ] = None,
    seed: Seed = 0,
    resume: Resume = False,
) -> None:
    """Predict six-way lightmaps by the network from a guiding map: the result of bake, in less time.

    The files are like those of bake. Finished frames are kept when the command is stopped; repeat it with --resume to
    make the others.
    """
    if coarse and network is not None:
        raise WlmError("--coarse: expected no --network beside it")
    if step is not None and not coarse:
        raise WlmError("--step: expected --coarse: a network uses the step that it was trained with")
    quiet_warp()
    from wlm.smoke.codec import open_network

    frames = options.open(smoke)
    if coarse:
        made = {"made": "coarse", "step": step, "seed": seed}
        make = _coarse(step, seed)
    else:
        model = open_network(network)
        made = {"made": "network", "of": dict(model.summary), "seed": seed}
        make = _predicted(model, seed, frames.device)
    write_lightmaps(frames, options.view(frames), output, make, made, resume=resume)


def _coarse(step: float | None, seed: int) -> "Callable[[DensityVolume, Camera], SixWay]":
    """Returns a function that makes lightmaps by a coarse march."""
    from wlm.smoke.march.coarse import bake_coarse

    def make(volume: "DensityVolume", camera: "Camera") -> "SixWay":
        voxels = max(volume.shape) / _MARCH if step is None else step
        return bake_coarse(volume, camera, March(voxels, seed=seed))

    return make


def _predicted(model: "SmokeModel", seed: int, device: str) -> "Callable[[DensityVolume, Camera], SixWay]":
    """Returns a function that makes lightmaps by a network; it notes once if the network contributes little."""
    from wlm.smoke.network.prediction import SmokePredictor

    predictor, first = SmokePredictor(model, device), True

    def make(volume: "DensityVolume", camera: "Camera") -> "SixWay":
        nonlocal first
        six = predictor(volume, camera, seed)
        if first and (line := predictor.note()):
            note(line)
        first = False
        return six

    return make


for _module in (smoke_book, smoke_light, smoke_network, smoke_run):
    _module.register(app)
