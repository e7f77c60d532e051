"""The command line `python -m benchmarks`: measures the systems, and reports, plots and compares the results.

Each command that measures calls the function `run` of the module that has its name. The options that `_COMMANDS` lists
for the command are the keyword arguments.
"""

import importlib
import inspect
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.app import Group
from wlm.cli.console import check_output, note, quiet_warp, show_text
from wlm.cli.options import Device, output_option
from wlm.errors import WlmError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from benchmarks import Row

app = typer.Typer(
    cls=Group,
    name="benchmarks",
    help="Commands that each measure one system beside rivals, or show results.",
    pretty_exceptions_enable=False,
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _option(kind: Any, flag: str, default: Any = None, **more: Any) -> tuple[Any, Any]:
    """Returns the annotation and the default from which typer makes an option; `more` has its help text."""
    return Annotated[kind, typer.Option(flag, **more)], default


_Path = Path | None
_Paths = list[Path] | None
_Names = list[str] | None
# The annotation and the default of each option, by the name of its argument.
_OPTIONS: dict[str, tuple[Any, Any]] = {
    "quick": _option(bool, "--quick", False, help="Measure fewer, smaller cases, which takes minutes on a CPU."),
    "device": (Device, "cpu"),
    "set_path": _option(_Path, "--set", help="Lightmap set to measure. Default: that of the demo.", metavar="SET"),
    "profiles": _option(
        _Names, "--profile", help="Name or YAML file of a profile to measure. Repeatable.", metavar="NAME"
    ),
    "profile": _option(str, "--profile", "paper", help="Name or YAML file of the profile to vary.", metavar="NAME"),
    "rivals": _option(bool, "--rivals/--no-rivals", True, help="Measure rival methods too, which takes minutes."),
    "rivals_only": _option(bool, "--rivals-only", False, help="Measure only the rival methods."),
    "rival_names": _option(
        _Names, "--rival", help="Name of a rival method; measure only these. Repeatable.", metavar="NAME"
    ),
    "probes_path": _option(_Path, "--probes", help="Light probe file. Default: that of the demo.", metavar="FILE"),
    "keys": _option(_Names, "--key", help="Name of an array in the file of --probes to measure. Repeatable."),
    "speed": _option(bool, "--speed", False, help="Measure only the speed of a fit, a decode and a volume."),
    "many": _option(int | None, "--many", help="Measure --speed on so many random probes.", metavar="N", min=1),
    "table": _option(bool, "--table", False, help="Measure only our methods and rivals at equal bytes."),
    "nearest": _option(
        list[int] | None,
        "--nearest",
        help="Measure the table of only N probes around the middle. Repeatable.",
        metavar="N",
    ),
    "lit_path": _option(
        _Path, "--mesh", help="Measure only fits to pictures of this mesh, which the probes light.", metavar="FILE.glb"
    ),
    "volume_only": _option(bool, "--volume-only", False, help="Measure only the cascaded probe volume."),
    "meshes_path": _option(
        _Path, "--meshes", help="Folder of a .glb, its .exr lightmaps and mask.png, or of such folders.", metavar="DIR"
    ),
    "mesh_path": _option(_Path, "--mesh", help="Mesh to measure, in place of --meshes.", metavar="FILE.glb"),
    "lightmap_paths": _option(_Paths, "--lightmap", help="Lightmap of the --mesh. Repeatable.", metavar="FILE.exr"),
    "mask_path": _option(
        _Path, "--mask", help="Image that is white at valid texels of --lightmap.", metavar="FILE.png"
    ),
    "scene_path": _option(Path, "--set", ..., help="Lightmap set that names its mesh.", metavar="SET"),
    "walked_path": _option(
        _Path, "--set", help="Lightmap set that names its mesh. Default: a large set of random maps.", metavar="SET"
    ),
    "hours": _option(list[float] | None, "--hour", help="Hour of the set to measure. Repeatable; default: all."),
    "side": _option(int | None, "--side", help="Texels of the set's longer side after downsampling.", min=1),
    "budget": _option(
        float | None, "--budget", help="Largest share of the input's bits, 0 to 1. Default: the profile's."
    ),
    "parts": _option(bool, "--parts/--no-parts", True, help="Compress each object at each hour alone, too."),
    "steps": _option(int | None, "--steps", help="Optimisation steps of each fit. Default: the profile's.", min=1),
    "only": _option(_Names, "--only", help="Name of a variant to measure. Repeatable; default: all.", metavar="ROW"),
    "smoke_path": _option(_Path, "--volume", help="Volume of smoke to measure too.", metavar="FILE"),
    "networks": _option(_Paths, "--network", help="File of a trained network to measure. Repeatable.", metavar="FILE"),
    "baseline_path": _option(
        _Path, "--baseline", help="Older result file; a kernel slower than there is an error.", metavar="OLD.json"
    ),
    "plot_path": _option(_Path, "--plot", help="Picture to write: time over size.", metavar="FILE.png"),
    "json_path": _option(_Path, "--json", help="Result file to write, with the machine.", metavar="FILE.json"),
}
_MESHES = ("meshes_path", "mesh_path", "lightmap_paths", "mask_path")
_PROBES = ("volume_only", "speed", "lit_path", "table")
# The help text and the options of each measuring command, in the order in which result files state them.
_COMMANDS: dict[str, tuple[str, tuple[str, ...]]] = {
    "lightmap": (
        "Measure lightmaps over time: PSNR, bits per texel and decode time of profiles and their rivals.",
        ("rivals_only", "rival_names", "quick", "profiles", "rivals", "device", "set_path"),
    ),
    "lightmap-file": (
        "Measure a lightmap file of 200 MB that is read tile by tile: times, bytes read and memory.",
        ("quick", "device"),
    ),
    "lightmap-run-time": (
        "Measure the virtual texture of lightmaps and its rivals: frames of a walk and a day through a set.",
        ("walked_path", "rival_names", "quick", "device"),
    ),
    "shader-speed": (
        "Measure the exported shaders of lightmaps on a GPU, beside our decoder.",
        ("quick", "device"),
    ),
    "scene": (
        "Measure the frames of the street as `wlm run` draws them, and the error of its pictures.",
        ("quick", "device"),
    ),
    "lightmap-ablation": (
        "Measure lightmaps over time: other feature maps of equal size, or no simulation of block compression.",
        ("quick", "device", "set_path", "steps", "only"),
    ),
    "probe": (
        "Measure light probes: PSNR, size and decode time of profiles, decoders and rivals.",
        (*_PROBES, "many", "only", "nearest", "quick", "device", "probes_path", "keys"),
    ),
    "atlas": (
        "Measure lightmaps of meshes: PSNR, SSIM, size and decode time of profiles and their rivals.",
        ("quick", "rivals", "device", *_MESHES, "profiles"),
    ),
    "atlas-scene": (
        "Measure scenes: PSNR of one model of all objects and hours, and of a model for each in as many bits.",
        ("scene_path", "hours", "side", "profiles", "budget", "parts", "quick", "device"),
    ),
    "atlas-ablation": (
        "Measure lightmaps of meshes: the texture cascade with steps left out, and with other texture sizes.",
        ("quick", "profile", "device", *_MESHES, "steps", "only"),
    ),
    "smoke": (
        "Measure smoke: speed of the solver against a memory copy, advection, six-way lightmaps and whole frames.",
        ("quick", "device"),
    ),
    "kernels": (
        "Measure kernels of frames and fits against what the device can do, at several sizes.",
        ("quick", "device", "only", "baseline_path", "plot_path"),
    ),
    "kernels-profile": (
        "Profile these kernels by Nsight Compute, which must be installed: what each of them waits for.",
        ("device", "only"),
    ),
    "growth": (
        "Simulate a city of lightmaps on 1, 8 and 64 GPUs from measured costs: hours, and what saturates first.",
        ("quick", "device"),
    ),
    "fluid-gradients": (
        "Measure gradients through air and smoke: the time of a step both ways, and memory.",
        ("quick", "device"),
    ),
    "smoke-orders": (
        "Measure multiple scattering in smoke: PSNR, FLIP, flicker and time of our method and its rivals.",
        ("quick", "device"),
    ),
    "smoke-network": (
        "Measure neural six-way lightmaps: time and error beside marches, flip books and path tracing.",
        ("quick", "device", "networks", "profiles"),
    ),
    "smoke-sizes": (
        "Measure six-way lightmaps on grids of 16 to 400 voxels: marches, the network and diffusion on one clock.",
        ("smoke_path", "quick", "device"),
    ),
    "ops": (
        "Measure differentiable operations: errors against float64, and times forward and backward beside torch.",
        ("device", "only"),
    ),
}
# Options with which a run replaces only the rows that it measures in a result file.
_PARTIAL = ("profiles", "rival_names", "only", *_PROBES)


def _add_command(name: str, summary: str, options: tuple[str, ...]) -> None:
    def command(**values: Any) -> None:
        _measure(name, values)

    parameters = []
    for option in (*options, "json_path"):
        annotation, default = _OPTIONS[option]
        default = inspect.Parameter.empty if default is ... else default
        kind = inspect.Parameter.KEYWORD_ONLY
        parameters.append(inspect.Parameter(option, kind, default=default, annotation=annotation))
    # typer reads both.
    command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    command.__doc__ = summary
    app.command(name)(command)


def _measure(name: str, values: dict[str, Any]) -> None:
    """Runs a measuring command: checks its arguments, measures, writes the result file and prints the results."""
    from benchmarks import describe_environment, read_runs, tables, write_json
    from wlm.interop import check_device

    json_path = values.pop("json_path")
    if json_path is not None:
        check_output(json_path, ".json")
        if json_path.exists():
            read_runs(json_path)  # rows of other systems stay in the file, so it must be readable
    quiet_warp()
    values["device"] = device = check_device(values["device"])
    words = shlex.join(["python", "-m", "benchmarks", name, *_words(values)])

    def write(rows: "Sequence[Row]") -> None:
        if json_path is not None:
            partial = any(values.get(option) for option in _PARTIAL)
            write_json(json_path, rows, describe_environment(device, words), partial=partial)

    run = importlib.import_module(f"benchmarks.{name.replace('-', '_')}").run
    # Long runs are written row by row, so that an interrupted one keeps its rows.
    extra = {"done": write} if "done" in inspect.signature(run).parameters else {}
    rows = run(**values, progress=note, **extra)
    write(rows)
    show_text(tables(rows))


def _words(values: Mapping[str, Any]) -> list[str]:
    """Returns the command line words that set the given options, without unset ones and flags at their default."""
    words = []
    for option, value in values.items():
        # typer keeps the first argument of `typer.Option`, which is the flag in an `Annotated`, as `default`.
        flag = "--device" if option == "device" else _OPTIONS[option][0].__metadata__[0].default
        if "/" in flag:
            words += [] if value else [flag.partition("/")[2]]
        elif value is True:
            words.append(flag)
        else:
            for item in value if isinstance(value, list) else [value] if value not in (None, False) else []:
                words += [flag, Path(str(item)).name]
    return words


for _name, (_summary, _options) in _COMMANDS.items():
    _add_command(_name, _summary, _options)


_Results = Annotated[list[Path], typer.Argument(metavar="FILE.json...", help="Result files that --json wrote.")]


@app.command()
def report(
    files: _Results,
    output: Annotated[
        Path | None, output_option("INDEX.md", "Index to write; the pages go to a folder beside it. Default: print.")
    ] = None,
) -> None:
    """Convert result files to Markdown: all rows, printed; or, with an output, an index and a page for each system.

    For the index of the documents, `docs/results.md`, the plots of the documents are drawn too.
    """
    from benchmarks import pages, read_runs, tables

    if output is None:
        for path in files:
            for run in read_runs(path):
                show_text(f"## `{path.name}`: `{run.environment['command']}`\n\n{tables(run.rows)}")
        return
    check_output(output, ".md")
    from benchmarks.plots import IMAGES, draw_all
    from wlm.formats.atomic import atomic_write

    if output.resolve().parent == IMAGES.parent:
        draw_all()
    for name, page in pages(files, output).items():
        path = output.parent / name
        path.parent.mkdir(exist_ok=True)
        atomic_write(path, page.encode())


@app.command()
def plot(
    files: _Results,
    system: Annotated[
        str, typer.Option(metavar="NAME", help="System to draw: lightmap, atlas, probe, smoke or smoke-network.")
    ],
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
def plots() -> None:
    """Draw the plots of the documents from the committed result files, into `docs/images`."""
    from benchmarks.plots import draw_all

    show_text("\n".join(draw_all()))


@app.command()
def compare(
    new: Annotated[Path, typer.Argument(metavar="NEW.json", help="Result file of the changed code.")],
    old: Annotated[Path, typer.Argument(metavar="OLD.json", help="Result file from before the change.")],
) -> None:
    """Compare two result files; fail if NEW is over 0.05 dB worse, or over 5% slower on the same machine."""
    from benchmarks import FIGURES, read_runs
    from benchmarks import compare as changes_between

    changes = [change for run in read_runs(new) for change in changes_between(run, read_runs(old))]
    if not changes:
        raise WlmError(f"{old}: no row has the method, option and scene of a row of {new}")
    worse = [change for change in changes if change.worse]
    for change in worse:
        row, figure = change.row, FIGURES[change.name]
        name = " ".join(filter(None, (row.scene, row.method, row.option)))
        note(f"worse: {name}: {figure.heading}: {figure.text(change.old)} before, {figure.text(change.new)} now")
    note(f"{len(changes)} measured values compared with {old}: {len(worse)} are worse")
    if worse:
        raise typer.Exit(1)
