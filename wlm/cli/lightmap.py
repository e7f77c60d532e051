"""`wlm lightmap`: compress a set of lightmaps over time, decode it, score it, look into it, export it."""

import time as clock
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
from wlm.cli.lightmap_layers import refuse_layers, show_layered, show_layered_info, show_layered_report, write_layer
from wlm.cli.lightmap_tables import show_contest, show_report, show_tiles
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
    from wlm.lightmap import LayeredModel, LayeredSet, LightmapModel, LightmapSet, Profile
    from wlm.lightmap.rate import Choice

_LAYERED = "lightmap-layers"

app = typer.Typer(help="Lightmaps over time: BC7 feature maps and a tiny network for each 128² tile.")

_Set = Annotated[
    Path,
    typer.Argument(
        metavar="SET",
        help="A set.json, or a folder of lightmaps (.exr, .hdr, .ktx2, .dds), of Unity's states or of a contest.",
    ),
]
_Times = Annotated[
    str | None, typer.Option(help="Times of the lightmaps in order: numbers and start:stop:step, by commas.")
]
_Mask = Annotated[str | None, typer.Option(help='Valid texels: a PNG, "alpha" or "all"; default as the set says.')]
_Period = Annotated[float | None, typer.Option(help="Length of the day; default as the set says.")]
_Layers = Annotated[
    str | None, typer.Option(metavar="NAMES", help="Of a set with layers: which to read, by commas; default all.")
]
_Map = Annotated[
    str | None, typer.Option("--map", metavar="ID", help="Which lightmap of a contest's folder: ID or LEVEL/ID.")
]


