"""The commands for lightmaps over time: compress, evaluate, decode, export, info."""

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.markup import escape

from wlm.cli import console, models
from wlm.cli import options as opt
from wlm.cli.settings import with_settings
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.lightmap import LightmapModel, LightmapSet, Report
    from wlm.lightmap.evaluation import SheetReport
    from wlm.lightmap.model import SheetModel
    from wlm.metrics import Summary

_Set = Annotated[
    Path,
    typer.Argument(
        metavar="SET",
        help="A set.json, a folder of lightmaps (.exr, .hdr, .pfm, .tif, .ktx2, .dds), or folders of Unity bakes.",
    ),
]
# Columns of the scores of a sheet: heading, attribute, format, factor.
_SCORES = (("PSNR, dB", "psnr", ".2f", 1.0), ("SSIM", "ssim", ".4f", 1.0), ("FLIP", "flip", ".4f", 1.0))
_SHOWN = (
    ("filtered reads, dB", "seen", ".2f", 1.0),
    ("texels beside charts, dB", "ring", ".2f", 1.0),
    ("between stored times, dB", "between", ".2f", 1.0),
    ("error at tile borders relative to inside", "border", ".2f", 1.0),
    ("flicker, % of the range", "flicker", ".3f", 100.0),
    ("views, dB", "view_psnr", ".2f", 1.0),
    ("views, FLIP", "view_flip", ".4f", 1.0),
)


@dataclass(frozen=True)
class SetOptions:
    """Options that state how lightmaps over time are read."""

    times: Annotated[
        str | None,
        typer.Option(
            help="Times of the lightmaps in the order of set.json or of their names, such as 0,6.5,12 or 0:24:1 for "
            "0,1,...,23; default as set.json or the names state."
        ),
    ] = None
    mask: Annotated[
        str | None,
        typer.Option(
            help='Texels that belong to charts: a PNG (above 0), "alpha" (of the lightmaps, above 0) or "all"; default '
            "as set.json states."
        ),
    ] = None
    period: Annotated[
        float | None,
        typer.Option(
            help="Length of the day, in the unit of the times; default that of set.json, or 24 for hours in names."
        ),
    ] = None
    layers: Annotated[
        str | None, typer.Option(metavar="NAMES", help="Layers of the set to read, separated by commas; default all.")
    ] = None
    encoding: opt.Encoding = None
    groups: Annotated[
        list[str] | None,
        typer.Option(
            "--group",
            metavar="NAME=PATH",
            help="A light group, which is added when the file is decoded: a set, or one lightmap for all times, such "
            "as that of a lamp. May be repeated; SET is the group base unless it names groups.",
        ),
    ] = None
    trust: opt.Trust = False

    def load(self, path: Path) -> "LightmapSet":
        """Reads lightmaps."""
        from wlm.lightmap import load
        from wlm.lightmap.data import parse_times

        options = vars(self) | {"groups": _by_group("--group", self.groups, "PATH")}
        if self.times is not None:
            options["times"] = parse_times(self.times)
        if self.layers is not None:
            options["layers"] = [name.strip() for name in self.layers.split(",")]
        return load(path, **options)


@with_settings("wlm.lightmap:Profile")
@console.exclusive
@opt.with_options
def compress(
    set_path: _Set,
    output: Annotated[Path, opt.output_option("OUT.wlm", "The file to write.")],
    settings: dict[str, Any],
    options: SetOptions,
    work: opt.FitOptions,
    profile: opt.Profile = "M",
) -> None:
    """Compress lightmaps over time into one file.

    The fit is saved in OUT.wlm.partial from time to time and on Ctrl-C or SIGTERM; repeat the command with --resume to
    continue exactly. Lightmaps of more than 1 GiB are kept in a temporary file (TMPDIR) during the fit.
    """
    _, model, facts = models.fit("lightmap", lambda: options.load(set_path), output, profile, settings, work)
    console.show_facts(model.name, facts | _facts(model))
    _show_sheets(model)
    console.note_warnings(model.warnings)


