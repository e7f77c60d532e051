"""`wlm lightmap`: compress a set of lightmaps over time, decode it, score it, look into it, export it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import (
    check_output,
    deferred_interrupt,
    escape,
    note,
    number,
    progress_bar,
    quiet_warp,
    show,
    show_json,
    table,
    write_json,
)
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.baselines.lightmap import Score
    from wlm.baselines.rival import Rival
    from wlm.lightmap.data import LightmapSet
    from wlm.lightmap.evaluation import Report
    from wlm.lightmap.model import LightmapModel, Profile

__all__ = ["app"]

app = typer.Typer(help="Lightmaps over time: BC7 feature maps and a tiny network for each 128² tile.")

_Set = Annotated[Path, typer.Argument(metavar="SET", help="A set.json, or a folder of EXR files.")]
_File = Annotated[Path, typer.Argument(metavar="FILE.wlm", help="A file that compress wrote.")]
_Device = Annotated[str, typer.Option(help='Where it computes: "cpu", "cuda" or "cuda:N".')]
_Times = Annotated[
    str | None, typer.Option(help="Times of the lightmaps in order: numbers and start:stop:step, by commas.")
]
_Mask = Annotated[str | None, typer.Option(help='Valid texels: a PNG, "alpha" or "all"; default as the set says.')]
_Period = Annotated[float | None, typer.Option(help="Length of the day; default as the set says.")]

_NAMES = {"bc6h": "BC6H", "bc7": "BC7", "astc12": "ASTC 12x12", "astc10": "ASTC 10x10", "8bit": "8 bits"}


@app.command()
def compress(
    set_path: _Set,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="OUT.wlm", help="The file to write.")],
    profile: Annotated[str, typer.Option(help="L, M, H, ..., or a YAML file of settings.")] = "M",
    tiles: Annotated[str | None, typer.Option(help="Only these tiles, such as 0-3,7; default all.")] = None,
    steps: Annotated[int | None, typer.Option(help="Steps of the fit; default as the profile says.")] = None,
    samples: Annotated[int | None, typer.Option(help="Samples of each tile in a step; a multiple of 128.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=2**31 - 1, help="One seed gives one result on one device.")] = 0,
    device: _Device = "cpu",
    resume: Annotated[bool, typer.Option("--resume", help="Go on with an interrupted fit of OUT.wlm.")] = False,
    times: _Times = None,
    mask: _Mask = None,
    period: _Period = None,
) -> None:
    """Compress a lightmap set into one file.

    Ctrl-C keeps the fit in OUT.wlm.partial; the same command with --resume goes on exactly.
    """
    check_output(output, ".wlm")
    settings = _settings(profile, steps, samples)
    quiet_warp()
    from wlm.interop import check_device
    from wlm.lightmap import codec
    from wlm.lightmap.checkpoint import open_checkpoint
    from wlm.lightmap.fit import Progress, compress
    from wlm.lightmap.tiles import TileGrid, parse_tiles

    device = check_device(device)
    lightmaps = _load(set_path, times, mask, period)
    numbers = None if tiles is None else parse_tiles(tiles, TileGrid.of(*lightmaps.mask.shape).count)
    checkpoint = open_checkpoint(output, lightmaps, settings, tiles=numbers, seed=seed, device=device, resume=resume)
    if resume and not checkpoint.resumed:
        note(f"{checkpoint.path}: there is nothing to resume; starting at step 0")
    seconds, at = 0.0, 0
    try:
        with deferred_interrupt() as check_interrupt, progress_bar("fit") as bar:

            def report(now: Progress) -> None:
                nonlocal seconds, at
                seconds, at = now.seconds, now.step
                bar(now.step, now.steps, f"loss {now.loss:.3g}, PSNR {now.psnr:.1f} dB")
                check_interrupt()

            model = compress(
                lightmaps,
                settings,
                tiles=numbers,
                seed=seed,
                device=device,
                progress=report,
                checkpoint=checkpoint,
            )
    except KeyboardInterrupt:
        note(f"stopped at step {at}: the same command with --resume goes on from {checkpoint.path}")
        raise
    size = codec.write(output, model)
    checkpoint.remove()
    _show_compressed(output, model, lightmaps, size, seconds)


@app.command()
def decode(
    file: _File,
    time: Annotated[float, typer.Option(help="In the unit of the set's times; any, also between stored ones.")],
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FRAME.exr", help="The EXR to write.")],
    eight_bit: Annotated[
        Path | None,
        typer.Option(
            metavar="FRAME.png",
            help="Also write what a texture cache holds: 8 bits, radiance = (byte / 255 * bound) ** gamma, with gamma "
            "and the bound of each tile in the PNG's text.",
        ),
    ] = None,
    device: _Device = "cpu",
) -> None:
    """Decode the whole map at one time."""
    check_output(output, ".exr")
    if eight_bit is not None:
        check_output(eight_bit, ".png")
    quiet_warp()
    from wlm.formats.exr import write_exr
    from wlm.lightmap import codec
    from wlm.lightmap.decode import Decoder

    decoder = Decoder(codec.read(file), device)
    frame = decoder.frame(time)
    write_exr(output, frame)
    if eight_bit is not None:
        _write_png(eight_bit, *decoder.frame_8bit(time), decoder.model.profile.gamma)
    rows = table(str(file), ["time", "size", "mean", "largest", "file"])
    rows.add_row(
        f"{time:g}",
        f"{frame.shape[1]}x{frame.shape[0]}",
        f"{frame.mean():.4g}",
        f"{frame.max():.4g}",
        escape(str(output)),
    )
    show(rows)


@app.command()
def evaluate(
    file: _File,
    set_path: _Set,
    json_path: Annotated[Path | None, typer.Option("--json", metavar="REPORT.json", help="Write a report.")] = None,
    baselines: Annotated[
        bool, typer.Option("--baselines", help="Add BC6H, BC7, ASTC and plain 8 bits (extra `baselines`).")
    ] = False,
    device: _Device = "cpu",
    times: _Times = None,
    mask: _Mask = None,
    period: _Period = None,
) -> None:
    """Compare every stored time with the input: PSNR, SSIM and FLIP by tile and by time, and bits a texel."""
    if json_path is not None:
        check_output(json_path, ".json")
    quiet_warp()
    from wlm.interop import check_device
    from wlm.lightmap import codec
    from wlm.lightmap.evaluation import evaluate

    device = check_device(device)
    model = codec.read(file)
    lightmaps = _load(set_path, times, mask, period)
    with progress_bar("score") as bar:
        report = evaluate(
            model,
            lightmaps,
            file.stat().st_size,
            device=device,
            progress=lambda done, total: bar(done, total, ""),
        )
    rivals: list[tuple[Rival, Score]] = []
    if baselines:
        from wlm.baselines.lightmap import evaluate_rivals

        with progress_bar("baselines") as bar:
            rivals = evaluate_rivals(
                model, lightmaps, tuple(_NAMES), progress=lambda done, total: bar(done, total, "")
            )
    if json_path is not None:
        extra = {"baselines": [rival.to_json() | score.to_json() for rival, score in rivals]} if baselines else {}
        write_json(json_path, report.to_json() | extra)
    _show_report(file, report, rivals)


@app.command()
def info(
    file: _File,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
    device: Annotated[str, typer.Option(help="Where to load it, to say what memory its maps take there.")] = "cpu",
) -> None:
    """Say what a file holds, without decoding it."""
    quiet_warp()
    from wlm.lightmap import codec
    from wlm.lightmap.decode import Decoder
    from wlm.lightmap.evaluation import count_kinds, part_bytes

    model = codec.read(file)
    decoder = Decoder(model, device)
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
    if as_json:
        show_json(facts)
        return
    rows = table(str(file), ["", "value"])
    rows.add_row("name", escape(model.name))
    rows.add_row("bytes", f"{size:,}")
    rows.add_row("size", f"{model.width}x{model.height}")
    rows.add_row("times", f"{len(model.times)}, {model.times[0]:g} to {model.times[-1]:g}")
    rows.add_row("period", number(model.period, "g"))
    rows.add_row("source", escape(model.source))
    rows.add_row("profile", escape(model.profile.name))
    rows.add_section()
    for kind, count in facts["tiles"].items():
        rows.add_row(f"{kind} tiles", str(count))
    rows.add_section()
    for part, count in facts["parts"].items():
        rows.add_row(f"bytes of {part}", f"{count:,}")
    rows.add_section()
    rows.add_row(f"bytes on {decoder.device}", f"{decoder.device_bytes:,}")
    show(rows)


@app.command()
def export(
    file: _File,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="DIR", help="The folder to write to.")],
    device: Annotated[str, typer.Option(help="Where the frame to compare with is decoded.")] = "cpu",
) -> None:
    """Write the maps as textures and the rest as plain files, for an engine.

    frame.exr is the map at the first stored time: what the shader should make of the rest.
    """
    quiet_warp()
    from wlm.formats.exr import write_exr
    from wlm.lightmap import codec
    from wlm.lightmap.decode import Decoder
    from wlm.lightmap.exporter import export

    model = codec.read(file)
    decoder = Decoder(model, device)
    frame = output / "frame.exr"
    paths = [*export(model, output), frame]
    write_exr(frame, decoder.frame(float(model.times[0])), half=False)
    rows = table(str(output), ["file", "bytes"])
    for path in map(Path, paths):
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}")
    show(rows)


def _settings(profile: str, steps: int | None, samples: int | None) -> "Profile":
    """Loads a profile and checks what replaces a part of it."""
    from pydantic import ValidationError

    from wlm.lightmap.model import Profile, load_profile

    loaded = load_profile(profile)
    given = {name: value for name, value in (("steps", steps), ("samples", samples)) if value is not None}
    try:
        return Profile(**loaded.model_dump() | given)
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]
        expected = problem["msg"].replace("Input should be", "expected", 1)
        raise WlmError(f"--{problem['loc'][0]}: {expected}, got {problem['input']}") from error


def _load(path: Path, times: str | None, mask: str | None, period: float | None) -> "LightmapSet":
    """Reads a set and says what was repaired in it."""
    from wlm.lightmap.data import load_set, parse_times

    lightmaps = load_set(path, times=None if times is None else parse_times(times), mask=mask, period=period)
    for warning in lightmaps.warnings:
        note(f"warning: {warning}")
    return lightmaps


def _write_png(path: Path, pixels: Any, bounds: Any, gamma: float) -> None:
    import json

    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    from wlm.formats.atomic import atomic_path

    text = PngInfo()
    text.add_text("wlm", json.dumps({"gamma": gamma, "bounds": bounds.tolist()}))
    with atomic_path(path) as temporary:
        Image.fromarray(pixels).save(temporary, "PNG", pnginfo=text)


def _show_compressed(path: Path, model: "LightmapModel", lightmaps: "LightmapSet", size: int, seconds: float) -> None:
    from wlm.lightmap.evaluation import bits_per_texel, count_kinds

    kinds = ", ".join(f"{count} {kind}" for kind, count in count_kinds(model).items() if count)
    rows = table(model.name, ["file", "bytes", "bpp", "tiles", "seconds"], text=["tiles"])
    # Tiles that were asked for and have no valid texel leave nothing to count.
    bpp = bits_per_texel(model, lightmaps.mask, size) if model.kind.any() else None
    rows.add_row(escape(str(path)), f"{size:,}", number(bpp, ".3f"), kinds, f"{seconds:.1f}")
    show(rows)


def _show_report(file: Path, report: "Report", rivals: "list[tuple[Rival, Score]]") -> None:
    rows = table(str(file), ["", "PSNR dB", "SSIM", "FLIP", "bytes", "bpp"])

    def add(name: str, psnr: float, ssim: float, flip: float, size: str = "", bpp: str = "") -> None:
        rows.add_row(name, number(psnr, ".2f"), number(ssim, ".4f"), number(flip, ".4f"), size, bpp)

    add(
        f"wlm {escape(report.profile)}",
        report.psnr,
        report.ssim,
        report.flip,
        f"{report.bytes:,}",
        f"{report.bpp:.3f}",
    )
    for rival, score in rivals:
        add(_NAMES[rival.name], score.psnr, score.ssim, score.flip, f"{score.bytes:,}", f"{score.bpp:.3f}")
    rows.add_section()
    scores = (report.psnr_by_time, report.ssim_by_time, report.flip_by_time)
    for stamp, *values in zip(report.time_values, *scores, strict=True):
        add(f"time {stamp:g}", *values)
    rows.add_section()
    grids = (report.psnr_by_tile, report.ssim_by_tile, report.flip_by_tile)
    for tile, values in enumerate(zip(*(grid.ravel() for grid in grids), strict=True)):
        # Tiles that are empty or not in the file have nothing to show.
        if any(value == value for value in values):
            add(f"tile {tile}", *values)
    show(rows)
    if report.worst_tile is not None:
        worst = report.worst_tile
        note(f"worst: {report.worst_psnr:.2f} dB, tile {worst['tile']} at {worst['time']:g}")
    left_out = ", ".join(f"{count} {reason}" for reason, count in report.not_scored.items() if count)
    if left_out:
        note(f"without a score, tiles times times: {left_out}")
    if report.format_limited:
        note(
            f"{len(report.format_limited)} scored ones span only a few steps of half float; without them PSNR is "
            f"{number(report.psnr_unlimited, '.2f')} dB"
        )
    for warning in report.warnings:
        note(f"warning: {warning}")
