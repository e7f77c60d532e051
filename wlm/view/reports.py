"""The systems' reports as pages: what `evaluate --html` writes."""

from __future__ import annotations

import os

import numpy as np

from wlm.atlas.data import LightmappedMesh
from wlm.atlas.evaluation import Report as AtlasReport
from wlm.atlas.model import AtlasModel
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.decode import Decoder as LightmapDecoder
from wlm.lightmap.evaluation import Report as LightmapReport
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.tiles import TileGrid
from wlm.metrics.error import psnr_from_mse
from wlm.ops.views import sphere_views
from wlm.probe.data import ProbeSet
from wlm.probe.decode import Decoder as ProbeDecoder
from wlm.probe.evaluation import Report as ProbeReport
from wlm.probe.model import ProbeModel
from wlm.view.atlas import draw, original
from wlm.view.display import Display, white_of
from wlm.view.document import Document

_WORST_TILES, _WORST_PROBES = 3, 10
_GAIN = 8.0  # of errors in pictures
_SIDE = 300  # of a picture, in the page's pixels


def lightmap_report(
    path: str | os.PathLike[str], model: LightmapModel, lightmaps: LightmapSet, report: LightmapReport
) -> int:
    """Writes a lightmap report: the summary, scores by hour and by tile, and the worst tiles at their worst hours.

    Args:
        path: The page, `.html`; its folder must exist.
        model, lightmaps, report: As they were given to `wlm.lightmap.evaluate` and came from it.

    Returns:
        The page's bytes.

    Raises:
        WlmError: The file can't be written.
    """
    page = Document(f"{model.name}: {report.profile}")
    for warning in report.warnings:
        page.text(warning, warning=True)
    kinds = ", ".join(f"{count} {kind}" for kind, count in report.kinds.items() if count)
    rows = [
        ("PSNR", _number(report.psnr, ".2f", "dB")),
        ("worst tile and hour", _number(report.worst_psnr, ".2f", "dB")),
        ("SSIM", _number(report.ssim, ".4f")),
        ("FLIP", _number(report.flip, ".4f")),
        ("file", f"{report.bytes:,} bytes"),
        ("bits per texel and time", _number(report.bpp, ".3f")),
        ("tiles", kinds),
    ]
    page.table("", ("", ""), rows)
    by_time = {"texels": report.psnr_by_time}
    if np.isfinite(report.seen_by_time).any():
        page.table("As it is seen", ("", "", "worst"), _seen_rows(report))
        by_time["seen"] = report.seen_by_time
    page.lines("PSNR by hour, mean of the tiles", "dB", report.time_values, by_time)
    if np.isfinite(report.flip_by_time).any():
        page.lines("FLIP by hour, mean of the tiles", "FLIP", report.time_values, {"FLIP": report.flip_by_time})
    if np.isfinite(report.psnr_by_tile).any():
        page.grid("PSNR by tile, mean of the hours", "dB", report.psnr_by_tile)
        _worst_tiles(page, model, lightmaps, report)
    page.table("Bytes of the file", ("part", "bytes"), [(name, f"{size:,}") for name, size in report.parts.items()])
    return page.write(path)


def _seen_rows(report: LightmapReport) -> list[tuple[str, str, str]]:
    def place(worst: dict[str, float | int] | None) -> str:
        if worst is None:
            return ""
        where = f"camera {worst['view']}" if "view" in worst else f"tile {worst['tile']}"
        return f"{worst['psnr']:.2f} dB, {where} at {worst['time']:g}"

    views = f"{_number(report.view_psnr, '.2f', 'dB')}, FLIP {_number(report.view_flip, '.4f')}"
    rows = [
        ("seen: filtered at random points", _number(report.seen, ".2f", "dB"), place(report.worst_seen)),
        ("ring: gaps beside charts", _number(report.ring, ".2f", "dB"), ""),
        ("between stored times", _number(report.between, ".2f", "dB"), place(report.worst_between)),
        ("error across tiles / within", _number(report.border, ".2f"), ""),
        ("flicker, of the range in 3 minutes", _number(100 * report.flicker, ".3f", "%"), ""),
        (f"{report.views} views", views, place(report.worst_view)),
    ]
    return [row for row in rows if not row[1].startswith("–")]


def _worst_tiles(page: Document, model: LightmapModel, lightmaps: LightmapSet, report: LightmapReport) -> None:
    decoder, grid = LightmapDecoder(model, report.device), TileGrid.of(model.height, model.width)
    scores = report.psnr_by_tile.ravel()
    for number in np.argsort(np.where(np.isfinite(scores), scores, np.inf))[:_WORST_TILES].tolist():
        if not np.isfinite(scores[number]):
            continue
        row, column = grid.origin(number)
        window = slice(row, min(row + TILE, model.height)), slice(column, min(column + TILE, model.width))
        mask = lightmaps.mask[window]
        found = []
        for i, time in enumerate(model.times):
            then = lightmaps.frames[i][window]
            now = decoder.tile(number, time)[: mask.shape[0], : mask.shape[1]]
            valid = then[mask].astype(np.float64)
            mse = np.square(valid - now[mask]).mean()
            span = valid.max() - valid.min()
            found.append((psnr_from_mse(mse, span) if span > 0 else np.inf, i, then, now))
        least, i, then, now = min(found, key=lambda each: each[0])
        display = Display(1.0 / white_of(then[mask]))
        pictures = {
            "original": display.picture(then),
            "decoded": display.picture(now * mask[..., None]),
            f"error × {_GAIN:g}": display.picture(np.abs(then - now) * mask[..., None] * _GAIN),
        }
        heading = f"Tile {number}, mean {scores[number]:.2f} dB; worst at {model.times[i]:g}: {least:.2f} dB"
        page.pictures(heading, pictures, _SIDE)