@opt.with_options
def evaluate(
    file: opt.ModelFile,
    set_path: _Set,
    options: SetOptions,
    json_path: opt.ReportFile = None,
    views: Annotated[int, typer.Option(min=0, help="Number of rendered views to score, if the set names a mesh.")] = 50,
    all_lights: Annotated[
        Path | None,
        typer.Option(metavar="SET", help="A bake of all lights together, to compare the sum of the light groups with."),
    ] = None,
    device: opt.Device = "cpu",
) -> None:
    """Compare compressed lightmaps with the originals: PSNR, SSIM and FLIP by tile and time, and bits per texel.

    The error is also measured as a renderer shows the light: filtered, beside charts, between stored times, across
    tiles, over time, and in views of the set's mesh.
    """
    console.begin(json_path, ".json", inputs=[set_path, set_path / "set.json"])
    from wlm.interop import check_device
    from wlm.lightmap import evaluate
    from wlm.system import load

    device = check_device(device)
    model = load(file, "lightmap")
    lightmaps = options.load(set_path)
    together = None if all_lights is None else replace(options, times=None, groups=None).load(all_lights)
    console.note_warnings((*lightmaps.warnings, *(together.warnings if together is not None else ())))
    with console.running("score") as progress:
        size = file.stat().st_size
        given: dict[str, Any] = {"file_bytes": size, "all_lights": together}
        report = evaluate(model, lightmaps, views=views, device=device, progress=progress, **given)
    if json_path is not None:
        console.write_json(json_path, report.to_json())
    _show_report(file, report)


def decode(
    file: opt.ModelFile,
    time: Annotated[float, typer.Option(help="Time to decode, in the unit of the set; may be between stored times.")],
    output: Annotated[Path, opt.output_option("FRAME.exr", "The EXR to write.")],
    layer: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the layer; default the first layer of radiance.")
    ] = None,
    atlas: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of the atlas; default the first that has the layer.")
    ] = None,
    weights: opt.Weights = None,
    colours: opt.Colours = None,
    device: opt.Device = "cpu",
) -> None:
    """Decode a whole lightmap at one time: the sum of its light groups."""
    console.begin(output, ".exr")
    import numpy as np

    from wlm.formats.exr import write_planes
    from wlm.system import load

    model = load(file, "lightmap")
    sheets = model.layer(layer, atlas)
    decoder = model.decoder(device)
    decoder.set_weights(group_weights(weights, colours))
    frame = decoder.frame(time, layer, atlas)
    names = [name for sheet in sheets if sheet.group == sheets[0].group for name in sheet.channels]
    write_planes(output, dict(zip(names, np.moveaxis(frame, 2, 0), strict=True)))
    facts = {"file": output, "time": time, "layer": sheets[0].layer, "atlas": sheets[0].atlas, "channels": names}
    facts |= {"size": f"{frame.shape[1]}x{frame.shape[0]}", "mean": float(frame.mean()), "largest": float(frame.max())}
    console.show_facts(str(file), facts)


export = models.export_lightmaps


def info(file: opt.ModelFile, as_json: opt.AsJson = False, device: opt.Device = "cpu") -> None:
    """Show what a file of lightmaps contains, and its memory on a device."""

    def facts(model: "LightmapModel") -> dict[str, Any]:
        if not as_json:
            return _facts(model)
        sheets = [vars(sheet) | _sheet(own) for sheet, own in model.sheets.items()]
        groups = [
            {"name": name, "times": times.tolist(), "GPU_bytes": size}
            for name, (times, size) in model.group_sizes().items()
        ]
        return _facts(model) | {"times": model.times.tolist(), "groups": groups, "sheets": sheets}

    model = models.describe(file, "lightmap", device, as_json, facts)
    if not as_json:
        _show_sheets(model)


def _by_group(option: str, given: list[str] | None, value: str) -> dict[str, str]:
    """Splits the values NAME=VALUE of a repeated option at their first equals sign."""
    result: dict[str, str] = {}
    for text in given or ():
        name, sign, rest = text.partition("=")
        if not (name and sign and rest) or name in result:
            raise WlmError(f"{option}: expected NAME={value}, each name once, got {text!r}")
        result[name] = rest
    return result


def group_weights(weights: list[str] | None, colours: list[str] | None) -> dict[str, list[float]]:
    """Returns the factors of red, green and blue of the groups that the options name."""
    factors: dict[str, list[float]] = {}
    for option, given, value, count in (("--weight", weights, "NUMBER", 1), ("--colour", colours, "R,G,B", 3)):
        for name, text in _by_group(option, given, value).items():
            try:
                numbers = [float(part) for part in text.split(",")]
            except ValueError:
                numbers = []
            if len(numbers) != count or not all(number >= 0.0 for number in numbers):
                raise WlmError(f"{option}: expected {name}={value}, numbers of at least 0, got {text!r}")
            known = factors.get(name, [1.0] * 3)
            factors[name] = [factor * numbers[i % count] for i, factor in enumerate(known)]
    return factors


def _facts(model: "LightmapModel") -> dict[str, Any]:
    stored = f"{len(model.times)}, {model.times[0]:g} to {model.times[-1]:g}"
    return {"times": stored, "period": model.period, "GPU_bytes": model.memory_bytes}


def _sheet(model: "SheetModel") -> dict[str, Any]:
    from wlm.lightmap.evaluation import count_kinds

    tiles = {kind: count for kind, count in count_kinds(model).items() if count}
    return {"width": model.width, "height": model.height, "GPU_bytes": model.memory_bytes, "tiles": tiles}


