"""`wlm bench`: speed against error, ours and the baselines."""

import shlex
import sys
from pathlib import Path
from typing import Annotated

import typer

from wlm.cli.console import check_output, note, quiet_warp
from wlm.errors import WlmError

__all__ = ["app"]

app = typer.Typer(help="Speed against error, ours and the baselines.")


@app.command()
def lightmap(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer steps and rows, for a check in minutes.")] = False,
    device: Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')] = "cpu",
    set_path: Annotated[
        Path | None, typer.Option("--set", metavar="SET", help="A lightmap set; default the demo's.")
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
    ] = None,
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw PSNR against time and size.")
    ] = None,
) -> None:
    """Lightmaps over time: PSNR, bits a texel and decode time of the profiles and of block codecs."""
    _check_outputs(json_path, plot_path)
    quiet_warp()
    from wlm.bench.lightmap import run
    from wlm.interop import check_device

    device = check_device(device)
    rows = run(quick=quick, device=device, set_path=set_path, progress=note)
    command = f"wlm bench lightmap{' --quick' if quick else ''} --device {device}"
    if set_path is not None:
        command += f" --set {rows[0].scene}"
    _finish(rows, device, command, json_path, plot_path, ("decode_ms", "bpp"))


@app.command()
def probe(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer steps and rows, for a check in minutes.")] = False,
    device: Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')] = "cpu",
    probes_path: Annotated[
        Path | None, typer.Option("--probes", metavar="FILE", help="Light probes; default the demo's.")
    ] = None,
    keys: Annotated[
        list[str] | None, typer.Option("--key", help="Which of the file's arrays; may be given several times.")
    ] = None,
    rivals: Annotated[
        bool, typer.Option("--rivals/--no-rivals", help="With the PCA family, which takes minutes on the CPU.")
    ] = True,
    rivals_at: Annotated[
        Path | None,
        typer.Option(
            "--rivals-at",
            metavar="FILE.json",
            help="The PCA family alone, at the bytes that our files have in this result file.",
        ),
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
    ] = None,
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw PSNR against size, error against time.")
    ] = None,
) -> None:
    """Light probes: PSNR, size and decode time of the profiles, of their decodes and of the PCA family."""
    _check_outputs(json_path, plot_path)
    quiet_warp()
    from wlm.bench import read_json
    from wlm.bench.probe import PANELS, run, run_rivals
    from wlm.interop import check_device

    device = check_device(device)
    beside: list = []  # what the plot shows besides the rows
    common = {"probes_path": probes_path, "keys": keys or (), "progress": note}
    if rivals_at is not None:
        if quick or not rivals or device != "cpu":
            raise WlmError("--rivals-at: expected without --quick, --no-rivals and --device: the rivals need no GPU")
        rows = run_rivals(rivals_at, **common)
        scenes = {row.scene for row in rows}
        beside = [row for row in read_json(rivals_at)[0] if row.system == "probe" and row.scene in scenes]
        command = f"wlm bench probe --rivals-at {rivals_at.name}"
    else:
        rows = run(quick=quick, device=device, rivals=rivals, **common)
        command = f"wlm bench probe{' --quick' if quick else ''}{'' if rivals else ' --no-rivals'} --device {device}"
    if probes_path is not None:
        command += f" --probes {probes_path.name}"
    command += "".join(f" --key {key}" for key in keys or ())
    _finish(rows, device, command, json_path, plot_path, PANELS, beside)


