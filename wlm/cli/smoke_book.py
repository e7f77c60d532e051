"""`wlm smoke shade` and `flipbook`: six-way lightmaps as pictures, as textures, and as folders for engines."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from wlm.cli.console import check_output, escape, note_warnings, quiet_warp, running, show, table
from wlm.cli.options import Device, Engine, ShaderLanguage, output_option
from wlm.cli.smoke_options import SHEET, Background, White, check_choice, check_white, outputs, vector, vectors
from wlm.errors import WlmError

if TYPE_CHECKING:
    from wlm.smoke.flipbook.book import Book
    from wlm.smoke.flipbook.shots import BakedFiles, FlipBook, Shot
    from wlm.smoke.shading import Light
    from wlm.system import OnProgress

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
    typer.Option("--with", metavar="TEXTURE", help="Second texture of a flip book; repeat for one of its opacity."),
]
_Cells = Annotated[
    str | None, typer.Option(metavar="ROWSxCOLUMNS", help="Cells of the flip book given by --with, such as 8x8.")
]
_From = Annotated[
    str | None,
    typer.Option(
        "--from",
        metavar="LAYOUT",
        help="Layout of the flip book given by --with: unity (default), o3de, o3de-tlrb or embergen.",
    ),
]
_Straight = Annotated[
    bool, typer.Option("--straight", help="The flip book given by --with has straight (not premultiplied) alpha.")
]


def register(app: typer.Typer) -> None:
    """Adds the commands to `wlm smoke`."""
    app.command()(shade)
    app.command()(flipbook)


def shade(
    lightmaps: _Lightmaps,
    output: Annotated[Path, output_option("OUT", "A .png, or for frames a folder.")],
    light: Annotated[
        list[str] | None,
        typer.Option(metavar="X,Y,Z[:R,G,B]", help="Direction to a light and its irradiance; repeat for more."),
    ] = None,
    background: Background = None,
    white: White = 1.0,
    rule: Annotated[str, typer.Option(help="Weights of the lightmaps: squared, absolute or normalised.")] = "squared",
    textures: _With = None,
    cells: _Cells = None,
    source_layout: _From = None,
    straight: _Straight = False,
    device: Device = "cpu",
) -> None:
    """Light six-way lightmaps into PNGs; a folder of frames also gets the scene's obstacles and a contact sheet.

    Without --light the lights are those of the scene, or one from 1,1,1. The default irradiance, 4 pi, shows a lightmap
    unchanged.
    """
    from wlm.smoke.camera import RULES

    check_choice("--rule", rule, RULES)
    check_white(white)
    lights = [_light(text) for text in light or ()]
    behind = None if background is None else vector("--background", background)
    quiet_warp()
    from wlm.smoke.scene import LightSettings, Looks
    from wlm.view.pictures import contact_sheet, save_png, to_bytes
    from wlm.view.smoke import picture

    source = _source(lightmaps, textures, cells, source_layout, straight, device)
    plain = Looks(lights=[LightSettings(toward=(1, 1, 1))])
    file = outputs(lightmaps, source.single, output, "shade", ".png")
    rows = table(str(lightmaps), ["file", "covered pixels", "mean", "largest", "clipped pixels"])
    pictures = []
    with running("shade") as progress:
        for shot in _shots(source, progress):
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
            clipped = float((shaded > white).any(-1).float().mean())
            figures = (f"{covered:.1%}", f"{shaded.mean():.4g}", f"{shaded.max():.4g}", f"{clipped:.1%}")
            rows.add_row(escape(path.name), *figures)
    if not source.single:
        contact_sheet(output / SHEET, {"": pictures})
    show(rows)


def flipbook(
    lightmaps: _Lightmaps,
    output: Annotated[Path, output_option("OUT", "A folder, or a .png, .tga or .exr: written as OUT_1 and OUT_2.")],
    engine: Engine = None,
    shader: ShaderLanguage = None,
    layout: Annotated[str, typer.Option(help="Channels: unity, o3de, o3de-tlrb or embergen.")] = "unity",
    count: Annotated[int | None, typer.Option(min=1, max=4096, help="Frames, evenly spread; default all.")] = None,
    gain: Annotated[
        float | None,
        typer.Option(help="Factor on the light; default 1 in an .exr, else the greatest without clipping."),
    ] = None,
    rate: Annotated[float | None, typer.Option(help="Frames per second; default the scene's, or 25.")] = None,
    textures: _With = None,
    cells: _Cells = None,
    source_layout: _From = None,
    straight: _Straight = False,
    mips: Annotated[
        int | None,
        typer.Option(
            min=1, max=6, help="Mip levels without neighbouring frames, by padding; default padding: 1, in files 0."
        ),
    ] = None,
    motion: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Frames of simulate --velocity, for a texture of motion.")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="SMOKE", help="The smoke itself, for a texture of depth for point lights.")
    ] = None,
    device: Device = "cpu",
) -> None:
    """Pack six-way lightmaps into a flip book: two textures for an importer, or a folder with shader and kit.

    A folder has the textures, a shader that plays and lights them, and with --engine what puts them together.
    """
    in_files = bool(output.suffix) and not output.is_dir()
    if in_files:
        check_output(output, *_TEXTURES)
        for option, given in (("engine", engine), ("shader", shader)):
            if given is not None:
                raise WlmError(f"--{option}: expected a folder as the output, got {output}")
        gain = 1.0 if gain is None and output.suffix.lower() == ".exr" else gain
    quiet_warp()
    source = _source(lightmaps, textures, cells, source_layout, straight, device)
    for option, given in (("motion", motion), ("depth", depth)):
        if given is not None and textures:
            raise WlmError(f"--{option}: expected lightmaps of bake or predict: the camera of a flip book is unknown")
    packing = {"count": count, "gain": gain, "rate": rate, "mips": mips, "motion": motion, "depth": depth}
    packed = _packed(lightmaps, source, layout, device, **packing, padding=0 if in_files else _PADDING)
    if in_files:
        contents, clipped = _write_textures(packed, output)
    else:
        from wlm.export import export
        from wlm.smoke.bundle import bundle as bundle_of

        bundle = bundle_of(packed, name=lightmaps.resolve().stem)
        paths = export(bundle, output, engine, shader=shader or "glsl")
        contents, clipped = {path: packed.channels.get(path.stem, ()) for path in paths}, bundle.document["clipped"]
    _show(str(output), packed, contents, clipped)


def _light(text: str) -> "Light":
    from wlm.config import check_settings
    from wlm.smoke.scene import LightSettings

    values = dict(zip(("toward", "irradiance"), vectors("--light", text), strict=False))
    return check_settings(LightSettings, values, "--light: ").light()


def _source(
    lightmaps: Path,
    textures: Sequence[Path] | None,
    cells: str | None,
    layout: str | None,
    straight: bool,
    device: str,
) -> "BakedFiles | FlipBook":
    """Opens lightmaps or the flip book that the options describe.

    Raises:
        WlmError: An option has no meaning, or the path is neither.
    """
    from wlm.interop import check_device
    from wlm.smoke.camera import LAYOUTS
    from wlm.smoke.flipbook.shots import FlipBook, baked_files

    device = check_device(device)
    if not textures:
        for option, given in (("cells", cells), ("from", layout), ("straight", straight)):
            if given:
                raise WlmError(f"--{option}: has no meaning without --with, the second texture of a flip book")
        if (baked := baked_files(lightmaps, device)) is None:
            raise WlmError(
                f"{lightmaps}: expected six-way lightmaps: make them of smoke with wlm smoke bake or predict"
            )
        return baked
    if len(textures) > 2:
        raise WlmError(f"--with: expected a second texture and possibly one of opacity, got {len(textures)}")
    layout = "unity" if layout is None else layout
    check_choice("--from", layout, tuple(LAYOUTS))
    rows, cross, columns = (cells or "").partition("x")
    if not (cross and rows.isdecimal() and columns.isdecimal() and 0 < int(rows) <= 64 and 0 < int(columns) <= 64):
        raise WlmError(f"--cells: expected rows and columns of 1 to 64, such as 8x8, got {cells}")
    return FlipBook((lightmaps, *textures), layout, int(rows), int(columns), straight, device)


def _shots(source: "BakedFiles | FlipBook", progress: "OnProgress", count: int | None = None) -> "Iterator[Shot]":
    for shot in source.shots(count, progress):
        note_warnings(shot.warnings)
        yield shot


def _packed(
    lightmaps: Path,
    source: "BakedFiles | FlipBook",
    layout: str,
    device: str,
    *,
    count: int | None,
    gain: float | None,
    rate: float | None,
    mips: int | None,
    motion: Path | None,
    depth: Path | None,
    padding: int,
) -> "Book":
    """Packs frames into a flip book, as the options of the same names say; `padding` is replaced by that for `mips`.

    Raises:
        WlmError: An option or the lightmaps are wrong.
    """
    from wlm.smoke.camera import LAYOUTS
    from wlm.smoke.data import load_frames
    from wlm.smoke.flipbook.book import pack_book
    from wlm.smoke.flipbook.motion import mip_padding, open_motion

    check_choice("--layout", layout, tuple(LAYOUTS))
    for option, number in (("gain", gain), ("rate", rate)):
        if number is not None and not 0 < number < float("inf"):
            raise WlmError(f"--{option}: expected a number above 0, got {number}")
    if depth is not None and not depth.exists():
        raise WlmError(f"{depth}: expected the smoke of the flip book, found none")
    # These inputs are opened before the long work.
    air = None if motion is None else open_motion(motion, device)
    volumes = None if depth is None else load_frames(depth, device=device)
    with running("flipbook") as progress:
        shots = list(_shots(source, progress, count))
    if mips is not None:
        padding = mip_padding(*shots[0].six.lightmaps.shape[1:], mips)
    options: dict[str, Any] = {"gain": gain, "rate": rate, "padding": padding, "air": air, "volumes": volumes}
    try:
        with running("motion and depth") as progress:
            options["progress"] = None if air is None and volumes is None else progress
            return pack_book(shots, layout, **options)
    except ValueError as error:
        raise WlmError(f"{lightmaps}: {error}") from error


def _write_textures(book: "Book", output: Path) -> tuple[dict[Path, Sequence[str]], int]:
    """Writes the textures of a flip book; returns their channels by path and the number of clipped values."""
    from wlm.smoke.flipbook.textures import write_page

    endings = {"first": "1", "second": "2", "motion": "motion", "depth": "depth"}
    paths = {name: output.with_name(f"{output.stem}_{endings[name]}{output.suffix}") for name in book.pages}
    clipped = sum(write_page(path, book.pages[name]) for name, path in paths.items())
    return {path: book.channels[name] for name, path in paths.items()}, clipped


def _show(title: str, book: "Book", contents: Mapping[Path, Sequence[str]], clipped: int) -> None:
    rows = table(title, ["file", "bytes", "content"], text=["content"])
    for path, channels in contents.items():
        rows.add_row(escape(path.name), f"{path.stat().st_size:,}", " ".join(channels))
    rows.add_section()
    height, width = book.size
    around = f", padded by {book.padding}" if book.padding else ""
    rows.add_row("frames", f"{book.count:,}", f"{book.rows} x {book.columns} cells of {width} x {height}{around}")
    rows.add_row("gain", f"{book.gain:.4g}", f"{clipped:,} values clipped")
    if book.scale is not None:
        rows.add_row("largest motion", f"{book.scale:.4g}", "share of a frame, to the next frame")
    if book.reach is not None:
        rows.add_row("largest depth", f"{book.reach:.4g}", "frame heights in front of or behind the billboard")
    show(rows)