def atlas_report(
    path: str | os.PathLike[str], model: AtlasModel, mesh: LightmappedMesh, report: AtlasReport, views: int
) -> int:
    """Writes an atlas report: the summary, the worst view, and the lightmap's errors.

    Args:
        path: The page, `.html`; its folder must exist.
        model, mesh, report: As they were given to `wlm.atlas.evaluate` and came from it.
        views: The cameras that were asked for.

    Returns:
        The page's bytes.

    Raises:
        WlmError: The file can't be written.
    """
    page = Document(f"{model.name}: {model.profile.name}")
    for warning in mesh.warnings:
        page.text(warning, warning=True)
    if not report.views:
        page.text("No camera outside the mesh sees its front: the scores of views are missing.", warning=True)
    rows = [
        ("PSNR in views", _number(report.psnr, ".2f", "dB")),
        ("PSNR of the worst view", _number(report.psnr_worst, ".2f", "dB")),
        ("1 - SSIM", _number(report.one_minus_ssim, ".5f")),
        ("error at seams / elsewhere", _number(report.seam_ratio, ".2f")),
        ("PSNR of texels", _number(report.texel_psnr, ".2f", "dB")),
        ("saved (eq. 9)", _number(100 * report.cr, ".2f", "%")),
        ("saved on disk", _number(100 * report.cr_disk, ".2f", "%")),
        ("views that see the mesh", f"{report.views}"),
    ]
    page.table("", ("", ""), rows)
    decoder = model.decoder()
    if report.worst_view >= 0:
        view = sphere_views(views)[report.worst_view]
        drawn, hit = draw(mesh, {"original": original(mesh), "decoded": decoder}, view)
        display = Display(1.0 / white_of(drawn["original"][hit]))
        error = np.abs(drawn["original"] - drawn["decoded"])
        pictures = {name: display.picture(light) for name, light in drawn.items()}
        pictures[f"error × {_GAIN:g}"] = display.picture(error * _GAIN)
        page.pictures(f"The worst view, camera {report.worst_view}", pictures, _SIDE)
    lightmap = decoder.lightmap(mesh)
    then, mask = mesh.lightmap * mesh.mask[..., None], mesh.mask[..., None]
    display = Display(1.0 / white_of(mesh.lightmap[mesh.mask]))
    pictures = {
        "original": display.picture(then),
        "decoded": display.picture(lightmap * mask),
        f"error × {_GAIN:g}": display.picture(np.abs(then - lightmap * mask) * _GAIN),
    }
    page.pictures("The lightmap", pictures, _SIDE)
    return page.write(path)


def probe_report(path: str | os.PathLike[str], model: ProbeModel, probes: ProbeSet, report: ProbeReport) -> int:
    """Writes a probe report: the summary, errors by band and by probe, and the worst probes.

    Args:
        path: The page, `.html`; its folder must exist.
        model, probes, report: As they were given to `wlm.probe.evaluate` and came from it.

    Returns:
        The page's bytes.

    Raises:
        WlmError: The file can't be written.
    """
    page = Document(f"{report.name}: {model.profile.name}")
    for warning in probes.warnings:
        page.text(warning, warning=True)
    rows = [
        ("PSNR of coefficients", _number(report.psnr, ".2f", "dB")),
        ("PSNR of the live probes", _number(report.psnr_live, ".2f", "dB")),
        ("PSNR of irradiance", _number(report.irradiance_psnr, ".2f", "dB")),
        ("largest error", _number(report.max_abs_error, ".4g")),
        ("file", f"{report.bytes:,} bytes"),
        ("of float32", _number(100 * report.ratio, ".2f", "%")),
        ("probes", f"{report.probes:,}, {report.live:,} live"),
    ]
    page.table("", ("", ""), rows)
    if report.psnr_by_band is not None:
        bands = np.asarray(report.psnr_by_band, np.float64)
        page.table("PSNR by band", ("band", "dB"), [(str(i), _number(value, ".2f")) for i, value in enumerate(bands)])
    decoded = ProbeDecoder(model).decode_probes(probes.position)
    mse = np.square(probes.values.astype(np.float64) - decoded).mean(1)
    live = ~model.dead
    with np.errstate(divide="ignore"):
        psnr = 10.0 * np.log10(report.peak**2 / mse)
    page.histogram("PSNR of the probes", "dB", psnr[live])
    worst = np.flatnonzero(live)[np.argsort(mse[live])[::-1][:_WORST_PROBES]]
    rows = [(str(i), _number(psnr[i], ".2f"), *(f"{x:.4g}" for x in probes.position[i])) for i in worst]
    page.table("The worst probes", ("probe", "dB", "x", "y", "z"), rows)
    return page.write(path)


def _number(value: float | None, form: str, unit: str = "") -> str:
    if value is None or value != value:
        return "–"
    return f"{value:{form}} {unit}".rstrip()