def _show_sheets(model: "LightmapModel") -> None:
    if len(model.groups) > 1:
        rows = console.table("light groups", ["group", "times", "GPU bytes"])
        for name, (times, memory) in model.group_sizes().items():
            rows.add_row(escape(name), str(len(times)), f"{memory:,}")
        console.show(rows)
    columns = ["sheet", "values", "size", "GPU bytes", "tiles"]
    rows = console.table("sheets", columns, text=["values", "tiles"])
    for sheet, own in model.sheets.items():
        facts = _sheet(own)
        tiles = ", ".join(f"{count} {kind}" for kind, count in facts["tiles"].items())
        size = f"{facts['width']}x{facts['height']}"
        rows.add_row(escape(sheet.label), sheet.encoding, size, f"{facts['GPU_bytes']:,}", tiles)
    console.show(rows)


def _show_report(file: Path, report: "Report") -> None:
    columns = [heading for heading, *_ in _SCORES]
    rows = console.table(
        str(file), ["", *columns, "bytes on disk", "bits per texel on disk", "bits per texel on the GPU"]
    )
    sizes = (f"{report.bytes:,}", f"{report.bpp:.3f}", f"{report.memory_bpp:.3f}")
    rows.add_row(f"wlm {escape(report.profile)}", *_cells(report, _SCORES), *sizes)
    for sheet, own in report.sheets.items() if len(report.sheets) > 1 else ():
        rows.add_row(escape(sheet.label), *_cells(own, _SCORES), "", "", f"{own.memory_bpp:.3f}")
    rows.add_section()
    light = report.light
    scores = (light.psnr_by_time, light.ssim_by_time, light.flip_by_time)
    for stamp, *values in zip(report.times, *scores, strict=True):
        rows.add_row(f"time {stamp:g}", *map(console.number, values, (".2f", ".4f", ".4f")))
    console.show(rows)
    _show_where_shown(report)
    _show_held_out(report)
    if report.sums:
        rows = console.table(
            "sum of the light groups", ["compared with", "times", "PSNR, dB", "SSIM", "PSNR of the inputs, dB"]
        )
        for score in report.sums:
            name = f"{score.reference}: {score.sheet}"
            figures = (
                console.number(score.psnr, ".2f"),
                console.number(score.ssim, ".4f"),
                console.number(score.between_inputs, ".2f"),
            )
            rows.add_row(escape(name), str(len(score.times)), *figures)
        console.show(rows)
    _note_worst(light)
    console.note_warnings(report.warnings)


def _cells(report: "Report | Summary", columns: Any) -> list[str]:
    return [console.number(factor * getattr(report, name), form) for _, name, form, factor in columns]


def _show_held_out(report: "Report") -> None:
    """Prints the scores at times that the file does not store, and of the originals around them, interpolated."""
    held = {escape(sheet.label): own.held_out for sheet, own in report.sheets.items() if own.held_out is not None}
    if held:
        columns = ["times", *(heading for heading, *_ in _SCORES)]
        rows = console.table("times of the set that the file does not store", ["", *columns])
        for name, scores in held.items():
            for what, own in (("decoded", scores.decoded), ("originals at stored times, interpolated", scores.mixed)):
                rows.add_row(f"{name}: {what}", str(len(scores.times)), *_cells(own, _SCORES))
        console.show(rows)


def _show_where_shown(report: "Report") -> None:
    """Prints the scores of the light as a renderer shows it; columns without any score are left out."""
    columns = [
        column for column in _SHOWN if any(math.isfinite(getattr(own, column[1])) for own in report.sheets.values())
    ]
    if columns:
        rows = console.table("PSNR and errors where light is shown", ["", *(heading for heading, *_ in columns)])
        for sheet, own in report.sheets.items():
            rows.add_row(escape(sheet.label), *_cells(own, columns))
        console.show(rows)


def _note_worst(report: "SheetReport") -> None:
    """Prints the tile, time and view with the lowest scores, and how many tiles have no score."""
    places = {
        "": report.worst_tile,
        ", filtered read": report.worst_seen,
        ", between stored times": report.worst_between,
    }
    for what, worst in places.items():
        if worst is not None:
            console.note(f"worst PSNR{what}: {worst['psnr']:.2f} dB, tile {worst['tile']} at time {worst['time']:g}")
    if (worst := report.worst_view) is not None:
        place = f"camera {worst['view']} at time {worst['time']:g}"
        console.note(f"worst view: {worst['psnr']:.2f} dB, FLIP {worst['flip']:.4f}, {place}")
    reasons = ", ".join(f"{count} {reason}" for reason, count in report.not_scored.items() if count)
    if reasons:
        console.note(f"tiles without a score, counted at each time: {reasons}")
