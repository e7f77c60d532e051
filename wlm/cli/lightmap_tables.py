"""Tables of `wlm lightmap`: the scores of a set."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from wlm.cli.console import escape, note, number, show, table

if TYPE_CHECKING:
    from wlm.lightmap import LightmapModel, Report
    from wlm.lightmap.evaluation import SheetReport
    from wlm.lightmap.tile_report import TileReport

_SCORES = {
    "PSNR dB": ("psnr", ".2f", 1.0),
    "SSIM": ("ssim", ".4f", 1.0),
    "FLIP": ("flip", ".4f", 1.0),
    "seen dB": ("seen", ".2f", 1.0),
    "ring dB": ("ring", ".2f", 1.0),
    "between dB": ("between", ".2f", 1.0),
    "border ×": ("border", ".2f", 1.0),
    "flicker %": ("flicker", ".3f", 100.0),
    "views dB": ("view_psnr", ".2f", 1.0),
    "views FLIP": ("view_flip", ".4f", 1.0),
    "largest error": ("max_abs_error", ".3g", 1.0),
}


def kinds_of(model: "LightmapModel") -> str:
    """Returns the number of tiles of each kind, over all sheets, in words."""
    from wlm.lightmap.evaluation import count_kinds

    counts: dict[str, int] = {}
    for own in model.sheets.values():
        for kind, count in count_kinds(own).items():
            counts[kind] = counts.get(kind, 0) + count
    return ", ".join(f"{count} {kind}" for kind, count in counts.items() if count)


def show_report(file: Path, report: "Report") -> None:
    """Shows the scores of each sheet, the mean, and the places of the worst ones."""
    reports = report.sheets.values()
    named = {
        title: score
        for title, score in _SCORES.items()
        if any(math.isfinite(getattr(own, score[0])) for own in reports)
    }
    rows = table(str(file), ["", *named, "bytes", "bpp", "bpp in memory"])
    for sheet, own in report.sheets.items():
        cells = [number(scale * getattr(own, name), form) for name, form, scale in named.values()]
        label = escape(f"{sheet.label}, {sheet.encoding}")
        rows.add_row(label, *cells, f"{own.bytes:,}", f"{own.bpp:.3f}", f"{own.memory_bpp:.3f}")
    rows.add_section()
    mean = [number(scale * getattr(report, name, math.nan), form) for name, form, scale in named.values()]
    total = f"{report.bytes:,}", f"{report.bpp:.3f}", f"{report.memory_bpp:.3f}"
    rows.add_row(f"profile {escape(report.profile)}", *mean, *total)
    show(rows)
    if len(reports) == 1:
        _show_light(file, report)
    for warning in report.warnings:
        note(f"warning: {warning}")


def _show_light(file: Path, report: "Report") -> None:
    """Shows the scores by time and by tile of a set with one sheet."""
    own = report.light
    rows = table(str(file), ["", "PSNR dB", "SSIM", "FLIP"])

    def add(name: str, psnr: float, ssim: float, flip: float) -> None:
        rows.add_row(name, number(psnr, ".2f"), number(ssim, ".4f"), number(flip, ".4f"))

    for stamp, *values in zip(report.times, own.psnr_by_time, own.ssim_by_time, own.flip_by_time, strict=True):
        add(f"time {stamp:g}", *values)
    rows.add_section()
    grids = (own.psnr_by_tile, own.ssim_by_tile, own.flip_by_tile)
    for tile, values in enumerate(zip(*(grid.ravel() for grid in grids), strict=True)):
        # Tiles that are empty or not in the file have no score.
        if any(value == value for value in values):
            add(f"tile {tile}", *values)
    show(rows)
    _note_worst(own)


def _note_worst(own: "SheetReport") -> None:
    if own.worst_tile is not None:
        worst = own.worst_tile
        note(f"worst: {own.worst_psnr:.2f} dB, tile {worst['tile']} at {worst['time']:g}")
    for what, worst in (("seen", own.worst_seen), ("between times", own.worst_between)):
        if worst is not None:
            note(f"worst {what}: {worst['psnr']:.2f} dB, tile {worst['tile']} at {worst['time']:g}")
    if own.worst_view is not None:
        worst = own.worst_view
        note(
            f"worst view: {worst['psnr']:.2f} dB, FLIP {worst['flip']:.4f}, camera {worst['view']} at {worst['time']:g}"
        )
    left_out = ", ".join(f"{count} {reason}" for reason, count in own.not_scored.items() if count)
    if left_out:
        note(f"without a score, tiles times times: {left_out}")
    if own.format_limited:
        note(
            f"{len(own.format_limited)} scored ones span only a few steps of half float; without them PSNR is "
            f"{number(own.psnr_unlimited, '.2f')} dB"
        )


def show_tiles(tiles: "list[TileReport]") -> None:
    """Shows the encoding of each tile of a sheet."""
    rows = table("tiles", ["tile", "row", "column", "kind", "valid texels", "bytes", "why"], ("kind", "why"))
    for tile in tiles:
        place = (f"{tile.number}", f"{tile.row}", f"{tile.column}")
        rows.add_row(*place, tile.kind, f"{tile.valid:,}", f"{tile.bytes:,}", tile.why)
    show(rows)
