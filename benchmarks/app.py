"""The commands of `python -m benchmarks`: speed against error, ours and the baselines."""

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

    from benchmarks import Panel, Row

app = typer.Typer(
    cls=Group,
    name="benchmarks",
    help="Speed against error, ours and the rivals.",
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)

_Quick = Annotated[bool, typer.Option("--quick", help="Fewer steps and rows, for a check in minutes.")]
_SmallGrids = Annotated[
    bool, typer.Option("--quick", help="Small grids, for a minute on a CPU; else the paper's, for a GPU.")
]
_RowsFile = Annotated[
    Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
]
_PlotFile = Annotated[
    Path | None,
    typer.Option("--plot", metavar="FILE.png", help="Draw quality against size or time, error against time."),
]
_Baseline = Annotated[
    Path | None,
    typer.Option(
        "--baseline",
        metavar="OLD.json",
        help="Fail where rows of this result file were better: by more than 0.05 dB, or by 5% of time on this machine.",
    ),
]
_Profiles = Annotated[
    list[str] | None, typer.Option("--profile", metavar="NAME", help="Profiles; default all. Several times.")
]
_Rivals = Annotated[bool, typer.Option("--rivals/--no-rivals", help="With the rivals, which take minutes on the CPU.")]
_RivalsAt = Annotated[
    Path | None,
    typer.Option(
        "--rivals-at", metavar="FILE.json", help="The rivals alone, at the sizes that ours have in this result file."
    ),
]

_Meshes = Annotated[
    Path | None,
    typer.Option(
        "--meshes",
        metavar="DIR",
        help="A folder of folders, each with a .glb, its lightmaps .exr and maybe mask.png; default the demo's.",
    ),
]
_Mesh = Annotated[Path | None, typer.Option("--mesh", metavar="FILE", help="Instead, one mesh: .glb, .gltf or .obj.")]
_Lightmaps = Annotated[
    list[Path] | None,
    typer.Option("--lightmap", metavar="FILE.exr", help="A lightmap of it; may be given several times."),
]
_Mask = Annotated[Path | None, typer.Option("--mask", metavar="FILE.png", help="Their mask.")]


@app.command()
def lightmap(
    quick: _Quick = False,
    device: Device = "cpu",
    set_path: Annotated[
        Path | None, typer.Option("--set", metavar="SET", help="A lightmap set; default the demo's.")
    ] = None,
    profiles: _Profiles = None,
    qualities: Annotated[
        list[int] | None,
        typer.Option("--quality", metavar="0..105", help="Profile video at this quality. Several times."),
    ] = None,
    rivals: _Rivals = True,
    rivals_only: Annotated[bool, typer.Option("--rivals-only", help="The rivals alone.")] = False,
    rival_names: Annotated[
        list[str] | None, typer.Option("--rival", metavar="NAME", help="Only this rival, such as bc7. Several times.")
    ] = None,
    json_path: _RowsFile = None,
    plot_path: _PlotFile = None,
    baseline: _Baseline = None,
) -> None:
    """Lightmaps over time: PSNR, bits a texel and decode time of the profiles, block codecs, PCA and a video codec."""
    device = _prepare(device, json_path, plot_path, baseline)
    from benchmarks.lightmap import PANELS, run, run_rivals

    common = {"quick": quick, "device": device, "set_path": set_path, "progress": note}
    if rivals_only or rival_names:
        if not rivals or profiles or qualities:
            raise WlmError("--rivals-only: expected without --no-rivals, --profile and --quality")
        rows = run_rivals(names=rival_names, **common)
        options = {"rivals_only": rivals_only, "rival": rival_names, "device": device}
    else:
        rows = run(names=profiles, qualities=qualities or (), rivals=rivals, **common)
        options = {"profile": profiles, "quality": qualities, "no_rivals": not rivals, "device": device}
    command = _command("lightmap", quick=quick, **options, set=set_path and rows[0].scene)
    partial = bool(profiles or qualities or rival_names)
    _finish(rows, command, device, json_path, plot_path, PANELS, baseline=baseline, partial=partial)


