"""The commands for light probes: compress, evaluate, decode, export, info."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from rich.markup import escape

from wlm.cli import console, models
from wlm.cli import options as opt
from wlm.cli.settings import with_settings

if TYPE_CHECKING:
    from wlm.probe import ProbeModel, ProbeSet, Report

_Probes = Annotated[
    Path, typer.Argument(metavar="PROBES", help="Probe file: .npz, .json, .csv, .lmbake, .asset or .ktx2.")
]
_CONVENTIONS = "threejs, godot, unreal or unity"
_Convention = Annotated[
    str | None, typer.Option(help=f"SH convention of PROBES: {_CONVENTIONS}; default the file's own.")
]
_Axes = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z",
        help="Change the axes of positions and light: the old axes that become x, y, z, such as x,z,-y from z up to y "
        "up, or, with an equals sign, --axes=-x,y,z to mirror x for a left-handed engine.",
    ),
]
_Order = Annotated[
    Literal["coefficient", "channel"] | None,
    typer.Option(
        help="Order of the SH numbers in PROBES: by coefficient (r0 g0 b0 r1 ...) or by channel (r0 r1 ... g0 ...); "
        "default as their shape shows, or as fits light."
    ),
]
_Keys = Annotated[
    list[str] | None,
    typer.Option(
        "--key", help="Name of the array of light in PROBES, if there are several; repeat it for hours; default all."
    ),
]
_At = Annotated[
    Path | None,
    typer.Option(metavar="PROBES", help="File with the positions of the probes, for a FILE.wlm that stores none."),
]


@with_settings("wlm.probe:Profile")
@opt.with_options
@console.exclusive
def compress(
    probes: _Probes,
    output: Annotated[Path, opt.output_option("OUT.wlm", "The file to write.")],
    settings: dict[str, Any],
    work: opt.FitOptions,
    profile: opt.Profile = "standard",
    positions: Annotated[
        bool, typer.Option("--positions", help="Also store the positions of the probes, 16 bits per axis.")
    ] = False,
    mesh: opt.SceneFile = None,
    key: _Keys = None,
    convention: _Convention = None,
    order: _Order = None,
    axes: _Axes = None,
) -> None:
    """Compress light probes into one file: Gaussians and a small network, or principal components for small sets.

    With --method gaussians, --mesh also minimises the error of pictures of the mesh and of balls at the probes.
    The fit is saved in OUT.wlm.partial from time to time and on Ctrl-C or SIGTERM; repeat the command with --resume to
    continue exactly.
    """

    def load() -> "ProbeSet":
        from wlm.probe import load

        return load(probes, key=key or None, convention=convention, order=order, axes=axes)

    from wlm.formats.geometry import read_geometry
    from wlm.probe.hours import listed_times

    inputs = {} if mesh is None else {"geometry": read_geometry(mesh, with_uv=False)}
    data, model, facts = models.fit("probe", load, output, profile, settings, work, inputs, positions=positions)
    size = facts["bytes on disk"]
    facts |= {
        "share of the probes as float32": f"{size / data.float_bytes:.2%}",
        "bits per probe on disk": f"{size * 8 / data.probes:.2f}",
        "method": model.method,
        **({"hours": listed_times(model.times)} if len(model.times) else {}),
        **model.content.facts(),
    }
    console.show_facts(model.name, facts)
    console.note(f"{probes}: {data.reading}")
    if model.choice:
        console.note(model.choice)
    console.note_warnings(model.warnings)


def evaluate(
    file: opt.ModelFile,
    probes_path: _Probes,
    json_path: opt.ReportFile = None,
    volume: Annotated[
        bool, typer.Option("--volume", help="Also score light read from the cascaded volume along a path.")
    ] = False,
    views: Annotated[
        int, typer.Option(help="Number of pictures to render and score, of balls at probes and of --mesh; 0: none.")
    ] = 0,
    mesh: opt.SceneFile = None,
    time: opt.Time = None,
    key: _Keys = None,
    convention: _Convention = None,
    order: _Order = None,
    axes: _Axes = None,
    device: opt.Device = "cpu",
) -> None:
    """Compare compressed probes with the original: PSNR of the coefficients and of the irradiance, and sizes.

    --volume and --views compare the light at one hour, --time.
    """
    console.begin(json_path, ".json", inputs=[probes_path])
    from wlm.cli.probe_volume import score_pictures, score_walks, show_pictures, show_walks
    from wlm.probe import evaluate, load
    from wlm.system import load as load_model

    model = load_model(file, "probe")
    probes = load(probes_path, key=key or None, convention=convention, order=order, axes=axes)
    console.note_warnings(probes.warnings)
    drawn = views or mesh is not None
    one = (model.at(time), probes.at(time)) if drawn or volume else (model, probes)
    with console.running("evaluate") as progress:
        size = file.stat().st_size
        report = evaluate(model, probes, device=device, progress=progress, file_bytes=size)
    if not probes.source.startswith(model.source):
        console.note(
            f"warning: {probes_path}: not the input that {file} was made from; check the file, --key and --convention"
        )
    pictures = score_pictures(*one, views, mesh, device) if drawn else []
    walks = score_walks(*one, device) if volume else {}
    if json_path is not None:
        content = report.to_json() | ({"volume": walks} if walks else {})
        content |= {"views": [score.to_json() for score in pictures]} if pictures else {}
        console.write_json(json_path, content)
    _show_report(file, model, report)
    console.note(f"{probes_path}: {probes.reading}")
    show_walks(walks)
    show_pictures(pictures)


def decode(
    file: opt.ModelFile,
    output: Annotated[Path, opt.output_option("OUT", "The .npz or .json file to write.")],
    positions: Annotated[
        Path | None,
        typer.Option(metavar="PROBES", help="File with the positions to decode at; default those stored in FILE.wlm."),
    ] = None,
    time: opt.Time = None,
    convention: Annotated[str, typer.Option(help=f"SH convention of the output: {_CONVENTIONS}.")] = "threejs",
    original: _At = None,
    device: opt.Device = "cpu",
) -> None:
    """Decode the light at the stored positions, or at the positions in another file.

    Given positions of the same number and bounding box as the compressed probes are taken for these probes, in order.
    Then probes without light (dead probes, such as those in walls) decode to zero.
    """
    console.begin(output, ".npz", ".json", inputs=[positions, original])
    from wlm.probe import load_positions, save_probes
    from wlm.probe.places import positions_of
    from wlm.system import load

    model = load(file, "probe").at(time)
    position = model.stored_positions() if positions is None else load_positions(positions)
    own = positions is None or model.has_probes_at(position)
    given = position if own and positions is not None else positions_of(model, original)
    decoder = model.decoder(device, position=given)
    values = decoder.decode_probes() if own else decoder.decode(position)
    save_probes(output, position, values, convention=convention)
    facts = {"file": output, "positions": len(position), "positions are": "the probes" if own else "other points"}
    zero = int((~model.live).sum()) if own else 0
    facts |= {"dead probes": zero, "mean": float(values.mean()), "largest": float(values.max())}
    console.show_facts(str(file), facts)


def export(
    file: opt.ModelFile,
    output: Annotated[Path, opt.output_option("DIR", "The folder to write to.")],
    engine: opt.Engine = None,
    shader: opt.ShaderLanguage = None,
    exact: opt.ExactShader = False,
    original: Annotated[
        Path | None,
        typer.Option(
            metavar="PROBES",
            help="File with the positions of the probes, if FILE.wlm stores none; for Godot the .lmbake to copy with "
            "the new light.",
        ),
    ] = None,
    cells: Annotated[
        int | None,
        typer.Option(help="With --engine three, godot, unreal or bevy: grid cells along the longest side; default 24."),
    ] = None,
    axes: _Axes = None,
    time: opt.Time = None,
    device: opt.Device = "cpu",
) -> None:
    """Write light probes for an engine: buffers and a shader, or with --engine a grid or probes that it can load."""
    options = {"original": original, "cells": cells, "axes": axes}
    models.export(file, output, engine, shader, exact, device, time, **options)


def info(file: opt.ModelFile, as_json: opt.AsJson = False, device: opt.Device = "cpu") -> None:
    """Show what a file of light probes contains, and its memory on a device, with that of a volume of its probes."""

    def volume_bytes(model: "ProbeModel") -> dict[str, int]:
        import numpy as np

        from wlm.probe.volume.cascade import Volume
        from wlm.probe.volume.light import StoredLight

        light = StoredLight(np.zeros((model.probes, model.outputs)), device)
        return Volume(model.stored_positions(), light, live=model.live).memory

    def facts(model: "ProbeModel") -> dict[str, Any]:
        return {
            "method": model.method,
            "probes": model.probes,
            "dead_probes": int((~model.live).sum()),
            "numbers_per_probe": model.outputs,
            **({"hours": model.times.tolist()} if len(model.times) else {}),
            "bits_per_probe": file.stat().st_size * 8 / model.probes,
            "positions_stored": model.has_positions,
            "GPU_bytes": model.content.nbytes,
            **({"volume_bytes": volume_bytes(model)} if model.has_positions else {}),
            **model.content.facts(),
        }

    models.describe(file, "probe", device, as_json, facts)


def _show_report(file: Path, model: "ProbeModel", report: "Report") -> None:
    columns = ["PSNR, dB", "lit probes, dB", "irradiance, dB", "bytes on disk", "of float32 size", "bits per probe"]
    rows = console.table(str(file), ["", *columns])
    psnr = (console.number(value, ".2f") for value in (report.psnr, report.psnr_live, report.irradiance_psnr))
    sizes = (f"{report.bytes:,}", f"{report.ratio:.2%}", f"{report.bits_per_probe:.2f}")
    worst = ", the worst hour" if report.hours else ""
    rows.add_row(f"wlm {escape(model.profile.name)}{worst}", *psnr, *sizes)
    if report.psnr_by_band is not None:
        rows.add_section()
        for band, value in enumerate(report.psnr_by_band):
            rows.add_row(f"spherical harmonics, band {band}", console.number(value, ".2f"))
    for hour in report.hours:
        figures = (console.number(hour[name], ".2f") for name in ("psnr", "psnr_live", "irradiance_psnr"))
        rows.add_row(f"at {hour['time']:g} h", *figures)
    rows.add_section()
    if report.between_psnr is not None:
        rows.add_row("half-way between probes", console.number(report.between_psnr, ".2f"))
    console.show(rows)
    if report.worst_probe is not None:
        worst = report.worst_probe
        place = ", ".join(f"{x:.4g}" for x in worst["position"])
        console.note(
            f"relative error: {report.relative_median:.1%} in the median, {report.relative_p95:.1%} at 95% of the live "
            f"probes; {report.off:.2%} are off by more than half; {worst['error']:.1%} at the worst, probe "
            f"{worst['probe']} at ({place})"
        )
    console.note_warnings(report.warnings)
