"""`wlm smoke shade` and `flipbook`: six-way lightmaps as pictures, as textures, and as folders for engines."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer
from rich.markup import escape

from wlm.cli.console import check_output, note, note_warnings, quiet_warp, running, show, table
from wlm.cli.options import Device, Engine, ShaderLanguage, output_option
from wlm.cli.smoke_options import SHEET, Background, Lights, White, check_positive, outputs, parse_lights, vector
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.smoke.flipbook.book import Book, Shot
    from wlm.system import OnProgress

    _Source = tuple[bool, Callable[[int | None, OnProgress], Iterable[Shot]]]

_TEXTURES = (".exr", ".png", ".tga")
_PADDING = 1  # pixels around a frame that the filter of a folder's shader reads

_Lightmaps = Annotated[
    Path,
    typer.Argument(
        metavar="LIGHTMAPS",
        help="Six-way lightmaps of wlm smoke bake or predict (.exr or a folder), or the first texture of a flip book.",
    ),
]
_With = Annotated[
    list[Path] | None,
    typer.Option(
        "--with",
        metavar="TEXTURE",
        help="The second texture of a given flip book; repeated, the texture of its opacity.",
    ),
]
_Cells = Annotated[
    str | None,
    typer.Option(
        metavar="ROWSxCOLUMNS", help="Rows and columns of frames of a given flip book; default by name or content."
    ),
]
_Layout = Literal["unity", "o3de", "o3de-tlrb", "embergen"]
_From = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="LAYOUT",
        help="Layout of a given flip book: unity, o3de, o3de-tlrb, embergen, or the channels of both textures, such as "
        "right,top,back,alpha:left,bottom,front,emission; default by names or content.",
    ),
]
_Straight = Annotated[
    bool | None,
    typer.Option(
        "--straight/--premultiplied",
        help="Whether alpha still has to multiply the light of a given flip book; default by content.",
    ),
]
_FromGain = Annotated[
    float | None,
    typer.Option(
        "--from-gain",
        help="Factor by which the light of a given flip book was multiplied; default as wlm wrote it, or 1.",
    ),
]


def register(app: typer.Typer) -> None:
    """Adds the commands `shade` and `flipbook` to the group `wlm smoke`."""
    app.command()(shade)
    app.command()(flipbook)


def shade(
    lightmaps: _Lightmaps,
    output: Annotated[Path, output_option("OUT", "The .png to write; for several frames, a folder.")],
    light: Lights = None,
    background: Background = None,
    white: White = 1.0,
    rule: Annotated[
        Literal["squared", "absolute", "normalised"],
        typer.Option(
            help="Weight of a map by the cosine c of its axis and the light: c^2, c, or c over the sum of all c."
        ),
    ] = "squared",
    textures: _With = None,
    cells: _Cells = None,
    source_layout: _From = None,
    straight: _Straight = None,
    from_gain: _FromGain = None,
    device: Device = "cpu",
) -> None:
    """Light six-way lightmaps into PNGs; a folder of frames also gets the scene's obstacles and a contact sheet.

    Without --light the lights of the scene are used, or else one from 1,1,1. With the default irradiance, 4 pi, a
    light along an axis shows the lightmap of this axis unchanged.
    """
    check_positive(white=white)
    lights, _ = parse_lights(light)
    behind = None if background is None else vector("--background", background)
    quiet_warp()
    from wlm.smoke.scene import LightSettings, Looks
    from wlm.view.pictures import contact_sheet, save_png, to_bytes
    from wlm.view.smoke import picture

    single, shots = _source(lightmaps, textures, cells, source_layout, straight, from_gain, device)
    plain = Looks(lights=[LightSettings(toward=(1, 1, 1))])
    file = outputs(lightmaps, single, output, "shade", ".png")
    rows = table(str(lightmaps), ["file", "pixels with smoke", "mean radiance", "largest", "pixels above white"])
    pictures, most = [], 0.0
    with running("shade") as progress:
        for shot in shots(None, progress):
            if shot.six.transparency is None:
                raise WlmError(f"{lightmaps}: no opacity: expected an alpha channel, or a third texture by --with")
            looks = shot.looks or plain
            given = lights or [settings.light() for settings in looks.lights]
            extra = {"albedo": looks.albedo, "ramp": looks.ramp, "obstacles": looks.obstacles, "time": looks.time}
            extra["rule"] = rule
            shaded = picture(shot.six, given, background=looks.background if behind is None else behind, **extra)
            pictures.append(to_bytes(shaded, white))
            path = file(shot.number)
            save_png(path, pictures[-1])
            covered = float((shot.six.transparency < 0.99).float().mean())
            most = max(most, covered)
            clipped = float((shaded > white).any(-1).float().mean())
            figures = (f"{covered:.1%}", f"{shaded.mean():.4g}", f"{shaded.max():.4g}", f"{clipped:.1%}")
            rows.add_row(escape(path.name), *figures)
    if not single:
        contact_sheet(output / SHEET, {"": pictures})
    show(rows)
    if not most:
        note_warnings([f"{lightmaps}: no picture shows smoke: bake it with a larger --volume extinction=PER_LENGTH"])


def flipbook(
    lightmaps: _Lightmaps,
    output: Annotated[Path, output_option("OUT", "A folder, or a .png, .tga or .exr: written as OUT_1 and OUT_2.")],
    engine: Engine = None,
    shader: ShaderLanguage = None,
    layout: Annotated[
        _Layout, typer.Option(help="Order of the lightmaps in the channels of the written textures.")
    ] = "unity",
    count: Annotated[
        int | None, typer.Option(min=1, max=4096, help="Largest number of frames, evenly spread; default all.")
    ] = None,
    gain: Annotated[
        float | None,
        typer.Option(help="Factor on the stored light; default 1 in an .exr, else the largest that does not clip."),
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second; default the scene's, or 25.")] = None,
    textures: _With = None,
    cells: _Cells = None,
    source_layout: _From = None,
    straight: _Straight = None,
    from_gain: _FromGain = None,
    mips: Annotated[
        int | None,
        typer.Option(
            min=1, max=6, help="Number of mip levels for which frames are padded so that they do not mix; default none."
        ),
    ] = None,
    device: Device = "cpu",
) -> None:
    """Pack six-way lightmaps into a flip book: two textures, or a folder that also has a shader.

    A folder has the textures, a shader that plays and lights them, and with --engine files that show it in the engine.
    """
    in_files = bool(output.suffix) and not output.is_dir()
    if in_files:
        check_output(output, *_TEXTURES)
        for option, given in (("engine", engine), ("shader", shader), ("rate", rate)):
            if given is not None:
                raise WlmError(f"--{option} needs a folder as the output, got the file {output}")
        gain = 1.0 if gain is None and output.suffix.lower() == ".exr" else gain
    quiet_warp()
    from wlm.smoke.flipbook.book import mip_padding, pack_book, write_book

    _, read = _source(lightmaps, textures, cells, source_layout, straight, from_gain, device)
    check_positive(gain=gain, rate=rate)
    with running("flipbook") as progress:
        shots = list(read(count, progress))
    padding = 0 if in_files else _PADDING
    if mips is not None:
        padding = mip_padding(*shots[0].six.lightmaps.shape[1:], mips)
    try:
        packed = pack_book(shots, layout, gain=gain, rate=rate, padding=padding)
    except ValueError as error:
        raise WlmError(f"{lightmaps}: {error}") from error
    if in_files:
        contents, clipped = write_book(packed, output)
    else:
        from wlm.export import export
        from wlm.smoke.bundle import bundle as bundle_of

        bundle = bundle_of(packed, name=lightmaps.resolve().stem)
        paths = export(bundle, output, engine, shader=shader or "glsl")
        contents, clipped = {path: packed.channels.get(path.stem, ()) for path in paths}, bundle.document["clipped"]
    _show(str(output), packed, contents, clipped)


def _source(
    lightmaps: Path,
    textures: Sequence[Path] | None,
    cells: str | None,
    layout: str | None,
    straight: bool | None,
    gain: float | None,
    device: str,
) -> "_Source":
    """Opens lightmaps or a flip book. Returns whether it has a single frame, and a function that yields frames."""
    from wlm.interop import check_device
    from wlm.smoke.data import is_foreign, six_way_files, spread
    from wlm.smoke.flipbook.book import Shot, read_shots
    from wlm.smoke.flipbook.reading import read_flipbook

    device = check_device(device)
    notes: list[str] = []
    if not textures and not is_foreign(lightmaps):
        for option, given in (("cells", cells), ("from", layout), ("straight", straight), ("from-gain", gain)):
            if given is not None:
                raise WlmError(f"--{option}: has no meaning without --with, the second texture of a flip book")
        files = {1: lightmaps} if lightmaps.suffix.lower() == ".exr" else six_way_files(lightmaps)
        if not files:
            raise WlmError(
                f"{lightmaps}: expected six-way lightmaps; wlm smoke bake or predict makes them of smoke; a flip book "
                "also needs its second texture by --with"
            )

        def read(count: int | None, progress: "OnProgress") -> "Iterator[Shot]":
            yield from read_shots(files, device, count, progress, notes)
            _say(notes)

        return not lightmaps.is_dir(), read
    rows, cross, columns = (cells or "0x0").partition("x")
    if not (cross and rows.isdecimal() and columns.isdecimal() and int(rows) <= 64 and int(columns) <= 64) or (
        cells and not (int(rows) and int(columns))
    ):
        raise WlmError(f"--cells: expected rows and columns of 1 to 64, such as 8x8, got {cells}")
    check_positive(from_gain=gain)
    size = {"rows": int(rows) or None, "columns": int(columns) or None}
    paths = (lightmaps, *(textures or ()))
    frames = read_flipbook(paths, layout, **size, straight=straight, gain=gain, notes=notes, device=device)
    _say(notes)

    def shots(count: int | None, progress: "OnProgress") -> "Iterable[Shot]":
        return [Shot(n, frames[n - 1]) for n in spread(range(1, len(frames) + 1), count)]

    return len(frames) == 1, shots


def _say(notes: Sequence[str]) -> None:
    for line in dict.fromkeys(line for i, line in enumerate(notes) if not i or "warning: " in line):
        note(line)


def _show(title: str, book: "Book", contents: Mapping[Path, Sequence[str]], clipped: int) -> None:
    rows = table(title, ["file", "bytes", "content"], text=["content"])
    for path, channels in contents.items():
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}", " ".join(channels))
    rows.add_section()
    height, width = book.size
    around = f", padded by {book.padding}" if book.padding else ""
    rows.add_row("frames", f"{book.count:,}", f"{book.rows} x {book.columns} cells of {width} x {height}{around}")
    rows.add_row("gain", f"{book.gain:.4g}", f"{clipped:,} values clipped")
    show(rows)
