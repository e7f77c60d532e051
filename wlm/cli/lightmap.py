"""`wlm lightmap`: compress a set of lightmaps over time, decode it, score it, describe it, export it."""

import time as clock
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
    escape,
    exclusive,
    note,
    note_start,
    number,
    quiet_warp,
    running,
    show,
    show_json,
    table,
    write_json,
)
from wlm.cli.lightmap_tables import kinds_of, show_report, show_tiles
from wlm.cli.options import (
    AsJson,
    CheckpointEvery,
    Device,
    Engine,
    ExactShader,
    ModelFile,
    PageFile,
    ReportFile,
    Resume,
    Seed,
    ShaderLanguage,
    Trust,
    output_option,
    shader_of,
)
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.lightmap import LightmapModel, LightmapSet

app = typer.Typer(help="Lightmaps over time: BC7 feature maps and a tiny network for each 128² tile.")

_Set = Annotated[
    Path,
    typer.Argument(
        metavar="SET",
        help="A set.json, or a folder of lightmaps (.exr, .hdr, .ktx2, .dds), or of Unity's states of light.",
    ),
]
_Times = Annotated[
    str | None, typer.Option(help="Times of the lightmaps in order: numbers and start:stop:step, by commas.")
]
_Mask = Annotated[str | None, typer.Option(help='Valid texels: a PNG, "alpha" or "all"; default as the set says.')]
_Period = Annotated[float | None, typer.Option(help="Length of the day; default as the set says.")]
_Layers = Annotated[str | None, typer.Option(metavar="NAMES", help="Layers to read, separated by commas; default all.")]


@app.command()
@exclusive
def compress(
    set_path: _Set,
    output: Annotated[Path, output_option("OUT.wlm", "The file to write.")],
    profile: Annotated[str, typer.Option(help="L, M, H, standard, fine, frames, or a YAML file of settings.")] = "M",
    tiles: Annotated[str | None, typer.Option(help="Only these tiles, such as 0-3,7; default all.")] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of the fit; default as the profile says.")] = None,
    samples: Annotated[int | None, typer.Option(help="Samples of each tile in a step; a multiple of 128.")] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Processes that fit tiles side by side; the file is the same. Default: one for two cores, one on a "
            "GPU, as many as a cluster has room for; with cuda N are spread over the GPUs.",
        ),
    ] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help='Fit on a cluster of Ray (extra `cluster`): ray://HOST:10001, or "auto" on one of its machines.',
        ),
    ] = None,
    resume: Resume = False,
    checkpoint_every: CheckpointEvery = 30.0,
    times: _Times = None,
    mask: _Mask = None,
    period: _Period = None,
    layers: _Layers = None,
    trust: Trust = False,
) -> None:
    """Compress a lightmap set into one file.

    Long fits are saved to OUT.wlm.partial every 30 s, and on Ctrl-C and SIGTERM; the same command with --resume
    continues exactly. Lightmaps beyond 1 GiB lie in a temporary file (TMPDIR) while it runs.
    """
    check_output(output, ".wlm")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.lightmap import Profile, open_checkpoint
    from wlm.lightmap import compress as fit
    from wlm.lightmap.evaluation import lost_light
    from wlm.lightmap.tiles import TileGrid, parse_tiles

    settings = Profile.load(profile).override({"steps": steps, "samples": samples}, "--")
    # The machines of a cluster have their own devices.
    own_device = "cpu" if cluster is not None else check_device(device)
    lightmaps = _load(set_path, times, mask, period, trust, layers)
    numbers = None if tiles is None else parse_tiles(tiles, TileGrid.of(*lightmaps.light.mask.shape).count)
    options = {"seed": seed, "device": device, "tiles": numbers}
    checkpoint = open_checkpoint(output, lightmaps, settings, resume=resume, every=checkpoint_every, **options)
    note_start(checkpoint, resume, "at step 0")
    start = clock.perf_counter()
    places = {"workers": workers, "cluster": cluster}
    with running("fit", checkpoint.path) as progress:
        model = fit(lightmaps, settings, progress=progress, checkpoint=checkpoint, **places, **options)
        seconds = clock.perf_counter() - start
        size = model.save(output)
        checkpoint.remove()
    rows = table(model.name, ["file", "bytes on disk", "bytes of GPU memory", "seconds", "tiles"], text=["tiles"])
    memory = f"{model.memory_bytes:,}"
    rows.add_row(escape(str(output)), f"{size:,}", memory, f"{seconds:.1f}", kinds_of(model))
    show(rows)
    for warning in (*model.warnings, *lost_light(model, lightmaps, own_device)):
        note(f"warning: {warning}")