@app.command()
@exclusive
def compress(
    set_path: _Set,
    output: Annotated[Path, output_option("OUT.wlm", "The file to write.")],
    profile: Annotated[str, typer.Option(help="L, M, ..., frames, video, levels, or a YAML file of settings.")] = "M",
    tiles: Annotated[str | None, typer.Option(help="Only these tiles, such as 0-3,7; default all.")] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of the fit; default as the profile says.")] = None,
    samples: Annotated[int | None, typer.Option(help="Samples of each tile in a step; a multiple of 128.")] = None,
    target_psnr: Annotated[
        float | None,
        typer.Option(metavar="DB", help="Choose the maps' size, or a video's quality, for it; takes longer."),
    ] = None,
    max_bpp: Annotated[
        float | None,
        typer.Option(metavar="BITS", help="Choose the same for a file of at most so many bits a texel and time."),
    ] = None,
    seed: Seed = 0,
    device: Device = "cpu",
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            metavar="N",
            help="Processes that fit tiles side by side; the file is the same. Default: one for two cores, one on a "
            "GPU, what a cluster has room for; with cuda N are spread over the GPUs.",
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
    map_id: _Map = None,
    layers: _Layers = None,
    trust: Trust = False,
) -> None:
    """Compress a lightmap set into one file.

    The fit is kept in OUT.wlm.partial from time to time, and by Ctrl-C and SIGTERM; the same command with --resume goes
    on exactly. Lightmaps beyond 1 GiB lie in a temporary file (TMPDIR) while it runs.
    """
    check_output(output, ".wlm")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.lightmap.evaluation import bits_per_texel, count_kinds, lost_light
    from wlm.lightmap.front import compress, open_checkpoint
    from wlm.lightmap.layers.data import LayeredSet
    from wlm.lightmap.model import Profile
    from wlm.lightmap.tiles import TileGrid, parse_tiles

    settings = Profile.load(profile).override({"steps": steps, "samples": samples}, "--")
    # The device of a cluster is none of this machine's.
    own_device = "cpu" if cluster is not None else check_device(device)
    lightmaps = _load(set_path, times, mask, period, trust, map_id, layers)
    layered = isinstance(lightmaps, LayeredSet)
    if layered:
        refuse_layers(**{"tiles": tiles, "target-psnr": target_psnr, "max-bpp": max_bpp})
    numbers = None if tiles is None else parse_tiles(tiles, TileGrid.of(*lightmaps.mask.shape).count)
    places = {"workers": workers, "cluster": cluster}
    if target_psnr is not None or max_bpp is not None:
        if numbers is not None:
            raise WlmError("--tiles: expected without --target-psnr and --max-bpp, which choose for a whole set")
        wanted = {"target_psnr": target_psnr, "max_bpp": max_bpp}
        choice = _chosen(lightmaps, settings, wanted, {"seed": seed, "device": device} | places)
        settings, places["survey"] = choice.profile, choice.survey
    options = {"seed": seed, "device": device} | ({} if layered else {"tiles": numbers})
    checkpoint = open_checkpoint(output, lightmaps, settings, resume=resume, every=checkpoint_every, **options)
    note_start(checkpoint, resume, "at step 0")
    start = clock.perf_counter()
    with running("fit", checkpoint.path) as progress:
        model = compress(lightmaps, settings, progress=progress, checkpoint=checkpoint, **places, **options)
        seconds = clock.perf_counter() - start
        size = model.save(output)
        checkpoint.remove()
    if layered:
        show_layered(output, model, lightmaps, size, seconds, own_device)
        return
    kinds = ", ".join(f"{count} {kind}" for kind, count in count_kinds(model).items() if count)
    rows = table(model.name, ["file", "bytes", "bpp", "tiles", "seconds"], text=["tiles"])
    # Tiles without a valid texel leave nothing to count.
    bpp = bits_per_texel(model, lightmaps.mask, size) if model.kind.any() else None
    rows.add_row(escape(str(output)), f"{size:,}", number(bpp, ".3f"), kinds, f"{seconds:.1f}")
    show(rows)
    if bpp is not None and max_bpp is not None and bpp > max_bpp:
        note(f"warning: --max-bpp {max_bpp:g}: the trials were smaller than the file, which has {bpp:.3f}")
    for warning in (*model.warnings, *(lost_light(model, lightmaps, own_device) if model.kind.any() else ())):
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
            help="Also write what a texture cache holds: 8 bits, radiance = (byte / 255 * bound) ** gamma, with gamma "
            "and the bound of each tile in the PNG's text.",
        ),
    ] = None,
    texture: Annotated[
        Path | None,
        typer.Option(
            metavar="MAP.dds",
            help="Also write what a renderer samples: one texture of RGB9E5 texels, 32 bits each, with mips.",
        ),
    ] = None,
    layer: Annotated[
        str | None, typer.Option(metavar="NAME", help="Of a file with layers: which; default the first of light.")
    ] = None,
    atlas: Annotated[str | None, typer.Option(metavar="NAME", help="Of such a file: which; default the first.")] = None,
    device: Device = "cpu",
) -> None:
    """Decode the whole map at one time."""
    check_output(output, ".exr")
    if texture is not None:
        check_output(texture, ".dds")
    if eight_bit is not None:
        check_output(eight_bit, ".png")
    quiet_warp()
    from wlm.formats.exr import write_exr
    from wlm.lightmap.exporter import write_8bit, write_texture

    model = _model(file)
    decoder = model.decoder(device)
    if model.SYSTEM == _LAYERED:
        refuse_layers(texture=texture)
        frame = write_layer(decoder, time, layer, atlas, output, eight_bit)
    else:
        for name, value in {"layer": layer, "atlas": atlas}.items():
            if value is not None:
                raise WlmError(f"{file}: --{name} means nothing to a file without layers")
        frame = decoder.frame(time)
        write_exr(output, frame)
        if eight_bit is not None:
            write_8bit(eight_bit, decoder, time)
        if texture is not None:
            write_texture(texture, model, time, device)
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
    score: Annotated[
        Literal["hprc"] | None, typer.Option(help="Add the score of a contest, as far as its rules are public.")
    ] = None,
    device: Device = "cpu",
    times: _Times = None,
    mask: _Mask = None,
    period: _Period = None,
    map_id: _Map = None,
    layers: _Layers = None,
    trust: Trust = False,
) -> None:
    """Compare a file with its input: PSNR, SSIM and FLIP by tile and by time, bits per texel, and what is seen of it.

    As it is seen: filtered, in the gaps beside charts, between stored times, across tiles, over time, in views of the
    set's mesh.
    """
    if json_path is not None:
        check_output(json_path, ".json")
    if html_path is not None:
        check_output(html_path, ".html")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.lightmap.evaluation import contest_score
    from wlm.lightmap.front import evaluate
    from wlm.system import plain

    device = check_device(device)
    model = _model(file)
    if model.SYSTEM == _LAYERED:
        refuse_layers(html=html_path, score=score)
    lightmaps = _load(set_path, times, mask, period, trust, map_id, layers)
    with running("score") as progress:
        size = file.stat().st_size
        report = evaluate(model, lightmaps, views=views, device=device, progress=progress, file_bytes=size)
    if model.SYSTEM == _LAYERED:
        if json_path is not None:
            write_json(json_path, report.to_json())
        show_layered_report(file, report)
        return
    if html_path is not None:
        from wlm.view.reports import lightmap_report

        lightmap_report(html_path, model, lightmaps, report)
    extra: dict[str, Any] = {}
    contest = None
    if score is not None:
        with running("contest") as progress:
            contest = contest_score(model, lightmaps, device=device, progress=progress)
        extra[score] = plain(contest)
    if json_path is not None:
        write_json(json_path, report.to_json() | extra)
    show_report(file, report)
    if contest is not None:
        show_contest(contest)


