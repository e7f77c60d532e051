"""`wlm smoke run`: simulates, lights and draws a scene in memory."""

from pathlib import Path
from statistics import median
from typing import Annotated

import typer

from wlm.cli.console import check_output, exclusive, number, quiet_warp, running, show, table
from wlm.cli.options import Device, Seed, output_option
from wlm.cli.smoke_options import (
    Albedo,
    SceneFrames,
    SceneName,
    SceneScale,
    White,
    check_choice,
    check_white,
    given_albedo,
)
from wlm.errors import WlmError

_WARM = 2  # first frames, which compile kernels and are not timed if there are others


def register(app: typer.Typer) -> None:
    """Adds the command to `wlm smoke`."""
    app.command()(run)


@exclusive
def run(
    scene_name: SceneName,
    output: Annotated[Path, output_option("OUT", "A folder of PNGs, or an .mp4.")],
    frames: SceneFrames = None,
    scale: SceneScale = 1.0,
    resolution: Annotated[
        int | None, typer.Option(min=1, max=16384, help="Height of the image in pixels; default the scene's.")
    ] = None,
    orders: Annotated[
        str | None,
        typer.Option(
            help="Orders of scattering: all, or single by six-way lightmaps. Default all, or single with --network."
        ),
    ] = None,
    albedo: Albedo = None,
    step: Annotated[
        float | None,
        typer.Option(min=0.01, max=1000.0, help="Step of the march in voxels; default 1/130 of the longest edge."),
    ] = None,
    network: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Make the six-way lightmaps by this network of wlm smoke train."),
    ] = None,
    white: White = 1.0,
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Simulate a scene, light it and draw it frame by frame, without intermediate files.

    The lights and the fire of the scene illuminate the smoke with all orders of scattering. The table has the median
    time of each stage; on a GPU a CUDA graph replaces the stages of the light after some frames.
    """
    check_white(white)
    orders = orders or ("all" if network is None else "single")
    check_choice("--orders", orders, ("all", "single"))
    if orders == "all" and network is not None:
        raise WlmError("--network: expected --orders single: it makes six-way lightmaps")
    if orders == "all" and seed:
        raise WlmError("--seed: expected --orders single: all orders need no random numbers")
    colour = given_albedo(albedo)
    if network is not None and step is not None:
        raise WlmError("--step: expected no --network: a network uses the step that it was trained with")
    film_file = output.suffix.lower() == ".mp4"
    if film_file:
        check_output(output, ".mp4")
    quiet_warp()
    from wlm.formats.film import film
    from wlm.interop import check_device
    from wlm.smoke.data import NumberedFiles
    from wlm.smoke.network.prediction import SmokePredictor
    from wlm.smoke.scene import load_scene
    from wlm.smoke.transport.orders import load_orders
    from wlm.view.pictures import save_png
    from wlm.view.smoke_run import AllOrders, SixWays, write_all
    from wlm.view.smoke_run import run as frames_of

    device = check_device(device)
    scene = load_scene(scene_name)
    if scale != 1.0:
        scene = scene.scaled(scale)
    camera = scene.camera if resolution is None else scene.camera.model_copy(update={"resolution": resolution})
    if camera.perspective and orders == "single":
        raise WlmError(f"{scene_name}: camera.perspective: expected false for six-way lightmaps, found true")
    scene = scene.model_copy(update={"camera": camera, "frames": frames or scene.frames})
    if colour is not None:
        scene = scene.model_copy(update={"smoke": scene.smoke.model_copy(update={"albedo": colour})})
    if orders == "all":
        lighting = AllOrders(scene.smoke.albedo, load_orders(), step)
    else:
        lighting = SixWays(step, None if network is None else SmokePredictor(network, device), seed)
    with running("run", unit="frame") as progress:
        made = frames_of(scene, lighting, white=white, device=device, progress=progress)
        if film_file:
            width = max(round(camera.resolution * camera.aspect), 1)
            with film(output, camera.resolution, width, scene.rate) as add:
                seconds = write_all(made, lambda number, pixels: add(pixels))
        else:
            files = NumberedFiles(output, "run", ".png")
            seconds = write_all(made, lambda number, pixels: save_png(files.file(number), pixels))
    rows = table(f"{output}: {scene.name}, {scene.frames} frames", ["stage", "ms per frame", "frames"])
    for stage, taken in seconds.items():
        counted = taken[_WARM:] or taken
        rows.add_row(stage, number(1e3 * median(counted), ".4g"), f"{len(taken)}")
    show(rows)
