"""Tables of `wlm lightmap`: the scores of a set."""

import math
from pathlib import Path
from typing import TYPE_CHECKING

from wlm.cli.console import escape, note, number, show, table

if TYPE_CHECKING:
    from wlm.lightmap import Report
    from wlm.lightmap.held import HeldTile
    from wlm.metrics.contest import ContestScore


def show_report(file: Path, report: "Report") -> None:
    """Shows the scores of a set and what their means hide."""
    rows = table(str(file), ["", "PSNR dB", "SSIM", "FLIP", "bytes", "bpp"])

    def add(name: str, psnr: float, ssim: float, flip: float, *sizes: str) -> None:
        rows.add_row(name, number(psnr, ".2f"), number(ssim, ".4f"), number(flip, ".4f"), *sizes)

    own = f"wlm {escape(report.profile)}"
    add(own, report.psnr, report.ssim, report.flip, f"{report.bytes:,}", f"{report.bpp:.3f}")
    rows.add_section()
    scores = (report.psnr_by_time, report.ssim_by_time, report.flip_by_time)
    for stamp, *values in zip(report.time_values, *scores, strict=True):
        add(f"time {stamp:g}", *values)
    rows.add_section()
    grids = (report.psnr_by_tile, report.ssim_by_tile, report.flip_by_tile)
    for tile, values in enumerate(zip(*(grid.ravel() for grid in grids), strict=True)):
        # Tiles that are empty or not in the file have no score.
        if any(value == value for value in values):
            add(f"tile {tile}", *values)
    show(rows)
    _show_seen(own, report)
    if report.worst_tile is not None:
        worst = report.worst_tile
        note(f"worst: {report.worst_psnr:.2f} dB, tile {worst['tile']} at {worst['time']:g}")
    for what, worst in (("seen", report.worst_seen), ("between times", report.worst_between)):
        if worst is not None:
            note(f"worst {what}: {worst['psnr']:.2f} dB, tile {worst['tile']} at {worst['time']:g}")
    if report.worst_seen_time is not None:
        worst = report.worst_seen_time
        note(f"worst time, mean of its tiles seen: {worst['psnr']:.2f} dB at {worst['time']:g}")
    if report.worst_seen_tile is not None:
        worst = report.worst_seen_tile
        note(f"worst tile, mean of its times seen: {worst['psnr']:.2f} dB, tile {worst['tile']}")
    if report.worst_view is not None:
        worst = report.worst_view
        note(
            f"worst view: {worst['psnr']:.2f} dB, FLIP {worst['flip']:.4f}, camera {worst['view']} at {worst['time']:g}"
        )
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


def _show_seen(own: str, report: "Report") -> None:
    """Shows the scores of `wlm.lightmap.seen`; columns without any number are left out."""
    columns = {
        "texels dB": ("psnr", ".2f", 1.0),
        "seen dB": ("seen", ".2f", 1.0),
        "ring dB": ("ring", ".2f", 1.0),
        "between dB": ("between", ".2f", 1.0),
        "border ×": ("border", ".2f", 1.0),
        "flicker %": ("flicker", ".3f", 100.0),
        "views dB": ("view_psnr", ".2f", 1.0),
        "views FLIP": ("view_flip", ".4f", 1.0),
    }
    found = {
        title: number(scale * getattr(report, name), form)
        for title, (name, form, scale) in columns.items()
        if math.isfinite(getattr(report, name))
    }
    if len(found) > 1:
        rows = table("as it is seen", ["", *found])
        rows.add_row(own, *found.values())
        show(rows)


def show_contest(score: "ContestScore") -> None:
    """Shows the score of a contest, with what gives points and what doesn't."""
    from wlm.metrics.contest import BOUNDS, WEIGHTS

    rows = table("hprc", ["", "value", "no points", "all points", "points", "of"])
    for name, (worst, best) in BOUNDS.items():
        value = number(getattr(score, name), ".4f")
        rows.add_row(name, value, f"{worst:g}", f"{best:g}", number(score.points[name], ".2f"), f"{WEIGHTS[name]:g}")
    rows.add_section()
    rows.add_row("together", "", "", "", f"{score.total:.2f}", f"{score.most:g}")
    show(rows)
    each = 1000.0 * score.seconds / score.times
    note(f"hprc: decoded in {score.seconds:.4f} s on {score.device}, {each:.3f} ms a lightmap; its bounds are unknown")
    note("hprc: without points of 100: decode time (30), LPIPS (10), which needs a trained network")


def show_tiles(tiles: "list[HeldTile]") -> None:
    """Shows what each tile of a file got."""
    rows = table("tiles", ["tile", "row", "column", "kind", "valid texels", "bytes", "why"], ("kind", "why"))
    for tile in tiles:
        place = (f"{tile.number}", f"{tile.row}", f"{tile.column}")
        rows.add_row(*place, tile.kind, f"{tile.valid:,}", f"{tile.bytes:,}", tile.why)
    show(rows)