@app.command("lightmap-ablation")
def lightmap_ablation(
    quick: Annotated[bool, typer.Option("--quick", help="Few steps, for a minute on a CPU; else for a GPU.")] = False,
    device: Device = "cpu",
    set_path: Annotated[
        Path | None, typer.Option("--set", metavar="SET", help="A lightmap set; default the demo's.")
    ] = None,
    steps: Annotated[int | None, typer.Option(min=10, help="Of each fit; default the profile's.")] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="ROW", help="A row by its name; default all. Several times.")
    ] = None,
    json_path: _RowsFile = None,
    baseline: _Baseline = None,
) -> None:
    """Lightmaps over time: fits of other feature maps at the same bytes, and without the simulation of blocks."""
    device = _prepare(device, json_path, None, baseline)
    from benchmarks.lightmap_ablation import run

    command = _command(
        "lightmap-ablation", quick=quick, device=device, set=set_path and set_path.name, steps=steps, only=only
    )
    write = _writer(device, command, json_path)
    rows = run(only or (), quick=quick, device=device, set_path=set_path, steps=steps, progress=note, done=write)
    _finish(rows, command, device, None, None, baseline=baseline)


@app.command()
def probe(
    quick: _Quick = False,
    device: Device = "cpu",
    probes_path: Annotated[
        Path | None, typer.Option("--probes", metavar="FILE", help="Light probes; default the demo's.")
    ] = None,
    keys: Annotated[
        list[str] | None, typer.Option("--key", help="Which of the file's arrays; may be given several times.")
    ] = None,
    rivals: _Rivals = True,
    rivals_at: _RivalsAt = None,
    volume_only: Annotated[
        bool, typer.Option("--volume-only", help="Measure the volume only: original probes and principal components.")
    ] = False,
    json_path: _RowsFile = None,
    plot_path: _PlotFile = None,
    baseline: _Baseline = None,
) -> None:
    """Light probes: PSNR, size and decode time of the profiles, of their decodes and of the PCA family."""
    device = _prepare(device, json_path, plot_path, baseline)
    from benchmarks.probe import PANELS, run, run_rivals, run_volume

    common = {"probes_path": probes_path, "keys": keys or (), "progress": note}
    files = {"probes": probes_path, "key": keys}
    beside: list[Row] = []
    if volume_only:
        if quick or not rivals or rivals_at is not None:
            raise WlmError("--volume-only: expected without --quick, --no-rivals and --rivals-at")
        rows = run_volume(device=device, **common)
        command = _command("probe", volume_only=True, device=device, **files)
    elif rivals_at is not None:
        if quick or not rivals or device != "cpu":
            raise WlmError("--rivals-at: expected without --quick, --no-rivals and --device: the rivals need no GPU")
        rows = run_rivals(**common)
        beside = _measured(rivals_at, rows)
        command = _command("probe", rivals_at=rivals_at, **files)
    else:
        rows = run(quick=quick, device=device, rivals=rivals, **common)
        command = _command("probe", quick=quick, no_rivals=not rivals, device=device, **files)
    _finish(rows, command, device, json_path, plot_path, PANELS, [*beside, *rows], baseline, partial=volume_only)


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
    plot_path: _PlotFile = None,
    baseline: _Baseline = None,
) -> None:
    """Lightmaps of meshes: PSNR, SSIM, size and decode time of the profiles, smaller lightmaps and block codecs."""
    device = _prepare(device, json_path, plot_path, baseline)
    from benchmarks.atlas import PANELS, plotted, run, run_rivals
    from benchmarks.atlas_inputs import load

    lightmaps = load(meshes_path, mesh_path, lightmap_paths or (), mask_path)
    files = {"meshes": meshes_path, "mesh": mesh_path, "lightmap": lightmap_paths, "mask": mask_path}
    beside: list[Row] = []
    if rivals_at is not None:
        if quick or not rivals or profiles or device != "cpu":
            raise WlmError("--rivals-at: expected without --quick, --profile, --no-rivals and --device")
        rows = run_rivals(rivals_at, lightmaps, progress=note)
        beside = _measured(rivals_at, rows)
        command = _command("atlas", rivals_at=rivals_at, **files)
    else:
        rows = run(lightmaps, profiles or (), quick=quick, device=device, rivals=rivals, progress=note)
        command = _command("atlas", quick=quick, no_rivals=not rivals, device=device, **files, profile=profiles)
    _finish(rows, command, device, json_path, plot_path, PANELS, [*plotted(beside), *plotted(rows)], baseline)


