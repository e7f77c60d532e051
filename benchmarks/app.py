"""The command line `python -m benchmarks`: measurements, reports, plots and comparisons of results."""

import importlib
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wlm.cli.app import Group
from wlm.cli.console import check_output, note, quiet_warp, show_text
from wlm.cli.options import Device, output_option
from wlm.errors import WlmError

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from benchmarks import Row

app = typer.Typer(
    cls=Group,
    name="benchmarks",
    help="Measure speed and error of every system and of its rivals.",
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_Quick = Annotated[bool, typer.Option("--quick", help="Run fewer steps and rows, in minutes on a CPU.")]
_SmallGrids = Annotated[bool, typer.Option("--quick", help="Use small grids, for a minute on a CPU.")]
_RowsFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment to this file.")
]
_Profiles = Annotated[
    list[str] | None, typer.Option("--profile", metavar="NAME", help="Profiles to measure. Repeatable; default: all.")
]
_Rivals = Annotated[bool, typer.Option("--rivals/--no-rivals", help="Measure the rivals too, in minutes on a CPU.")]
_RivalsAt = Annotated[
    Path | None,
    typer.Option("--rivals-at", metavar="FILE.json", help="Measure only the rivals, at our sizes in this result file."),
]
_Set = Annotated[Path | None, typer.Option("--set", metavar="SET", help="A lightmap set. Default: the demo's.")]
_Only = Annotated[list[str] | None, typer.Option("--only", metavar="ROW", help="Rows to measure. Repeatable.")]
_Steps = Annotated[int | None, typer.Option(min=1, help="Steps of each fit. Default: the profile's.")]
_Meshes = Annotated[
    Path | None,
    typer.Option(
        "--meshes", metavar="DIR", help="A folder of folders, each with a .glb, its .exr lightmaps and maybe mask.png."
    ),
]
_Mesh = Annotated[Path | None, typer.Option("--mesh", metavar="FILE", help="One mesh in place of --meshes.")]
_Lightmaps = Annotated[
    list[Path] | None, typer.Option("--lightmap", metavar="FILE.exr", help="A lightmap of --mesh. Repeatable.")
]
_Mask = Annotated[Path | None, typer.Option("--mask", metavar="FILE.png", help="The mask of --lightmap.")]
_Results = Annotated[list[Path], typer.Argument(metavar="FILE.json...", help="Files that --json wrote.")]


@app.command()
def lightmap(
    quick: _Quick = False,
    device: Device = "cpu",
    set_path: _Set = None,
    profiles: _Profiles = None,
    rivals: _Rivals = True,
    rivals_only: Annotated[bool, typer.Option("--rivals-only", help="Measure only the rivals.")] = False,
    rival_names: Annotated[
        list[str] | None, typer.Option("--rival", metavar="NAME", help="Measure only this rival. Repeatable.")
    ] = None,
    json_path: _RowsFile = None,
) -> None:
    """Measure lightmaps over time: PSNR, bits per texel and decode time of profiles, block codecs, PCA and AV1."""
    device = _prepare(device, json_path)
    from benchmarks.lightmap import run, run_rivals

    common = {"quick": quick, "device": device, "set_path": set_path, "progress": note}
    if rivals_only or rival_names:
        if not rivals or profiles:
            raise WlmError("--rivals-only: expected without --no-rivals and --profile")
        rows = run_rivals(names=rival_names, **common)
        options = {"rivals_only": rivals_only, "rival": rival_names}
    else:
        rows = run(names=profiles, rivals=rivals, **common)
        options = {"profile": profiles, "no_rivals": not rivals}
    partial = bool(profiles or rival_names)
    scene = set_path and rows[0].scene
    _finish(rows, device, json_path, "lightmap", partial=partial, quick=quick, **options, device=device, set=scene)


@app.command("lightmap-ablation")
def lightmap_ablation(
    quick: _Quick = False,
    device: Device = "cpu",
    set_path: _Set = None,
    steps: _Steps = None,
    only: _Only = None,
    json_path: _RowsFile = None,
) -> None:
    """Measure lightmaps over time with other feature maps of the same size, and without block simulation."""
    device = _prepare(device, json_path)
    from benchmarks.lightmap_ablation import run

    options = {"quick": quick, "device": device, "set": set_path, "steps": steps, "only": only}
    done = _writer(device, json_path, "lightmap-ablation", **options)
    rows = run(only or (), quick=quick, device=device, set_path=set_path, steps=steps, progress=note, done=done)
    _finish(rows, device, None, "lightmap-ablation")