@app.command()
def atlas(
    quick: Annotated[bool, typer.Option("--quick", help="Fewer steps and rows, for a check in minutes.")] = False,
    device: Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')] = "cpu",
    meshes_path: Annotated[
        Path | None,
        typer.Option(
            "--meshes",
            metavar="DIR",
            help="A folder of folders, each with a .glb, its lightmaps .exr and maybe mask.png; default the demo's.",
        ),
    ] = None,
    mesh_path: Annotated[
        Path | None, typer.Option("--mesh", metavar="FILE", help="Instead, one mesh: .glb, .gltf or .obj.")
    ] = None,
    lightmap_paths: Annotated[
        list[Path] | None,
        typer.Option("--lightmap", metavar="FILE.exr", help="A lightmap of it; may be given several times."),
    ] = None,
    mask_path: Annotated[Path | None, typer.Option("--mask", metavar="FILE.png", help="Their mask.")] = None,
    profiles: Annotated[
        list[str] | None, typer.Option("--profile", metavar="NAME", help="Profiles; default all. Several times.")
    ] = None,
    rivals: Annotated[
        bool, typer.Option("--rivals/--no-rivals", help="With the block codecs, which take minutes on the CPU.")
    ] = True,
    rivals_at: Annotated[
        Path | None,
        typer.Option(
            "--rivals-at", metavar="FILE.json", help="The rivals alone, at the bits that ours have in this result file."
        ),
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
    ] = None,
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw PSNR against size, error against time.")
    ] = None,
) -> None:
    """Lightmaps of meshes: PSNR, SSIM, size and decode time of the profiles, smaller lightmaps and block codecs."""
    _check_outputs(json_path, plot_path)
    quiet_warp()
    from wlm.bench import read_json
    from wlm.bench.atlas import PANELS, plotted, run, run_rivals
    from wlm.bench.atlas_inputs import load
    from wlm.interop import check_device

    device = check_device(device)
    lightmaps = load(meshes_path, mesh_path, lightmap_paths or (), mask_path)
    beside: list = []  # what the plot shows besides the rows
    if rivals_at is not None:
        if quick or not rivals or profiles or device != "cpu":
            raise WlmError("--rivals-at: expected without --quick, --profile, --no-rivals and --device")
        rows = run_rivals(rivals_at, lightmaps, progress=note)
        scenes = {row.scene for row in rows}
        beside = plotted([row for row in read_json(rivals_at)[0] if row.system == "atlas" and row.scene in scenes])
        command = f"wlm bench atlas --rivals-at {rivals_at.name}"
    else:
        rows = run(lightmaps, profiles or (), quick=quick, device=device, rivals=rivals, progress=note)
        command = f"wlm bench atlas{' --quick' if quick else ''}{'' if rivals else ' --no-rivals'} --device {device}"
    for option, path in (("meshes", meshes_path), ("mesh", mesh_path)):
        command += "" if path is None else f" --{option} {path.name}"
    command += "".join(f" --lightmap {path.name}" for path in lightmap_paths or ())
    command += "" if mask_path is None else f" --mask {mask_path.name}"
    command += "".join(f" --profile {name}" for name in profiles or ())
    _finish(rows, device, command, json_path, plot_path, PANELS, beside, plotted(rows))


@app.command()
def smoke(
    quick: Annotated[
        bool, typer.Option("--quick", help="Small grids, for a minute on a CPU; else the paper's, for a GPU.")
    ] = False,
    device: Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')] = "cpu",
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
    ] = None,
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw the error of marches against their time.")
    ] = None,
) -> None:
    """Smoke: the lattice beside a copy, advection, guiding maps, six-way lightmaps and a frame, with their errors."""
    _check_outputs(json_path, plot_path)
    quiet_warp()
    from wlm.bench.smoke import PANELS, plotted, run
    from wlm.interop import check_device

    device = check_device(device)
    rows = run(quick=quick, device=device, progress=note)
    command = f"wlm bench smoke{' --quick' if quick else ''} --device {device}"
    _finish(rows, device, command, json_path, plot_path, PANELS, shown=plotted(rows))


@app.command("smoke-network")
def smoke_network(
    quick: Annotated[
        bool, typer.Option("--quick", help="Small grids, for a minute on a CPU; else the paper's, for a GPU.")
    ] = False,
    device: Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')] = "cpu",
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
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
    ] = None,
    plot_path: Annotated[
        Path | None, typer.Option("--plot", metavar="FILE.png", help="Draw PSNR against time.")
    ] = None,
) -> None:
    """Neural six-way lightmaps: time and error beside marches, flip books and path tracing, by parts and by profile."""
    _check_outputs(json_path, plot_path)
    quiet_warp()
    from wlm.bench.smoke_network import PANELS, plotted, run
    from wlm.interop import check_device
    from wlm.smoke.codec import shipped

    device = check_device(device)
    measured = networks or ([] if profiles else [shipped()])
    rows = run(measured, profiles or (), quick=quick, device=device, progress=note)
    command = f"wlm bench smoke-network{' --quick' if quick else ''} --device {device}"
    command += "".join(f" --network {path.name}" for path in networks or ())
    command += "".join(f" --profile {Path(name).name}" for name in profiles or ())
    _finish(rows, device, command, json_path, plot_path, PANELS, shown=plotted(rows))