@app.command("atlas-scene")
def atlas_scene(
    set_path: Annotated[
        Path, typer.Option("--set", metavar="SET", help="A lightmap set with its mesh, which is cut into objects.")
    ],
    hours: Annotated[
        list[float] | None, typer.Option("--hour", help="A state; default all times of the set. Several times.")
    ] = None,
    side: Annotated[
        int | None, typer.Option(min=1, help="Texels that the lightmaps' longer side is made smaller to; a divisor.")
    ] = None,
    profiles: _Profiles = None,
    budget: Annotated[float | None, typer.Option(help="Instead of the profile's.")] = None,
    parts: Annotated[
        bool, typer.Option("--parts/--no-parts", help="With each object and state by itself, in as many bits.")
    ] = True,
    quick: Annotated[bool, typer.Option("--quick", help="Few small views, for a check on a CPU.")] = False,
    device: Device = "cpu",
    json_path: _RowsFile = None,
    baseline: _Baseline = None,
) -> None:
    """Lightmaps of whole scenes: PSNR of all objects and hours in one model, and of each by itself in as many bits."""
    device = _prepare(device, json_path, None, baseline)
    from benchmarks.atlas_scene import run
    from benchmarks.scene_inputs import load

    scene = load(set_path, hours or (), side)
    views = {"views": 8, "resolution": 128} if quick else {}
    options = {"budget": budget, "device": device, "parts": parts}
    rows = run(scene, profiles or (), **options, **views, progress=note)
    command = _command(
        "atlas-scene",
        set=set_path,
        hour=hours,
        side=side,
        profile=profiles,
        budget=budget,
        no_parts=not parts,
        quick=quick,
        device=device,
    )
    _finish(rows, command, device, json_path, None, baseline=baseline)


@app.command("atlas-ablation")
def atlas_ablation(
    profile: Annotated[
        str,
        typer.Option(metavar="NAME", help="A profile of the cascade, or a YAML file, that is changed."),
    ] = "paper",
    quick: Annotated[bool, typer.Option("--quick", help="Short fits, for minutes on a CPU; else for a GPU.")] = False,
    device: Device = "cpu",
    meshes_path: _Meshes = None,
    mesh_path: _Mesh = None,
    lightmap_paths: _Lightmaps = None,
    mask_path: _Mask = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Of each fit; default the profile's.")] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="ROW", help="A row by its name; default all. Several times.")
    ] = None,
    json_path: _RowsFile = None,
    baseline: _Baseline = None,
) -> None:
    """Lightmaps of meshes: the cascade without its parts, and at other sizes of its textures."""
    device = _prepare(device, json_path, None, baseline)
    from benchmarks.atlas_ablation import choose, run
    from benchmarks.atlas_inputs import load
    from wlm.atlas.model import Profile

    # Meshes take long to read, beside a slip in a name.
    choose(Profile.load(profile), only or ())
    lightmaps = load(meshes_path, mesh_path, lightmap_paths or (), mask_path)
    files = {"meshes": meshes_path, "mesh": mesh_path, "lightmap": lightmap_paths, "mask": mask_path}
    options = {"quick": quick, "profile": Path(profile).name, "device": device, **files, "steps": steps, "only": only}
    command = _command("atlas-ablation", **options)
    write = _writer(device, command, json_path, bool(only))
    rows = run(lightmaps, profile, only or (), quick=quick, device=device, steps=steps, progress=note, done=write)
    _finish(rows, command, device, json_path, None, baseline=baseline, partial=bool(only))


