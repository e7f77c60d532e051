"""Flip books: options and sources of the commands that read or pack lightmaps, and `wlm smoke flipbook`."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from wlm.cli.console import check_output, escape, note, quiet_warp, running, show, table
from wlm.cli.options import output_option
from wlm.cli.smoke_options import SmokeOptions, with_smoke
from wlm.errors import WlmError

if TYPE_CHECKING:
    from collections.abc import Iterator

    from wlm.smoke.flipbook.book import Book
    from wlm.smoke.flipbook.shots import BakedFiles, FlipBook, FramesToBake, Shot
    from wlm.system import OnProgress

Baked = Annotated[
    Path,
    typer.Argument(
        metavar="SMOKE",
        help="A .npz, .nvdb or .vdb volume, a folder of frames, what bake wrote, or a flip book's first texture.",
    ),
]
With = Annotated[
    list[Path] | None,
    typer.Option("--with", metavar="TEXTURE", help="A flip book's second texture; again: one of its opacity."),
]
Cells = Annotated[str | None, typer.Option(metavar="ROWSxCOLUMNS", help="Of a flip book, such as 8x8.")]
From = Annotated[
    str | None,
    typer.Option("--from", metavar="LAYOUT", help="Of a flip book: unity, the default, o3de, o3de-tlrb or embergen."),
]
Straight = Annotated[bool, typer.Option("--straight", help="A flip book's light isn't multiplied by its opacity yet.")]
# Baked smoke has both already.
BakeStep = Annotated[
    float | None,
    typer.Option(min=0.01, max=1000.0, help="The longest step in voxels; default 1 to shade, 0.5 for a flipbook."),
]
BakeSupersample = Annotated[int | None, typer.Option(min=1, max=16, help="Rays along a pixel's edge; default 1.")]
Columns = Annotated[int | None, typer.Option(min=1, max=64, help="Of cells; default as square as can be.")]
Count = Annotated[int | None, typer.Option(min=1, max=4096, help="Frames, evenly spread; default all.")]
Mips = Annotated[
    int | None, typer.Option(min=1, max=6, help="Pad such that so many halvings of the textures stay clean.")
]
_PADDING = "Pixels around each cell that repeat its border"
Padding = Annotated[int, typer.Option(min=0, max=64, help=f"{_PADDING}.")]
PaddingIfGiven = Annotated[int | None, typer.Option(min=0, max=64, help=f"{_PADDING}; default 1.")]
_GAIN = "Factor on the light; default 1 in an EXR, else the greatest without clipping."


def register(app: typer.Typer) -> None:
    """Adds the command to `wlm smoke`."""
    app.command()(flipbook)


@with_smoke
def flipbook(
    smoke: Baked,
    output: Annotated[Path, output_option("OUT", "A .exr, .png or .tga: becomes OUT_1 and OUT_2.")],
    options: SmokeOptions,
    layout: Annotated[str, typer.Option(help="unity, o3de, o3de-tlrb or embergen.")] = "unity",
    columns: Columns = None,
    count: Count = None,
    gain: Annotated[float | None, typer.Option(help=_GAIN)] = None,
    textures: With = None,
    cells: Cells = None,
    source_layout: From = None,
    straight: Straight = False,
    padding: Padding = 0,
    mips: Mips = None,
    motion: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Frames of simulate --velocity: write OUT_motion too.")
    ] = None,
    depth: Annotated[
        Path | None, typer.Option(metavar="SMOKE", help="The smoke itself: write OUT_depth too, for point lights.")
    ] = None,
    shader: Annotated[
        bool, typer.Option("--shader", help="Write OUT.glsl, OUT.hlsl, OUT.metal and OUT.wgsl too.")
    ] = False,
    step: BakeStep = None,
    supersample: BakeSupersample = None,
) -> None:
    """Pack six-way lightmaps into the two textures that an engine reads."""
    check_output(output, ".exr", ".png", ".tga")
    if gain is None and output.suffix.lower() == ".exr":
        gain = 1.0
    quiet_warp()
    from wlm.export.shading import ENDINGS, translate
    from wlm.formats.atomic import atomic_write
    from wlm.smoke.flipbook.shader import book_functions
    from wlm.smoke.flipbook.textures import write_page

    book = opened_book(smoke, textures, cells, source_layout, straight)
    packing = {"layout": layout, "columns": columns, "count": count, "gain": gain, "motion": motion, "depth": depth}
    packed = packed_book(
        smoke, options, book, **packing, padding=padding, mips=mips, step=step, supersample=supersample
    )
    paths = {
        name: output.with_name(f"{output.stem}_{ending}{output.suffix}")
        for name, ending in (("first", 1), ("second", 2), ("motion", "motion"), ("depth", "depth"))
        if name in packed.pages
    }
    clipped = sum(write_page(path, packed.pages[name]) for name, path in paths.items())
    if shader:
        for language in ("glsl", "hlsl", "msl", "wgsl"):
            text = translate(book_functions(packed), language)
            atomic_write(output.with_suffix(ENDINGS[language]), text.encode())
    show_book(str(smoke), packed, paths, clipped)


def packed_book(
    smoke: Path,
    options: SmokeOptions,
    book: "FlipBook | None",
    *,
    layout: str,
    columns: int | None,
    count: int | None,
    gain: float | None,
    motion: Path | None,
    padding: int,
    mips: int | None,
    step: float | None,
    supersample: int | None,
    depth: Path | None = None,
    rate: float | None = None,
) -> "Book":
    """Reads or bakes frames, as the options of the same names have it, and packs them.

    Args:
        book: Of `opened_book`.

    Raises:
        WlmError: An option, the smoke or a flip book is wrong.
    """
    from wlm.smoke.camera import LAYOUTS
    from wlm.smoke.flipbook.book import pack_book
    from wlm.smoke.flipbook.motion import mip_padding, open_motion

    if layout not in LAYOUTS:
        raise WlmError(f"--layout: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    for option, number in (("gain", gain), ("rate", rate)):
        if number is not None and not 0 < number < float("inf"):
            raise WlmError(f"--{option}: expected a number above 0, got {number}")
    if mips is not None and padding:
        raise WlmError("--mips: expected without --padding, which it chooses")
    for option, given in (("motion", motion), ("depth", depth)):
        if given is not None and book is not None:
            reason = "expected lightmaps of bake or predict, or frames: a flip book's camera isn't known"
            raise WlmError(f"--{option}: {reason}")
    if depth is not None and not depth.exists():
        raise WlmError(f"{depth}: expected the flip book's smoke, found none")
    source = source_of(smoke, options, step, supersample, 0.5, book)
    # Before what takes long.
    air = None if motion is None else open_motion(motion, options.device)
    volumes = None if depth is None else options.open(depth)
    with running("flipbook") as progress:
        shots = list(shots_of(source, progress, count))
    if mips is not None:
        padding = mip_padding(*shots[0].six.lightmaps.shape[1:], mips)
    values = {"columns": columns, "gain": gain, "padding": padding, "rate": rate}
    try:
        if air is None and volumes is None:
            return pack_book(shots, layout, **values)
        with running("motion and depth") as progress:
            return pack_book(shots, layout, **values, air=air, volumes=volumes, progress=progress)
    except ValueError as error:
        raise WlmError(f"{smoke}: {error}") from error


def show_book(title: str, book: "Book", paths: "dict[str, Path]", clipped: int) -> None:
    """Shows a table of a flip book: its files by the names of its textures, and how to read them."""
    rows = table(title, ["file", "bytes", "channels"], text=["channels"])
    for name, path in paths.items():
        rows.add_row(escape(str(path)), f"{path.stat().st_size:,}", " ".join(book.channels[name]))
    rows.add_section()
    height, width = book.size
    around = f", {book.padding} around each" if book.padding else ""
    rows.add_row("frames", f"{book.count:,}", f"{book.rows} x {book.columns} cells of {width} x {height}{around}")
    rows.add_row("gain", f"{book.gain:.4g}", f"{clipped:,} numbers clipped")
    if book.scale is not None:
        rows.add_row("motion", f"{book.scale:.4g}", "of a frame, at most, to the next")
    if book.reach is not None:
        rows.add_row("depth", f"{book.reach:.4g}", "of a frame's height, at most, before or behind the billboard")
    show(rows)


def opened_book(
    smoke: Path, textures: list[Path] | None, cells: str | None, layout: str | None, straight: bool
) -> "FlipBook | None":
    """The flip book that the options tell; None where they tell none."""
    from wlm.smoke.camera import LAYOUTS
    from wlm.smoke.flipbook.shots import FlipBook

    if not textures:
        for option, given in (("cells", cells), ("from", layout), ("straight", straight)):
            if given:
                raise WlmError(f"--{option}: means nothing without --with, a flip book's second texture")
        return None
    if len(textures) > 2:
        raise WlmError(f"--with: expected a second texture and maybe one of opacity, got {len(textures)}")
    layout = "unity" if layout is None else layout
    if layout not in LAYOUTS:
        raise WlmError(f"--from: expected one of {', '.join(LAYOUTS)}, got {layout!r}")
    rows, cross, columns = (cells or "").partition("x")
    if not (cross and rows.isdecimal() and columns.isdecimal() and 0 < int(rows) <= 64 and 0 < int(columns) <= 64):
        raise WlmError(f"--cells: expected rows and columns of 1 to 64, such as 8x8, got {cells}")
    return FlipBook((smoke, *textures), layout, int(rows), int(columns), straight)


def source_of(
    smoke: Path,
    options: SmokeOptions,
    step: float | None,
    supersample: int | None,
    default_step: float,
    book: "FlipBook | None",
) -> "BakedFiles | FlipBook | FramesToBake":
    """The lightmaps to shade or pack: a flip book's, those of bake or predict, else of smoke that is baked now."""
    from wlm.interop import check_device
    from wlm.smoke.flipbook.shots import FramesToBake, baked_files

    device = check_device(options.device)
    baked = baked_files(smoke, device) if book is None else replace(book, device=device)
    if baked is not None:
        changes = options.given() | {"step": step, "supersample": supersample}
        if option := next((name for name, value in changes.items() if value is not None), None):
            kind = "was baked" if book is None else "is a flip book"
            remedy = "has to be given to bake" if book is None else "means nothing for it"
            raise WlmError(f"{smoke}: {kind}: --{option} {remedy}")
        return baked
    frames = options.open(smoke)
    return FramesToBake(frames, options.camera(frames), step or default_step, supersample or 1)


def shots_of(
    source: "BakedFiles | FlipBook | FramesToBake", progress: "OnProgress", count: int | None = None
) -> "Iterator[Shot]":
    """The source's shots; notes repairs of their volumes."""
    for shot in source.shots(count, progress):
        for warning in shot.warnings:
            note(f"warning: {warning}")
        yield shot