@app.command()
def probe(
    quick: _Quick = False,
    device: Device = "cpu",
    probes_path: Annotated[
        Path | None, typer.Option("--probes", metavar="FILE", help="Light probes. Default: the demo's.")
    ] = None,
    keys: Annotated[list[str] | None, typer.Option("--key", help="An array of the file. Repeatable.")] = None,
    rivals: _Rivals = True,
    rivals_at: _RivalsAt = None,
    volume_only: Annotated[bool, typer.Option("--volume-only", help="Measure only the volume.")] = False,
    json_path: _RowsFile = None,
) -> None:
    """Measure light probes: PSNR, size and decode time of the profiles, their decoders and the PCA family."""
    device = _prepare(device, json_path)
    from benchmarks.probe import run, run_rivals, run_volume

    common = {"probes_path": probes_path, "keys": keys or (), "progress": note}
    options: dict[str, object] = {"quick": quick, "no_rivals": not rivals, "device": device}
    if volume_only:
        if quick or not rivals or rivals_at is not None:
            raise WlmError("--volume-only: expected without --quick, --no-rivals and --rivals-at")
        rows, options = run_volume(device=device, **common), {"volume_only": True, "device": device}
    elif rivals_at is not None:
        if quick or not rivals or device != "cpu":
            raise WlmError("--rivals-at: expected without --quick, --no-rivals and --device: the rivals need no GPU")
        rows, options = run_rivals(**common), {"rivals_at": rivals_at}
    else:
        rows = run(quick=quick, device=device, rivals=rivals, **common)
    _finish(rows, device, json_path, "probe", partial=volume_only, **options, probes=probes_path, key=keys)


@app.command()
def atlas(
    quick: _Quick = False,
    device: Device = "cpu",
    meshes_path: _Meshes = None,
    mesh_path: _Mesh = None,
    lightmap_paths: _Lightmaps = None,
    mask_path: _Mask = None,
    profiles: _Profiles = None,
    rivals: _Rivals = True,
    rivals_at: _RivalsAt = None,
    json_path: _RowsFile = None,
) -> None:
    """Measure lightmaps of meshes: PSNR, SSIM, size and decode time of profiles, smaller lightmaps, block codecs."""
    device = _prepare(device, json_path)
    from benchmarks.atlas import run, run_rivals
    from benchmarks.atlas_inputs import load

    lightmaps = load(meshes_path, mesh_path, lightmap_paths or (), mask_path)
    files = {"meshes": meshes_path, "mesh": mesh_path, "lightmap": lightmap_paths, "mask": mask_path}
    if rivals_at is not None:
        if quick or not rivals or profiles or device != "cpu":
            raise WlmError("--rivals-at: expected without --quick, --profile, --no-rivals and --device")
        rows = run_rivals(rivals_at, lightmaps, progress=note)
        _finish(rows, device, json_path, "atlas", rivals_at=rivals_at, **files)
        return
    rows = run(lightmaps, profiles or (), quick=quick, device=device, rivals=rivals, progress=note)
    options = {"quick": quick, "no_rivals": not rivals, "device": device, **files, "profile": profiles}
    _finish(rows, device, json_path, "atlas", **options)


@app.command("atlas-scene")
def atlas_scene(
    set_path: Annotated[Path, typer.Option("--set", metavar="SET", help="A lightmap set with a mesh to cut.")],
    hours: Annotated[list[float] | None, typer.Option("--hour", help="A state. Repeatable; default: all.")] = None,
    side: Annotated[int | None, typer.Option(min=1, help="Texels of the longer side, a divisor of it.")] = None,
    profiles: _Profiles = None,
    budget: Annotated[float | None, typer.Option(help="A budget in place of the profile's.")] = None,
    parts: Annotated[
        bool, typer.Option("--parts/--no-parts", help="Measure each object and state alone at equal bits, too.")
    ] = True,
    quick: Annotated[bool, typer.Option("--quick", help="Use few small views, for a CPU.")] = False,
    device: Device = "cpu",
    json_path: _RowsFile = None,
) -> None:
    """Measure scenes: PSNR of all objects and hours in one model, and of each alone in as many bits."""
    device = _prepare(device, json_path)
    from benchmarks.atlas_scene import run
    from benchmarks.scene_inputs import load

    scene = load(set_path, hours or (), side)
    views = {"views": 8, "resolution": 128} if quick else {}
    rows = run(scene, profiles or (), budget=budget, device=device, parts=parts, **views, progress=note)
    options = {"set": set_path, "hour": hours, "side": side, "profile": profiles, "budget": budget}
    _finish(rows, device, json_path, "atlas-scene", **options, no_parts=not parts, quick=quick, device=device)