@app.command()
def info(
    file: ModelFile,
    tiles: Annotated[bool, typer.Option("--tiles", help="List each tile: its kind, its bytes, and why.")] = False,
    as_json: AsJson = False,
    device: Annotated[str, typer.Option(help="Where to load it, to say what memory its maps take there.")] = "cpu",
) -> None:
    """Say what a file holds, without decoding it."""
    quiet_warp()
    from wlm.lightmap.evaluation import count_kinds, part_bytes
    from wlm.lightmap.held import held_tiles

    model = _model(file)
    if tiles and model.SYSTEM == _LAYERED:
        raise WlmError(f"{file}: --tiles is of files of one lightmap, not of layers")
    if model.SYSTEM == _LAYERED:
        show_layered_info(file, model, model.decoder(device), as_json)
        return
    decoder = model.decoder(device)
    size = file.stat().st_size
    facts: dict[str, Any] = {
        "name": model.name,
        "bytes": size,
        "width": model.width,
        "height": model.height,
        "times": model.times.tolist(),
        "period": model.period,
        "source": model.source,
        "tiles": count_kinds(model),
        "parts": part_bytes(model, size),
        "device": decoder.device,
        "device_bytes": decoder.device_bytes,
        "profile": model.profile.model_dump(mode="json"),
    }
    held = held_tiles(model) if tiles else []
    if tiles:
        facts["each_tile"] = [vars(tile) for tile in held]
    if as_json:
        show_json(facts)
        return
    sections = (
        {
            "name": escape(model.name),
            "bytes": f"{size:,}",
            "size": f"{model.width}x{model.height}",
            "times": f"{len(model.times)}, {model.times[0]:g} to {model.times[-1]:g}",
            "period": number(model.period, "g"),
            "source": escape(model.source),
            "profile": escape(model.profile.name),
        },
        {f"{kind} tiles": str(count) for kind, count in facts["tiles"].items()},
        {f"bytes of {part}": f"{count:,}" for part, count in facts["parts"].items()},
        {f"bytes on {decoder.device}": f"{decoder.device_bytes:,}"},
    )
    rows = table(str(file), ["", "value"])
    for section in sections:
        for row in section.items():
            rows.add_row(*row)
        rows.add_section()
    show(rows)
    if tiles:
        show_tiles(held)


@app.command()
def export(
    file: ModelFile,
    output: Annotated[Path, output_option("DIR", "The folder to write to.")],
    engine: Engine = "raw",
    shader: ShaderLanguage = None,
    exact: ExactShader = False,
    device: Annotated[str, typer.Option(help="Of raw, where the frame to compare with is decoded.")] = "cpu",
) -> None:
    """Write the light for an engine: textures, floats, a decoder, and for an engine by name what puts them together.

    Of raw, frame.exr is the map at the first stored time: what the shader should show. Of a file with layers each sheet
    of three channels has a folder of its own, for an engine by name each sheet of light; sheets.json names them.
    """
    language = shader_of(engine, shader, exact)
    if engine != "raw" and device != "cpu":
        raise WlmError(f"--device: means nothing with --engine {engine}, for which no frame is decoded")
    quiet_warp()
    from wlm.export import export as export_kit
    from wlm.lightmap.front import export

    model = _model(file)
    rows = table(str(output), ["file", "bytes"])
    if engine == "raw":
        paths = export(model, output, device=device, shader=language, exact=exact)
    else:
        paths = export_kit(model, output, engine)
        left = [] if model.SYSTEM != _LAYERED else [sheet.label for sheet in model.sheets if sheet.linear]
        if left:
            note(f"warning: left out, since --engine {engine} shows light alone: {', '.join(left)}")
    for path in paths:
        rows.add_row(escape(str(path.relative_to(output))), f"{path.stat().st_size:,}")
    show(rows)


def _model(file: Path) -> "LightmapModel | LayeredModel":
    """Reads a file of lightmaps, with layers or without."""
    from wlm.system import load

    model = load(file)
    if model.SYSTEM not in ("lightmap", _LAYERED):
        raise WlmError(f"{file}: expected an artifact of lightmap, found one of {model.SYSTEM}")
    return model


def _chosen(
    lightmaps: "LightmapSet",
    settings: "Profile",
    wanted: dict[str, float | None],
    options: dict[str, Any],
) -> "Choice":
    """Chooses the size of the maps, or the quality of video, and says what it was and why."""
    from wlm.lightmap.rate import choose

    with running("choose") as progress:
        choice = choose(lightmaps, settings, **wanted, **options, progress=progress)
    resolution, quality = choice.profile.uvt_resolution, choice.profile.video_quality
    chosen = f"F_uvt of {resolution}x{resolution}" if settings.frames != "video" else f"video of quality {quality}"
    psnr = "" if choice.psnr is None else f", {choice.psnr:.1f} dB"
    note(f"{chosen}: about {choice.bpp:.3f} bits a texel and time{psnr}")
    if choice.limited:
        psnr, bpp = wanted["target_psnr"], wanted["max_bpp"]
        note(f"warning: --max-bpp {bpp:g} holds the PSNR below the {psnr:g} dB of --target-psnr")
    return choice


def _load(
    path: Path,
    times: str | None,
    mask: str | None,
    period: float | None,
    trust: bool,
    map_id: str | None,
    layers: str | None,
) -> "LightmapSet | LayeredSet":
    """Reads a set and prints what was repaired in it."""
    from wlm.lightmap.data import parse_times
    from wlm.lightmap.front import load

    stamps = None if times is None else parse_times(times)
    names = None if layers is None else [name.strip() for name in layers.split(",")]
    lightmaps = load(path, times=stamps, mask=mask, period=period, trust=trust, map_id=map_id, layers=names)
    for warning in lightmaps.warnings:
        note(f"warning: {warning}")
    return lightmaps
