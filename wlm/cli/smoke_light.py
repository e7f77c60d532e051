"""`wlm smoke light` and `trace`: pictures of smoke with multiple scattering, by a march and by path tracing."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import check_output, escape, exclusive, note_warnings, number, quiet_warp, running, show, table
from wlm.cli.options import Seed, output_option
from wlm.cli.smoke_options import (
    SHEET,
    Albedo,
    Background,
    G,
    Input,
    SmokeOptions,
    White,
    check_choice,
    check_white,
    given_albedo,
    outputs,
    vector,
    vectors,
    with_smoke,
)
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.fluid.volume import DensityVolume
    from wlm.smoke.data import Frames
    from wlm.smoke.scene import Scene
    from wlm.smoke.transport.lights import AnyLight, Environment
    from wlm.smoke.transport.tracing import Transport

_Lights = Annotated[
    list[str] | None,
    typer.Option("--light", metavar="X,Y,Z[:R,G,B]", help="Direction to a light and its irradiance; repeat for more."),
]
_Points = Annotated[
    list[str] | None,
    typer.Option(
        "--point", metavar="X,Y,Z[:R,G,B]", help="Position of a point light and its intensity; repeat for more."
    ),
]
_Sky = Annotated[
    str | None, typer.Option(metavar="R,G,B", help="Radiance of a uniform sky, also visible as the background.")
]


def register(app: typer.Typer) -> None:
    """Adds the commands to `wlm smoke`."""
    for command in (light, trace):
        app.command()(command)


@with_smoke
@exclusive
def light(
    smoke: Input,
    output: Annotated[Path, output_option("OUT", "A .png, or for frames a folder.")],
    options: SmokeOptions,
    lights: _Lights = None,
    points: _Points = None,
    sky: _Sky = None,
    albedo: Albedo = None,
    g: G = 0.0,
    orders: Annotated[
        str, typer.Option(help="Orders of scattering: all, of which multiple ones are predicted, or single.")
    ] = "all",
    step: Annotated[
        float | None,
        typer.Option(min=0.01, max=1000.0, help="Step of the march in voxels; default 1/130 of the longest edge."),
    ] = None,
    background: Background = None,
    white: White = 1.0,
) -> None:
    """Light smoke into PNGs by a march towards each light; multiple scattering is predicted.

    Without --light, --point and --sky the lights are those of the scene, or one from 1,1,1. A sky counts as twelve
    lights. Obstacles of a scene are drawn and cast shadows.
    """
    check_choice("--orders", orders, ("all", "single"))
    colour, around = given_albedo(albedo), None if sky is None else vector("--sky", sky)
    behind = around if background is None else vector("--background", background)
    check_white(white)
    own = _lights(lights, points) + ([] if around is None else list(_even(around).lights()))
    quiet_warp()
    from wlm.smoke.transport.lighting import light_smoke
    from wlm.smoke.transport.orders import load_orders, orders_march, scatter
    from wlm.view.pictures import contact_sheet, save_png, to_bytes
    from wlm.view.smoke import picture
    from wlm_kernels.smoke.settings import March

    frames = options.open(smoke)
    camera = options.view(frames, orthographic=False)
    lamps, colour = own or _scene_lights(frames.scene), colour or _scene_albedo(frames.scene)
    network = load_orders() if orders == "all" else None
    file = outputs(smoke, frames.single, output, "light", ".png")
    rows = table(str(smoke), ["file", "covered pixels", "mean", "largest", "clipped pixels"])
    pictures = []
    with running("light") as progress:
        for frame, volume in frames.volumes(progress=progress):
            note_warnings(volume.warnings)
            view = frames.view(camera, volume)
            march = orders_march(volume, g) if step is None else March(step=step, jitter=0.0, g=g)
            if network is None:
                made = light_smoke(volume, view, lamps, march)
            else:
                made = scatter(volume, view, lamps, colour, march=march, model=network)
            extra, background = {}, (0.0, 0.0, 0.0)
            if (looks := frames.looks(frame)) is not None:
                extra = {"ramp": looks.ramp, "obstacles": looks.obstacles, "time": looks.time}
                background = looks.background
            background = background if behind is None else behind
            shaded = picture(made, albedo=colour, background=background, **extra)
            pictures.append(to_bytes(shaded, white))
            path = file(frame)
            save_png(path, pictures[-1])
            transparency = (made if network is None else made.lit).transparency
            covered, clipped = (float(part.float().mean()) for part in (transparency < 0.99, (shaded > white).any(-1)))
            rows.add_row(
                escape(path.name), f"{covered:.1%}", f"{shaded.mean():.4g}", f"{shaded.max():.4g}", f"{clipped:.1%}"
            )
    if not frames.single:
        contact_sheet(output / SHEET, {"": pictures})
    show(rows)


@with_smoke
@exclusive
def trace(
    smoke: Input,
    output: Annotated[Path, output_option("OUT", "A .png or .exr, or for frames a folder of PNGs.")],
    options: SmokeOptions,
    lights: _Lights = None,
    points: _Points = None,
    sky: _Sky = None,
    albedo: Albedo = None,
    g: G = 0.0,
    samples: Annotated[int, typer.Option(min=2, max=2**20, help="Paths per pixel.")] = 64,
    orders: Annotated[
        int, typer.Option(min=0, max=1000, help="Orders of scattering with their own channels in an EXR.")
    ] = 1,
    white: White = 1.0,
    seed: Seed = 0,
) -> None:
    """Trace paths through smoke: all orders of scattering without bias, with an estimate of the noise.

    Without --light, --point and --sky the lights are those of the scene, or one from 1,1,1. Hot smoke also emits grey
    light. Obstacles of a scene absorb all light, and its background is not drawn. An EXR has the channels R, G, B; R.1,
    G.1, B.1 of single scattering, and so on; and R.noise, G.noise, B.noise.
    """
    colour, around = given_albedo(albedo), None if sky is None else vector("--sky", sky)
    check_white(white)
    own = _lights(lights, points)
    quiet_warp()
    from wlm.smoke.scene import obstacle_mesh
    from wlm.smoke.transport.tracing import trace
    from wlm.view.pictures import save_png, to_bytes

    environment = None if around is None else _even(around)
    frames = options.open(smoke)
    camera = options.view(frames, orthographic=False)
    scene = frames.scene
    colour = colour or _scene_albedo(scene)
    lamps = own or ([] if environment is not None else _scene_lights(scene))
    if frames.single:
        check_output(output, ".png", ".exr")
    as_exr = frames.single and output.suffix.lower() == ".exr"
    file = (lambda frame: output) if frames.single else outputs(smoke, False, output, "trace", ".png")
    settings = {"albedo": colour, "g": g, "samples": samples, "orders": orders, "seed": seed}
    rows = table(str(smoke), ["file", "mean", "largest", "multiple scattering", "noise"])
    with running("trace") as progress:
        for frame, volume in _each(frames):
            view = frames.view(camera, volume)
            solid = None
            if scene is not None and scene.obstacles:
                solid = obstacle_mesh(scene.obstacles, frames.time(frame))[:2]
            extra = {"environment": environment, "obstacles": solid, "progress": progress}
            try:
                made = trace(volume, view, lamps, **settings, **extra)
            except WlmError as error:
                raise WlmError(f"{frames.file(frame)}: {error}") from error
            path, image = file(frame), made.total
            if as_exr:
                _write_exr(path, made)
            else:
                save_png(path, to_bytes(image, white))
            more = float(made.planes[:, 2:].sum() / made.planes[:, 1:].sum().clamp(min=1e-30))
            rows.add_row(
                escape(path.name),
                number(float(image.mean()), ".4g"),
                number(float(image.max()), ".4g"),
                "" if orders < 1 else f"{more:.1%}",
                f"{made.error:.2%}",
            )
    show(rows)


def _each(frames: "Frames") -> "Iterator[tuple[int, DensityVolume]]":
    """Yields the volumes of frames and notes their warnings."""
    for frame, volume in frames.volumes():
        note_warnings(volume.warnings)
        yield frame, volume


def _write_exr(path: Path, made: "Transport") -> None:
    from wlm.formats.exr import write_planes

    orders = made.planes.sum(0).cpu().numpy()
    noise = made.total_noise.cpu().numpy()
    planes = {}
    for channel, letter in enumerate("RGB"):
        planes[letter] = orders[..., channel].sum(0)
        for order in range(made.orders + 1):
            planes[f"{letter}.{order}"] = orders[order, ..., channel]
        planes[f"{letter}.noise"] = noise[..., channel]
    note = {"albedo": made.albedo, "samples": made.samples, "sources": made.sources, "noise": made.error}
    write_planes(path, planes, note, whole=tuple(planes))


def _checked(option: str, make: Callable[[], Any]) -> Any:
    """Calls a function of an option's values; its ValueError becomes one line that names the option."""
    try:
        return make()
    except ValueError as error:
        raise WlmError(f"{option}: {error}") from error