@app.command("smoke-ablation")
def smoke_ablation(
    profile: Annotated[
        str, typer.Option(metavar="NAME", help="A profile, or a YAML file, of which one thing at a time is changed.")
    ] = "24",
    quick: Annotated[
        bool, typer.Option("--quick", help="Small images and few steps, for seconds on a CPU; else for a GPU.")
    ] = False,
    device: Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')] = "cpu",
    rounds: Annotated[int | None, typer.Option(min=1, help="Of each training, with samples of its own.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Of each round.")] = None,
    only: Annotated[
        list[str] | None, typer.Option("--only", metavar="ROW", help="A row by its name; default all. Several times.")
    ] = None,
    json_path: Annotated[
        Path | None, typer.Option("--json", metavar="FILE.json", help="Write the rows and the environment.")
    ] = None,
) -> None:
    """Neural six-way lightmaps: short trainings of a profile with one thing changed at a time, beside each other."""
    _check_outputs(json_path, None)
    quiet_warp()
    from wlm.bench import describe_environment, write_json
    from wlm.bench.smoke_ablation import run
    from wlm.interop import check_device

    device = check_device(device)
    command = f"wlm bench smoke-ablation{' --quick' if quick else ''} --profile {Path(profile).name} --device {device}"
    command += "".join(f" --{name} {value}" for name, value in (("rounds", rounds), ("steps", steps)) if value)
    command += "".join(f" --only {shlex.quote(name)}" for name in only or ())

    def keep(rows: list) -> None:
        # What took minutes outlives a stop.
        if json_path is not None:
            write_json(json_path, rows, describe_environment(device, command))

    options = {"quick": quick, "device": device, "rounds": rounds, "steps": steps}
    rows = run(profile, only or (), **options, progress=note, done=keep)
    _finish(rows, device, command, None, None, ())


@app.command()
def report(
    files: Annotated[list[Path], typer.Argument(metavar="FILE.json...", help="What `wlm bench ... --json` wrote.")],
    output: Annotated[Path | None, typer.Option("--output", "-o", metavar="PAGE.md", help="Default: print it.")] = None,
) -> None:
    """Make a Markdown page of benchmark files."""
    from wlm.bench.report import report as make

    page = make(files)
    if output is None:
        sys.stdout.write(page)
        return
    check_output(output, ".md")
    from wlm.formats.atomic import atomic_write

    atomic_write(output, page.encode())


def _check_outputs(json_path: Path | None, plot_path: Path | None) -> None:
    """Checks, before long work, that its results can be written."""
    if json_path is not None:
        check_output(json_path, ".json")
        if json_path.exists():
            from wlm.bench import read_runs

            read_runs(json_path)  # what other systems left there is kept, so it has to be whole
    if plot_path is not None:
        check_output(plot_path, ".png", ".svg", ".pdf")


def _finish(
    rows: list,
    device: str,
    command: str,
    json_path: Path | None,
    plot_path: Path | None,
    panels,
    beside=(),
    shown: list | None = None,
) -> None:
    """Writes what was asked for, and prints the tables.

    A plot has the rows that are ``shown``, all unless told, and those ``beside`` them.
    """
    from wlm.bench import describe_environment, plot, write_json
    from wlm.bench.report import tables

    if json_path is not None:
        write_json(json_path, rows, describe_environment(device, command))
    if plot_path is not None:
        plot([*beside, *(rows if shown is None else shown)], plot_path, panels)
    sys.stdout.write(tables(rows))