@app.command()
def decode(
    file: ModelFile,
    time: Annotated[float, typer.Option(help="In the unit of the set's times; any, also between stored ones.")],
    output: Annotated[Path, output_option("FRAME.exr", "The EXR to write.")],
    eight_bit: Annotated[
        Path | None,
        typer.Option(
            metavar="FRAME.png",
            help="Also write 8 bits as a texture cache holds them: radiance = (byte / 255 * bound) ** gamma, with "
            "gamma and the bound of each tile in the PNG's text.",
        ),
    ] = None,
    texture: Annotated[
        Path | None,
        typer.Option(
            metavar="MAP.dds",
            help="Also write the texture that a renderer samples: RGB9E5 texels, 32 bits each, with mips.",
        ),
    ] = None,
    layer: Annotated[str | None, typer.Option(metavar="NAME", help="Layer; default the first of light.")] = None,
    atlas: Annotated[str | None, typer.Option(metavar="NAME", help="Atlas; default the first.")] = None,
    device: Device = "cpu",
) -> None:
    """Decode a whole map at one time."""
    check_output(output, ".exr")
    if texture is not None:
        check_output(texture, ".dds")
    if eight_bit is not None:
        check_output(eight_bit, ".png")
    quiet_warp()
    import numpy as np

    from wlm.formats.channels import read_channels
    from wlm.formats.exr import HALF_MAX, write_part
    from wlm.lightmap.runtime_texture import write_8bit, write_texture

    model = _model(file)
    sheets = model.layer(layer, atlas)
    if (eight_bit or texture) and len(sheets) > 1:
        raise WlmError(f"--eight-bit: expected a layer of at most three channels, found {sheets[0].layer} of more")
    if texture is not None and sheets[0].linear:
        raise WlmError(f"--texture: expected a layer of light, found {sheets[0].layer}")
    decoder = model.decoder(device)
    frame = decoder.frame(time, layer, atlas)
    names = [name for sheet in sheets for name in sheet.channels]
    planes = np.moveaxis(np.clip(frame, -HALF_MAX, HALF_MAX).astype(np.float16), 2, 0)
    channels = {name: np.ascontiguousarray(plane) for name, plane in zip(names, planes, strict=True)}
    write_part(output, channels, read_channels)
    if eight_bit is not None:
        write_8bit(eight_bit, decoder.sheets[sheets[0]], time, sheets[0].values)
    if texture is not None:
        write_texture(texture, model.sheets[sheets[0]], time, device)
    if len(model.sheets) > 1:
        note(f"layer {sheets[0].layer} of atlas {sheets[0].atlas}, {sheets[0].encoding}: {', '.join(names)}")
    rows = table(str(file), ["time", "size", "mean", "largest", "file"])
    size, mean, largest = f"{frame.shape[1]}x{frame.shape[0]}", f"{frame.mean():.4g}", f"{frame.max():.4g}"
    rows.add_row(f"{time:g}", size, mean, largest, escape(str(output)))
    show(rows)