def _even(colour: tuple[float, float, float]) -> "Environment":
    """Returns the uniform sky of `--sky`."""
    from wlm.smoke.transport.lights import Environment

    return _checked("--sky", lambda: Environment.even(colour))


def _lights(directions: list[str] | None, places: list[str] | None) -> "list[AnyLight]":
    """Returns the lights of `--light` and `--point`."""
    from wlm.smoke.camera import unit
    from wlm.smoke.shading import Light
    from wlm.smoke.transport.lights import PointLight, checked_colour

    made: list[AnyLight] = []
    for option, texts in (("--light", directions), ("--point", places)):
        for text in texts or ():
            values = vectors(option, text)
            if len(values) == 2:
                _checked(option, lambda values=values: checked_colour("colour", values[1]))
            if option == "--light":
                _checked(option, lambda values=values: unit(values[0], "direction"))
            kind = Light if option == "--light" else PointLight
            made.append(_checked(option, lambda kind=kind, values=values: kind(*values)))
    return made


def _scene_lights(scene: "Scene | None") -> "list[AnyLight]":
    from wlm.smoke.shading import Light

    return [Light((1.0, 1.0, 1.0))] if scene is None else [settings.light() for settings in scene.lights]


def _scene_albedo(scene: "Scene | None") -> tuple[float, float, float]:
    return (1.0, 1.0, 1.0) if scene is None else scene.smoke.albedo
