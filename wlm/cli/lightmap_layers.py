"""Tables and files of `wlm lightmap` for sets with layers."""

from pathlib import Path
from typing import TYPE_CHECKING

from wlm.cli.console import escape, note, number, show, show_json, table
from wlm.errors import WlmError

if TYPE_CHECKING:
    import numpy as np

    from wlm.lightmap import LayeredModel, LayeredReport, LayeredSet, LightmapModel
    from wlm.lightmap.layers.decode import Decoder


def refuse_layers(**options: object) -> None:
    """Refuses options that mean a single lightmap.

    Raises:
        WlmError: One of them is given.
    """
    for name, value in options.items():
        if value is not None:
            raise WlmError(f"--{name}: expected a set of one lightmap a time, found one with layers")


def show_layered(
    output: Path, model: "LayeredModel", lightmaps: "LayeredSet", size: int, seconds: float, device: str
) -> None:
    """Shows what a fit wrote, and what it warns of."""
    from wlm.lightmap.evaluation import lost_light
    from wlm.lightmap.layers.codec import sheet_bytes

    rows = table(model.name, ["file", "bytes", "bpp", "sheet", "tiles"], text=["sheet", "tiles"])
    rows.add_row(escape(str(output)), f"{size:,}", f"{_bpp(model, size):.3f}", f"all, {seconds:.1f} s", "")
    for sheet, count in sheet_bytes(model).items():
        own = model.sheets[sheet]
        bpp = 8 * count / (own.width * own.height * len(own.times))
        rows.add_row("", f"{count:,}", f"{bpp:.3f}", escape(sheet.label), _kinds(own))
    show(rows)
    light = [sheet for sheet, own in model.sheets.items() if not sheet.linear and own.kind.any()]
    lost = [line for sheet in light for line in lost_light(model.sheets[sheet], lightmaps.sheets[sheet], device)]
    for warning in (*model.warnings, *lost):
        note(f"warning: {warning}")


def show_layered_report(file: Path, report: "LayeredReport") -> None:
    """Shows the scores of each sheet."""
    scores = {
        "PSNR dB": ("psnr", ".2f"),
        "SSIM": ("ssim", ".4f"),
        "FLIP": ("flip", ".4f"),
        "seen dB": ("seen", ".2f"),
        "ring dB": ("ring", ".2f"),
        "between dB": ("between", ".2f"),
        "border ×": ("border", ".2f"),
        "largest error": ("max_abs_error", ".3g"),
    }
    rows = table(str(file), ["", *scores, "bytes", "bpp"])
    for sheet, own in report.sheets.items():
        cells = [number(getattr(own, name), form) for name, form in scores.values()]
        rows.add_row(escape(f"{sheet.label}, {sheet.encoding}"), *cells, f"{own.bytes:,}", f"{own.bpp:.3f}")
    rows.add_section()
    blank = [""] * (len(scores) - 1)
    for layer, psnr in report.psnr_by_layer.items():
        rows.add_row(escape(f"layer {layer}"), number(psnr, ".2f"), *blank, "", "")
    rows.add_row("all", "", *blank, f"{report.bytes:,}", f"{report.bpp:.3f}")
    show(rows)
    note("PSNR of radiance is relative to the range of each tile at each time, of unit and signed to their own range")
    for warning in report.warnings:
        note(f"warning: {warning}")


def show_layered_info(file: Path, model: "LayeredModel", decoder: "Decoder", as_json: bool) -> None:
    """Says what a file holds."""
    from wlm.lightmap.evaluation import count_kinds
    from wlm.lightmap.layers.codec import sheet_bytes

    size, sizes = file.stat().st_size, sheet_bytes(model)
    if as_json:
        sheets = [
            vars(sheet)
            | {
                "width": own.width,
                "height": own.height,
                "bytes": sizes[sheet],
                "tiles": count_kinds(own),
                "profile": own.profile.model_dump(mode="json"),
            }
            for sheet, own in model.sheets.items()
        ]
        facts = {"name": model.name, "bytes": size, "times": model.times.tolist(), "period": model.period}
        facts |= {"source": model.source, "device": decoder.device, "device_bytes": decoder.device_bytes}
        show_json(facts | {"sheets": sheets})
        return
    rows = table(str(file), ["", "value"])
    times = model.times
    for name, value in {
        "name": escape(model.name),
        "bytes": f"{size:,}",
        "times": f"{len(times)}, {times[0]:g} to {times[-1]:g}",
        "period": number(model.period, "g"),
        "source": escape(model.source),
        "profile": escape(next(iter(model.sheets.values())).profile.name),
        f"bytes on {decoder.device}": f"{decoder.device_bytes:,}",
    }.items():
        rows.add_row(name, value)
    show(rows)
    rows = table("sheets", ["", "encoding", "size", "bytes", "tiles"], text=["encoding", "tiles"])
    for sheet, own in model.sheets.items():
        cells = (sheet.encoding, f"{own.width}x{own.height}", f"{sizes[sheet]:,}", _kinds(own))
        rows.add_row(escape(sheet.label), *cells)
    show(rows)


def write_layer(
    decoder: "Decoder", time: float, layer: str | None, atlas: str | None, output: Path, eight_bit: Path | None
) -> "np.ndarray":
    """Decodes a layer of an atlas and writes it as an EXR with its channels' names, and as 8 bits; gives the values.

    Raises:
        WlmError: There is no such layer, or it has more than three channels and shall be 8 bits.
    """
    import numpy as np

    from wlm.formats.channels import read_channels
    from wlm.formats.exr import HALF_MAX, write_part
    from wlm.lightmap.exporter import write_8bit
    from wlm.lightmap.layers.sheet import ENCODINGS

    sheets = decoder.model.layer(layer, atlas)
    if eight_bit is not None and len(sheets) > 1:
        raise WlmError(f"--eight-bit: expected a layer of at most three channels, found {sheets[0].layer} of more")
    names = [name for sheet in sheets for name in sheet.channels]
    frame = decoder.layer(time, sheets[0].layer, sheets[0].atlas)
    planes = np.moveaxis(np.clip(frame, -HALF_MAX, HALF_MAX).astype(np.float16), 2, 0)
    write_part(
        output, {name: np.ascontiguousarray(plane) for name, plane in zip(names, planes, strict=True)}, read_channels
    )
    note(f"layer {sheets[0].layer} of atlas {sheets[0].atlas}, {sheets[0].encoding}: {', '.join(names)}")
    if eight_bit is not None:
        values = ENCODINGS[sheets[0].encoding] if sheets[0].linear else None
        write_8bit(eight_bit, decoder.sheets[sheets[0]], time, values)
    return frame


def _bpp(model: "LayeredModel", size: int) -> float:
    """Bits per texel of the atlases and time, all layers together."""
    return 8 * size / (sum(height * width for height, width in model.atlases.values()) * len(model.times))


def _kinds(model: "LightmapModel") -> str:
    from wlm.lightmap.evaluation import count_kinds

    return ", ".join(f"{count} {kind}" for kind, count in count_kinds(model).items() if count)