@app.command("atlas-ablation")
def atlas_ablation(
    profile: Annotated[str, typer.Option(metavar="NAME", help="The cascade profile or YAML file to vary.")] = "paper",
    quick: _Quick = False,
    device: Device = "cpu",
    meshes_path: _Meshes = None,
    mesh_path: _Mesh = None,
    lightmap_paths: _Lightmaps = None,
    mask_path: _Mask = None,
    steps: _Steps = None,
    only: _Only = None,
    json_path: _RowsFile = None,
) -> None:
    """Measure lightmaps of meshes: the cascade without its parts, and with textures of other sizes."""
    device = _prepare(device, json_path)
    from benchmarks.atlas_ablation import choose, run
    from benchmarks.atlas_inputs import load
    from wlm.atlas.model import Profile

    choose(Profile.load(profile), only or ())  # a misspelt name fails before the meshes are read
    lightmaps = load(meshes_path, mesh_path, lightmap_paths or (), mask_path)
    files = {"meshes": meshes_path, "mesh": mesh_path, "lightmap": lightmap_paths, "mask": mask_path}
    options = {"quick": quick, "profile": Path(profile), "device": device, **files, "steps": steps, "only": only}
    done = _writer(device, json_path, "atlas-ablation", partial=bool(only), **options)
    rows = run(lightmaps, profile, only or (), quick=quick, device=device, steps=steps, progress=note, done=done)
    _finish(rows, device, json_path, "atlas-ablation", partial=bool(only), **options)


@app.command()
def smoke(quick: _SmallGrids = False, device: Device = "cpu", json_path: _RowsFile = None) -> None:
    """Measure smoke: the lattice beside a copy, advection, guiding maps, six-way lightmaps and whole frames."""
    device = _prepare(device, json_path)
    from benchmarks.smoke import run

    rows = run(quick=quick, device=device, progress=note)
    _finish(rows, device, json_path, "smoke", quick=quick, device=device)


@app.command("smoke-orders")
def smoke_orders(quick: _SmallGrids = False, device: Device = "cpu", json_path: _RowsFile = None) -> None:
    """Measure smoke with light of all orders: PSNR, FLIP, flicker and time, ours and the rivals'."""
    device = _prepare(device, json_path)
    from benchmarks.smoke_orders import run

    rows = run(quick=quick, device=device, progress=note)
    _finish(rows, device, json_path, "smoke-orders", quick=quick, device=device)


@app.command("smoke-network")
def smoke_network(
    quick: _SmallGrids = False,
    device: Device = "cpu",
    networks: Annotated[
        list[Path] | None,
        typer.Option("--network", metavar="FILE", help="A trained network. Default: the one in wlm. Repeatable."),
    ] = None,
    profiles: Annotated[
        list[str] | None,
        typer.Option("--profile", metavar="NAME", help="A profile or YAML file to time untrained. Repeatable."),
    ] = None,
    json_path: _RowsFile = None,
) -> None:
    """Measure neural six-way lightmaps: time and error beside marches, flip books and path tracing."""
    device = _prepare(device, json_path)
    from benchmarks.smoke_network import run
    from wlm.smoke.codec import shipped

    rows = run(networks or ([] if profiles else [shipped()]), profiles or (), quick=quick, device=device, progress=note)
    options = {"network": networks, "profile": [Path(name) for name in profiles or ()]}
    _finish(rows, device, json_path, "smoke-network", quick=quick, device=device, **options)


@app.command("smoke-ablation")
def smoke_ablation(
    profile: Annotated[str, typer.Option(metavar="NAME", help="The profile or YAML file to vary.")] = "fast",
    quick: Annotated[bool, typer.Option("--quick", help="Use small images and few steps, for a CPU.")] = False,
    device: Device = "cpu",
    rounds: Annotated[int | None, typer.Option(min=1, help="Rounds of each training, with new samples.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each round.")] = None,
    only: _Only = None,
    json_path: _RowsFile = None,
) -> None:
    """Measure neural six-way lightmaps: short trainings with one setting of a profile changed at a time."""
    device = _prepare(device, json_path)
    from benchmarks.smoke_ablation import run

    lengths = {"rounds": rounds, "steps": steps}
    options = {"quick": quick, "profile": Path(profile), "device": device, **lengths, "only": only}
    done = _writer(device, json_path, "smoke-ablation", **options)
    rows = run(profile, only or (), quick=quick, device=device, **lengths, progress=note, done=done)
    _finish(rows, device, None, "smoke-ablation")


