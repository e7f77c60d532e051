"""`wlm smoke export`: smoke as a folder for an engine, or a network as ONNX."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from wlm.cli.console import check_output, escape, quiet_warp, show, table
from wlm.cli.options import ShaderLanguage, output_option, shader_of
from wlm.cli.smoke_book import (
    BakeStep,
    BakeSupersample,
    Cells,
    Columns,
    Count,
    From,
    Mips,
    PaddingIfGiven,
    Straight,
    With,
    opened_book,
    packed_book,
    show_book,
)
from wlm.cli.smoke_options import SmokeOptions, with_smoke
from wlm.errors import WlmError

_RESOLUTION = 512  # pixels along the edges of a network's image
_PADDING = 1  # pixels around a frame, which a filter reads beyond its border


def register(app: typer.Typer) -> None:
    """Adds the command to `wlm smoke`."""
    app.command()(export)


@with_smoke
def export(
    output: Annotated[Path, output_option("OUT", "The folder of an engine, or the .onnx of a network.")],
    options: SmokeOptions,
    source: Annotated[
        Path | None,
        typer.Argument(
            metavar="SMOKE|NETWORK",
            help="With --engine what flipbook takes; else a file that train wrote, default the one that wlm has.",
        ),
    ] = None,
    engine: Annotated[
        Literal["raw", "three", "godot", "unity", "unreal"] | None,
        typer.Option(help="Whose folder: raw is textures and a shader for any. Default: a network as ONNX."),
    ] = None,
    shader: ShaderLanguage = None,
    layout: Annotated[str | None, typer.Option(help="Of raw: unity, the default, o3de, o3de-tlrb or embergen.")] = None,
    rate: Annotated[float | None, typer.Option(help="Frames a second; default the scene's, or 25.")] = None,
    columns: Columns = None,
    count: Count = None,
    gain: Annotated[
        float | None, typer.Option(help="Factor on the light; default the greatest without clipping.")
    ] = None,
    textures: With = None,
    cells: Cells = None,
    source_layout: From = None,
    straight: Straight = False,
    padding: PaddingIfGiven = None,
    mips: Mips = None,
    motion: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Frames of simulate --velocity: between frames smoke moves.")
    ] = None,
    step: BakeStep = None,
    supersample: BakeSupersample = None,
) -> None:
    """Write smoke for an engine: a flip book of six-way lightmaps, what plays and lights it, and a page about it.

    Without --engine a network is written as ONNX: encoded guiding maps to encoded lightmaps, of one size, in float32.
    """
    packing = {"columns": columns, "count": count, "gain": gain, "motion": motion, "mips": mips}
    packing |= {"step": step, "supersample": supersample, "rate": rate}
    if engine is None:
        book = {"shader": shader, "layout": layout, "with": textures, "cells": cells, "from": source_layout}
        book |= {"straight": straight or None, "padding": padding}
        given = {name: value for name, value in options.given().items() if name != "resolution"}
        given |= {"device": options.device if options.device != "cpu" else None, "trust": options.trust or None}
        if option := next((name for name, value in (packing | book | given).items() if value is not None), None):
            raise WlmError(f"--{option}: means nothing without --engine, for the ONNX of a network")
        _network(output, source, options.resolution or _RESOLUTION)
        return
    language = shader_of(engine, shader)
    if source is None:
        raise WlmError(f"--engine {engine}: expected smoke, or its lightmaps, to write")
    if layout is not None and engine != "raw":
        raise WlmError(f"--layout: means nothing with --engine {engine}, whose shader reads that of unity")
    if padding is None:
        padding = 0 if mips is not None else _PADDING
    quiet_warp()
    from wlm.export import export as export_kit
    from wlm.smoke.bundle import bundle as bundle_of

    opened = opened_book(source, textures, cells, source_layout, straight)
    packed = packed_book(source, options, opened, **packing, layout=layout or "unity", padding=padding)
    bundle = bundle_of(packed, name=source.resolve().stem)
    paths = export_kit(bundle, output, None if engine == "raw" else engine, shader=language)
    shown = {path.stem: path for path in paths if path.stem in packed.pages}
    show_book(str(output), packed, shown, bundle.document["clipped"])


def _network(output: Path, network: Path | None, resolution: int) -> None:
    check_output(output, ".onnx")
    quiet_warp()
    from wlm.smoke.codec import shipped
    from wlm.smoke.model import SmokeModel
    from wlm.smoke.network import onnx_file
    from wlm.smoke.network.planes import GUIDES, PLANES
    from wlm.system import load

    network = network or shipped()
    model: SmokeModel = load(network, "smoke-network")
    size = onnx_file.export_onnx(model, output, height=resolution, width=resolution)
    rows = table(str(network), ["", "planes"], text=["planes"])
    rows.add_row("guide", " ".join(GUIDES[model.settings.guide]))
    rows.add_row("lightmaps", " ".join(PLANES))
    rows.add_row(escape(str(output)), f"{size:,} bytes, {resolution} x {resolution} pixels")
    show(rows)