@app.command()
def smoke(
    quick: _SmallGrids = False,
    device: Device = "cpu",
    json_path: _RowsFile = None,
    plot_path: _PlotFile = None,
    baseline: _Baseline = None,
) -> None:
    """Smoke: the lattice beside a copy, advection, guiding maps, six-way lightmaps and a frame, with their errors."""
    device = _prepare(device, json_path, plot_path, baseline)
    from benchmarks.smoke import PANELS, plotted, run

    rows = run(quick=quick, device=device, progress=note)
    command = _command("smoke", quick=quick, device=device)
    _finish(rows, command, device, json_path, plot_path, PANELS, plotted(rows), baseline)


@app.command("smoke-orders")
def smoke_orders(
    quick: _SmallGrids = False,
    device: Device = "cpu",
    json_path: _RowsFile = None,
    baseline: _Baseline = None,
) -> None:
    """Smoke with light of all orders: PSNR, FLIP, flicker and time of shaded pictures, ours and the rivals'."""
    device = _prepare(device, json_path, None, baseline)
    from benchmarks.smoke_orders import run

    rows = run(quick=quick, device=device, progress=note)
    _finish(rows, _command("smoke-orders", quick=quick, device=device), device, json_path, None, baseline=baseline)


@app.command("smoke-network")
def smoke_network(
    quick: _SmallGrids = False,
    device: Device = "cpu",
    networks: Annotated[
        list[Path] | None,
        typer.Option(
            "--network",
            metavar="FILE",
            help="A trained network; default, without --profile, the one that comes with wlm. Several times.",
        ),
    ] = None,
    profiles: Annotated[
        list[str] | None,
        typer.Option(
            "--profile",
            metavar="NAME",
            help="A profile, or a YAML file, whose untrained network is timed. Several times.",
        ),
    ] = None,
    json_path: _RowsFile = None,
    plot_path: _PlotFile = None,
    baseline: _Baseline = None,
) -> None:
    """Neural six-way lightmaps: time and error beside marches, flip books and path tracing, by parts and by profile."""
    device = _prepare(device, json_path, plot_path, baseline)
    from benchmarks.smoke_network import PANELS, plotted, run
    from wlm.smoke.codec import shipped

    rows = run(networks or ([] if profiles else [shipped()]), profiles or (), quick=quick, device=device, progress=note)
    names = [Path(name).name for name in profiles or ()]
    command = _command("smoke-network", quick=quick, device=device, network=networks, profile=names)
    _finish(rows, command, device, json_path, plot_path, PANELS, plotted(rows), baseline)


@app.command("smoke-ablation")
def smoke_ablation(
    profile: Annotated[
        str, typer.Option(metavar="NAME", help="A profile, or a YAML file, of which one thing at a time is changed.")
    ] = "24",
    quick: Annotated[
        bool, typer.Option("--quick", help="Small images and few steps, for seconds on a CPU; else for a GPU.")
    ] = False,
    device: Device = "cpu",
    rounds: Annotated[int | None, typer.Option(min=1, help="Of each training, with samples of its own.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Of each round.")] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="ROW", help="A row by its name; default all. Several times.")
    ] = None,
    json_path: _RowsFile = None,
    baseline: _Baseline = None,
) -> None:
    """Neural six-way lightmaps: short trainings of a profile with one thing changed at a time, beside each other."""
    device = _prepare(device, json_path, None, baseline)
    from benchmarks.smoke_ablation import run

    lengths = {"rounds": rounds, "steps": steps}
    command = _command("smoke-ablation", quick=quick, profile=Path(profile).name, device=device, **lengths, only=only)
    write = _writer(device, command, json_path)
    rows = run(profile, only or (), quick=quick, device=device, **lengths, progress=note, done=write)
    _finish(rows, command, device, None, None, baseline=baseline)