@app.command()
def report(
    files: _Results,
    output: Annotated[
        Path | None, output_option("INDEX.md", "The index; the pages go to a folder beside it. Default: print them.")
    ] = None,
) -> None:
    """Write result files as Markdown: an index and one page for each system."""
    from benchmarks import pages

    if output is None:
        show_text("\n".join(pages(files).values()))
        return
    check_output(output, ".md")
    from wlm.formats.atomic import atomic_write

    for name, page in pages(files, output).items():
        path = output.parent / name
        path.parent.mkdir(exist_ok=True)
        atomic_write(path, page.encode())


@app.command()
def plot(
    files: _Results,
    system: Annotated[str, typer.Option(metavar="NAME", help="lightmap, atlas, probe, smoke or smoke-network.")],
    output: Annotated[Path, output_option("FILE.png", "The picture, .png, .svg or .pdf.")],
) -> None:
    """Draw the rows of one system in result files: quality against size or time, and error against time."""
    from benchmarks import plot as draw
    from benchmarks import read_json

    if system not in ("lightmap", "atlas", "probe", "smoke", "smoke-network"):
        raise WlmError(f"--system: expected lightmap, atlas, probe, smoke or smoke-network, got {system}")
    check_output(output, ".png", ".svg", ".pdf")
    rows = [row for path in files for row in read_json(path)[0] if row.system == system]
    module = importlib.import_module(f"benchmarks.{system.replace('-', '_')}")
    draw(module.plotted(rows) if hasattr(module, "plotted") else rows, output, module.PANELS)


@app.command()
def compare(
    new: Annotated[Path, typer.Argument(metavar="NEW.json", help="Results of the code to check.")],
    old: Annotated[Path, typer.Argument(metavar="OLD.json", help="Results of the code before.")],
) -> None:
    """Fail where a figure of NEW is worse: by over 0.05 dB, or by over 5% of a time of the same machine."""
    from benchmarks import FIGURES, read_runs
    from benchmarks import compare as changes_between

    changes = [change for run in read_runs(new) for change in changes_between(run, read_runs(old))]
    if not changes:
        raise WlmError(f"{old}: expected rows of the same method, option and scene, found none")
    worse = [change for change in changes if change.worse]
    for change in worse:
        row, figure = change.row, FIGURES[change.name]
        name = " ".join(filter(None, (row.scene, row.method, row.option)))
        note(f"worse: {name}: {figure.heading}: {figure.text(change.old)} before, {figure.text(change.new)} now")
    note(f"{len(changes)} figures compared with {old}: {len(worse)} are worse")
    if worse:
        raise typer.Exit(1)


def _prepare(device: str, json_path: Path | None) -> str:
    """Checks the output and the device before long work, and returns the device's name."""
    from benchmarks import read_runs
    from wlm.interop import check_device

    if json_path is not None:
        check_output(json_path, ".json")
        if json_path.exists():
            read_runs(json_path)  # rows of other systems stay in the file, so it must be readable
    quiet_warp()
    return check_device(device)


def _writer(
    measured_on: str, json_path: Path | None, name: str, *, partial: bool = False, **options: object
) -> "Callable[[Sequence[Row]], None]":
    """Returns a function that writes the rows measured so far, so that an interrupted run keeps them."""
    from benchmarks import describe_environment, write_json

    words = ["python", "-m", "benchmarks", name]
    for option, value in options.items():
        for item in value if isinstance(value, list) else [value]:
            if item is not None and item is not False:
                words.append(f"--{option.replace('_', '-')}")
                if item is not True:
                    words.append(shlex.quote(item.name if isinstance(item, Path) else str(item)))

    def write(rows: "Sequence[Row]") -> None:
        if json_path is not None:
            write_json(json_path, rows, describe_environment(measured_on, " ".join(words)), partial=partial)

    return write


def _finish(
    rows: "Sequence[Row]",
    measured_on: str,
    json_path: Path | None,
    name: str,
    *,
    partial: bool = False,
    **options: object,
) -> None:
    """Writes the result file with the command that makes it again, and prints the rows as tables."""
    from benchmarks import tables

    _writer(measured_on, json_path, name, partial=partial, **options)(rows)
    show_text(tables(rows))