@app.command()
def evaluate(
    file: ModelFile,
    set_path: _Set,
    json_path: ReportFile = None,
    html_path: PageFile = None,
    views: Annotated[
        int, typer.Option(min=0, help="Views of the set's mesh, if it names one, that are scored; 0 for none.")
    ] = 50,
    device: Device = "cpu",
    times: _Times = None,
    mask: _Mask = None,
    period: _Period = None,
    layers: _Layers = None,
    trust: Trust = False,
) -> None:
    """Compare a file with its input: PSNR, SSIM and FLIP by tile and by time, and the error where light is shown.

    That is filtered, in the gaps beside charts, between stored times, across tiles, over time, in views of the set's
    mesh.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.lightmap import evaluate as score

    device = check_device(device)
    model = _model(file)
    lightmaps = _load(set_path, times, mask, period, trust, layers)
    with running("score") as progress:
        size = file.stat().st_size
        report = score(model, lightmaps, views=views, device=device, progress=progress, file_bytes=size)
    if html_path is not None:
        from wlm.view.reports import lightmap_report

        lightmap_report(html_path, model, lightmaps, report)
    if json_path is not None:
        write_json(json_path, report.to_json())
    show_report(file, report)


@app.command()
def info(
    file: ModelFile,
    tiles: Annotated[bool, typer.Option("--tiles", help="List each tile: its kind, its bytes, and why.")] = False,
    as_json: AsJson = False,
    device: Annotated[str, typer.Option(help="Device to load it to, to show the memory of its maps.")] = "cpu",
) -> None:
    """Describe a file without decoding it."""
    quiet_warp()
    from wlm.lightmap.codec import part_bytes, sheet_bytes
    from wlm.lightmap.evaluation import count_kinds
    from wlm.lightmap.tile_report import report_tiles

    model = _model(file)
    decoder, size, sizes = model.decoder(device), file.stat().st_size, sheet_bytes(model)
    sheets = []
    for sheet, own in model.sheets.items():
        facts = vars(sheet) | {"width": own.width, "height": own.height, "bytes": sizes[sheet]}
        facts |= {"tiles": count_kinds(own)}
        sheets.append(facts | ({"each_tile": [vars(tile) for tile in report_tiles(own)]} if tiles else {}))
    facts: dict[str, Any] = {
        "name": model.name,
        "bytes": size,
        "memory_bytes": model.memory_bytes,
        "times": model.times.tolist(),
        "period": model.period,
        "source": model.source,
        "parts": part_bytes(model, size),
        "device": decoder.device,
        "device_bytes": decoder.device_bytes,
        "profile": model.profile.model_dump(mode="json"),
        "sheets": sheets,
    }
    if as_json:
        show_json(facts)
        return
    sections = (
        {
            "name": escape(model.name),
            "bytes on disk": f"{size:,}",
            "bytes of GPU memory": f"{model.memory_bytes:,}",
            "times": f"{len(model.times)}, {model.times[0]:g} to {model.times[-1]:g}",
            "period": number(model.period, "g"),
            "source": escape(model.source),
            "profile": escape(model.profile.name),
        },
        {f"bytes of {part}": f"{count:,}" for part, count in facts["parts"].items()},
        {f"bytes on {decoder.device}": f"{decoder.device_bytes:,}"},
    )
    rows = table(str(file), ["", "value"])
    for section in sections:
        for row in section.items():
            rows.add_row(*row)
        rows.add_section()
    show(rows)
    rows = table("sheets", ["", "encoding", "size", "bytes", "tiles"], text=["encoding", "tiles"])
    for sheet, own in model.sheets.items():
        counts = ", ".join(f"{count} {kind}" for kind, count in count_kinds(own).items() if count)
        rows.add_row(escape(sheet.label), sheet.encoding, f"{own.width}x{own.height}", f"{sizes[sheet]:,}", counts)
    show(rows)
    for own in model.sheets.values() if tiles else ():
        show_tiles(report_tiles(own))


@app.command()
def export(
    file: ModelFile,
    output: Annotated[Path, output_option("DIR", "The folder to write to.")],
    engine: Engine = "raw",
    shader: ShaderLanguage = None,
    exact: ExactShader = False,
    device: Annotated[str, typer.Option(help="Device that decodes the reference frame.")] = "cpu",
) -> None:
    """Write the light for an engine: textures, buffers and a shader, and for a named engine the parts that use them."""
    language = shader_of(engine, shader, exact)
    if engine != "raw" and device != "cpu":
        raise WlmError(f"--device: means nothing with --engine {engine}, for which no frame is decoded")
    quiet_warp()
    from wlm.export import export

    model = _model(file)
    rows = table(str(output), ["file", "bytes"])
    options = {"shader": language, "exact": exact, "device": device} if engine == "raw" else {}
    paths = export(model, output, None if engine == "raw" else engine, **options)
    left = [sheet.label for sheet in model.sheets if sheet.linear] if engine != "raw" else []
    if left:
        note(f"warning: left out, since --engine {engine} only shows light: {', '.join(left)}")
    for path in paths:
        rows.add_row(escape(str(path.relative_to(output))), f"{path.stat().st_size:,}")
    show(rows)


def _model(file: Path) -> "LightmapModel":
    """Reads a file of lightmaps."""
    from wlm.system import load

    return load(file, "lightmap")


def _load(
    path: Path, times: str | None, mask: str | None, period: float | None, trust: bool, layers: str | None
) -> "LightmapSet":
    """Reads a set and prints its repairs."""
    from wlm.lightmap.data import load, parse_times

    stamps = None if times is None else parse_times(times)
    names = None if layers is None else [name.strip() for name in layers.split(",")]
    lightmaps = load(path, times=stamps, mask=mask, period=period, trust=trust, layers=names)
    for warning in lightmaps.warnings:
        note(f"warning: {warning}")
    return lightmaps
