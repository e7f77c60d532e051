"""`wlm smoke run`: a scene as pictures or a film, in memory."""

from pathlib import Path
from statistics import median
from typing import Annotated

import typer

from wlm.cli.console import check_output, exclusive, number, quiet_warp, running, show, table
from wlm.cli.options import Device, Seed, output_option
from wlm.cli.smoke_options import Albedo, SceneName, given_albedo
from wlm.errors import WlmError

_WARM = 2  # frames at the beginning that compile and fill caches, and don't count where there are others


def register(app: typer.Typer) -> None:
    """Adds the command to `wlm smoke`."""
    app.command()(run)


@exclusive
def run(
    scene_name: SceneName,
    output: Annotated[Path, output_option("OUT", "A folder of PNGs, or an .mp4.")],
    frames: Annotated[int | None, typer.Option(min=1, max=9999, help="How many; default the scene's.")] = None,
    scale: Annotated[
        float, typer.Option(min=0.001, max=100.0, help="Cells along each axis, as a multiple of the scene's.")
    ] = 1.0,
    resolution: Annotated[
        int | None, typer.Option(min=1, max=16384, help="Pixels along the image's height; default the scene's.")
    ] = None,
    orders: Annotated[
        str | None,
        typer.Option(
            help="all: light that is scattered again too; single: once alone, by six-way lightmaps. Default all, or "
            "single with --network."
        ),
    ] = None,
    albedo: Albedo = None,
    model: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Of all orders; default the one that comes with wlm.")
    ] = None,
    step: Annotated[
        float | None,
        typer.Option(min=0.01, max=1000.0, help="Voxels, of the march; default 1/130 of the longest edge."),
    ] = None,
    network: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Make six-way lightmaps by a network that train wrote."),
    ] = None,
    white: Annotated[float, typer.Option(help="The light that becomes white.")] = 1.0,
    seed: Seed = 0,
    device: Device = "cpu",
) -> None:
    """Simulate a scene, light it and draw it, frame by frame, without a file between.

    Its lights and its fire light the smoke with light of all orders of scattering. The table has the median time of
    each stage; on a GPU the light of a frame becomes one graph after a few frames.
    """
    if not 0 < white < float("inf"):
        raise WlmError(f"--white: expected a number above 0, got {white}")
    orders = orders or ("all" if network is None else "single")
    if orders not in ("all", "single"):
        raise WlmError(f"--orders: expected all or single, got {orders!r}")
    if orders == "single" and model is not None:
        raise WlmError("--model: expected --orders all beside it")
    if orders == "all" and network is not None:
        raise WlmError("--network: expected --orders single beside it: it makes six-way lightmaps")
    if orders == "all" and seed:
        raise WlmError("--seed: expected --orders single beside it: of all orders nothing is drawn at random")
    colour = given_albedo(albedo)
    if network is not None and step is not None:
        raise WlmError("--step: expected no --network beside it: a network looks as it was trained to")
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
        lighting = AllOrders(scene.smoke.albedo, load_orders(model), step)
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
    rows = table(f"{output}: {scene.name}, {scene.frames} frames", ["stage", "ms a frame", "frames"])
    for stage, taken in seconds.items():
        counted = taken[_WARM:] or taken
        rows.add_row(stage, number(1e3 * median(counted), ".4g"), f"{len(taken)}")
    show(rows)