@app.command()
def report(
    files: Annotated[list[Path], typer.Argument(metavar="FILE.json...", help="Files that `--json` wrote.")],
    output: Annotated[
        Path | None, output_option("INDEX.md", "The index; the pages go to a folder beside it. Default: print them.")
    ] = None,
) -> None:
    """Make Markdown pages of benchmark files: one for each system, and an index."""
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


def _prepare(device: str, json_path: Path | None, plot_path: Path | None, baseline: Path | None) -> str:
    """Checks, before long work, the device, where results go and what they are compared with; returns the device."""
    if baseline is not None:
        from benchmarks import read_runs

        read_runs(baseline)
        if json_path is not None and json_path.resolve() == baseline.resolve():
            raise WlmError(f"--baseline {baseline}: expected another file than --json, whose rows are replaced")
    if json_path is not None:
        check_output(json_path, ".json")
        if json_path.exists():
            from benchmarks import read_runs

            read_runs(json_path)  # the rows of other systems in it stay, so it has to be whole
    if plot_path is not None:
        check_output(plot_path, ".png", ".svg", ".pdf")
    quiet_warp()
    from wlm.interop import check_device

    return check_device(device)


def _command(name: str, **options: object) -> str:
    """Writes a command with its options in their order, as another machine would repeat it: files by their names."""
    words = ["python", "-m", "benchmarks", name]
    for option, value in options.items():
        for item in value if isinstance(value, list) else [value]:
            if item is not None and item is not False:
                words.append(f"--{option.replace('_', '-')}")
                if item is not True:
                    words.append(shlex.quote(item.name if isinstance(item, Path) else str(item)))
    return " ".join(words)


def _writer(
    device: str, command: str, json_path: Path | None, partial: bool = False
) -> "Callable[[Sequence[Row]], None]":
    """Writes the rows so far, which take minutes each: those that are done outlive a stop."""
    from benchmarks import describe_environment, write_json

    def write(rows: "Sequence[Row]") -> None:
        if json_path is not None:
            write_json(json_path, rows, describe_environment(device, command), partial=partial)

    return write


def _measured(results: Path, rows: "Sequence[Row]") -> "list[Row]":
    """Rows of the same system and scenes in a result file."""
    from benchmarks import read_json

    scenes = {(row.system, row.scene) for row in rows}
    return [row for row in read_json(results)[0] if (row.system, row.scene) in scenes]


def _finish(
    rows: "Sequence[Row]",
    command: str,
    device: str,
    json_path: Path | None,
    plot_path: Path | None,
    panels: "Sequence[Panel]" = (),
    plotted: "Sequence[Row] | None" = None,
    baseline: Path | None = None,
    partial: bool = False,
) -> None:
    """Writes the result file and the plot, of all rows unless told which, prints the tables, and compares."""
    from benchmarks import describe_environment, plot, tables, write_json

    if json_path is not None:
        write_json(json_path, rows, describe_environment(device, command), partial=partial)
    if plot_path is not None:
        plot(rows if plotted is None else plotted, plot_path, panels)
    show_text(tables(rows))
    if baseline is not None:
        _compare(rows, device, baseline)


def _compare(rows: "Sequence[Row]", device: str, baseline: Path) -> None:
    """Prints the figures that are worse than in an older file, and fails if there are any."""
    from benchmarks import FIGURES, compare, describe_environment, read_runs

    changes = compare(rows, read_runs(baseline), describe_environment(device, "")["device_name"])
    if not changes:
        raise WlmError(f"{baseline}: expected rows of the same method, option and scene, found none")
    worse = [change for change in changes if change.worse]
    for change in worse:
        row, figure = change.row, FIGURES[change.name]
        name = " ".join(filter(None, (row.scene, row.method, row.option)))
        note(f"worse: {name}: {figure.heading}: {figure.text(change.old)} before, {figure.text(change.new)} now")
    note(f"{len(changes)} figures compared with {baseline}: {len(worse)} are worse")
    if worse:
        raise typer.Exit(1)
