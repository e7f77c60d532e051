"""HTML reports of the systems' evaluations, which `evaluate --html` writes."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.evaluation import Report as AtlasReport
from wlm.atlas.evaluation import original
from wlm.atlas.model import AtlasModel
from wlm.atlas.views import scene_views
from wlm.lightmap.data import LightmapSet, SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.evaluation import Report as LightmapReport
from wlm.lightmap.evaluation import SheetReport
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.metrics.error import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.evaluation import Report as ProbeReport
from wlm.probe.model import ProbeModel
from wlm.smoke.camera import Camera
from wlm.smoke.evaluation import NETWORK, REFERENCE, Comparison, Example
from wlm.smoke.model import SmokeModel, parameter_count
from wlm.smoke.network.planes import EMISSION_PLANE, PLANES, decode_lightmaps
from wlm.smoke.shading import Light
from wlm.view.atlas import draw
from wlm.view.display import Display, white_of
from wlm.view.document import Document

_WORST_TILES, _WORST_PROBES = 3, 10
_GAIN = 8.0  # factor on errors in pictures
_SIDE, _SMALL_SIDE = 300, 220  # widths of pictures in CSS pixels, for three or four in a row
_LIT_FROM = (1.0, 1.0, 1.0)  # direction to the light of smoke, in the camera's axes
_BEHIND = (0.1, 0.12, 0.15)  # background of smoke


def lightmap_report(
    path: str | os.PathLike[str], model: LightmapModel, lightmaps: LightmapSet, report: LightmapReport
) -> int:
    """Writes a lightmap report: the summary, scores by hour and by tile, and the worst tiles at their worst hours.

    Args:
        path: The page, `.html`; its folder must exist.
        model, lightmaps, report: As they were given to `wlm.lightmap.evaluate` and came from it.

    Returns:
        Size of the page in bytes.

    Raises:
        WlmError: The file cannot be written.
    """
    light = report.light
    kinds = ", ".join(f"{count} {kind}" for kind, count in light.kinds.items() if count)
    rows = [
        ("PSNR", _number(report.psnr, ".2f", "dB")),
        ("worst tile and hour", _number(light.worst_psnr, ".2f", "dB")),
        ("SSIM", _number(report.ssim, ".4f")),
        ("FLIP", _number(report.flip, ".4f")),
        ("file", f"{report.bytes:,} bytes"),
        ("bits per texel and time", _number(report.bpp, ".3f")),
        ("tiles", kinds),
    ]
    page = _begin(model.name, report.profile, report.warnings, rows)
    by_time = {"texels": light.psnr_by_time}
    if np.isfinite(light.seen_by_time).any():
        page.table("Scores as rendered", ("", "", "worst"), _seen_rows(light))
        by_time["seen"] = light.seen_by_time
    page.lines("PSNR by hour, mean of the tiles", "dB", report.times, by_time)
    if np.isfinite(light.flip_by_time).any():
        page.lines("FLIP by hour, mean of the tiles", "FLIP", report.times, {"FLIP": light.flip_by_time})
    if np.isfinite(light.psnr_by_tile).any():
        page.grid("PSNR by tile, mean of the hours", "dB", light.psnr_by_tile)
        _worst_tiles(page, model.light, lightmaps.light, light, report.device)
    page.table("Bytes of the file", ("part", "bytes"), [(name, f"{size:,}") for name, size in report.parts.items()])
    return page.write(path)


def _seen_rows(report: SheetReport) -> list[tuple[str, str, str]]:
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


def _worst_tiles(page: Document, model: SheetModel, lightmaps: SheetFrames, report: SheetReport, device: str) -> None:
    decoder = SheetDecoder(model, device)
    scores = report.psnr_by_tile.ravel()
    for number in np.argsort(np.where(np.isfinite(scores), scores, np.inf))[:_WORST_TILES].tolist():
        if not np.isfinite(scores[number]):
            continue
        window = model.grid.window(number)
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
        heading = f"Tile {number}, mean {scores[number]:.2f} dB; worst at {model.times[i]:g}: {least:.2f} dB"
        _beside(page, heading, "original", then, {"decoded": now}, mask)


def atlas_report(
    path: str | os.PathLike[str], model: AtlasModel, scene: LightmappedScene, report: AtlasReport, views: int
) -> int:
    """Writes an atlas report: the summary, the worst view, and the lightmap's errors.

    Args:
        path: The page, `.html`; its folder must exist.
        model, scene, report: As they were given to `wlm.atlas.evaluate` and came from it.
        views: The cameras that were asked for.

    Returns:
        Size of the page in bytes.

    Raises:
        WlmError: The file cannot be written.
    """
    unseen = "No camera around the mesh and no viewer inside sees it: the scores of views are missing."
    rows = [
        ("PSNR in views", _number(report.psnr, ".2f", "dB")),
        ("PSNR in views from around it", _number(report.around_psnr, ".2f", "dB")),
        ("PSNR in views from inside", _number(report.inside_psnr, ".2f", "dB")),
        ("peak of PSNR", _number(report.peak, ".4g")),
        ("PSNR of the worst view", _number(report.psnr_worst, ".2f", "dB")),
        ("1 - SSIM", _number(report.one_minus_ssim, ".5f")),
        ("error at seams / elsewhere", _number(report.seam_ratio, ".2f")),
        ("PSNR of texels", _number(report.texel_psnr, ".2f", "dB")),
        ("PSNR in views, tone mapped", _number(report.tone_psnr, ".2f", "dB")),
        ("FLIP", _number(report.flip, ".4f")),
        ("saved (eq. 9)", _number(100 * report.cr, ".2f", "%")),
        ("views that see the mesh", f"{report.views}"),
    ]
    warnings = [*scene.warnings, *([] if report.views else [unseen])]
    page = _begin(model.name, model.profile.name, warnings, rows)
    decoder = model.decoder()
    if report.worst_view >= 0:
        view = scene_views(scene, views)[report.worst_view]
        drawn, hit = draw(scene, {"original": original(scene), "decoded": decoder}, view)
        then = drawn.pop("original")
        _beside(page, f"The worst view, camera {report.worst_view}", "original", then, drawn, hit)
    sheet = scene.sheets[0]
    _beside(page, "The lightmap", "original", sheet.lightmap, {"decoded": decoder.lightmap()}, sheet.mask)
    return page.write(path)


def probe_report(path: str | os.PathLike[str], model: ProbeModel, probes: ProbeSet, report: ProbeReport) -> int:
    """Writes a probe report: the summary, errors by band and by probe, and the worst probes.

    Args:
        path: The page, `.html`; its folder must exist.
        model, probes, report: As they were given to `wlm.probe.evaluate` and came from it.

    Returns:
        Size of the page in bytes.

    Raises:
        WlmError: The file cannot be written.
    """
    rows = [
        ("PSNR of coefficients", _number(report.psnr, ".2f", "dB")),
        ("PSNR of the live probes", _number(report.psnr_live, ".2f", "dB")),
        ("PSNR of irradiance", _number(report.irradiance_psnr, ".2f", "dB")),
        ("largest error", _number(report.max_abs_error, ".4g")),
        ("file", f"{report.bytes:,} bytes"),
        ("of float32", _number(100 * report.ratio, ".2f", "%")),
        ("probes", f"{report.probes:,}, {report.live:,} live"),
    ]
    page = _begin(report.name, model.profile.name, probes.warnings, rows)
    if report.psnr_by_band is not None:
        bands = np.asarray(report.psnr_by_band, np.float64)
        page.table("PSNR by band", ("band", "dB"), [(str(i), _number(value, ".2f")) for i, value in enumerate(bands)])
    decoded = model.decoder().decode_probes(probes.position)
    mse = np.square(probes.values.astype(np.float64) - decoded).mean(1)
    live = probes.live
    with np.errstate(divide="ignore"):
        psnr = 10.0 * np.log10(report.peak**2 / mse)
    page.histogram("PSNR of the probes", "dB", psnr[live])
    worst = np.flatnonzero(live)[np.argsort(mse[live])[::-1][:_WORST_PROBES]]
    rows = [(str(i), _number(psnr[i], ".2f"), *(f"{x:.4g}" for x in probes.position[i])) for i in worst]
    page.table("The worst probes", ("probe", "dB", "x", "y", "z"), rows)
    return page.write(path)


def smoke_report(path: str | os.PathLike[str], name: str, model: SmokeModel, comparisons: Sequence[Comparison]) -> int:
    """Writes a smoke report: scores of the network and its rivals by plane, frame and view, and the worst images.

    Args:
        path: The page, `.html`; its folder must exist.
        name: The network's.
        model, comparisons: As they were given to `wlm.smoke.evaluation.compare` and came from it.

    Returns:
        Size of the page in bytes.

    Raises:
        WlmError: The file cannot be written.
    """
    rows = [
        ("parameters", f"{parameter_count(model.network):,}"),
        ("file", f"{model.file_bytes():,} bytes"),
        ("guiding map", model.settings.guide),
    ]
    page = _begin(name, str(model.summary.get("profile", "network")), (), rows)
    scores = [
        (comparison.name, method, *(_number(value, ".2f") for value in (score.psnr, score.lowest, score.highest)))
        + (_number(score.flicker_ratio, ".3f"),)
        for comparison in comparisons
        for method, score in comparison.methods.items()
    ]
    page.text(
        "PSNR is of the six lightmaps in sRGB, of both frames of each pair; lowest and highest are over the images. "
        "Flicker is what changes from frame to frame beside the motion, over the same of the reference."
    )
    page.table("Scores", ("smoke", "method", "PSNR dB", "lowest", "highest", "flicker"), scores)
    for comparison in comparisons:
        _smoke(page, comparison)
    return page.write(path)


def _smoke(page: Document, comparison: Comparison) -> None:
    """Adds the plots of a comparison's scores."""
    name = comparison.name
    planes = {method: score.planes for method, score in comparison.methods.items()}
    page.points(f"{name}: PSNR by light, of opacity and of emission", "dB", PLANES, planes)
    frames = len(next(iter(comparison.images.values())))
    # A single volume counts as two equal frames.
    if frames > 2:
        means = {method: _means(images) for method, images in comparison.images.items()}
        page.lines(f"{name}: PSNR by frame, mean of the views", "dB", np.arange(1.0, frames + 1), means)
    if len(comparison.turns) > 1:
        means = {method: _means(images.T) for method, images in comparison.images.items()}
        page.lines(f"{name}: PSNR by the view's turn in degrees, mean of the frames", "dB", comparison.turns, means)
    for example in comparison.worst:
        _worst_image(page, comparison, example)


def _means(rows: np.ndarray) -> np.ndarray:
    """Means of the finite numbers in each row; NaN for a row without any."""
    count = np.isfinite(rows).sum(1)
    return np.where(count > 0, np.nansum(rows, 1) / np.maximum(count, 1), np.nan)


def _worst_image(page: Document, comparison: Comparison, example: Example) -> None:
    height, width = example.planes[REFERENCE].shape[1:]
    camera = Camera.look_at((0.0, 0.0, 1.0), np.zeros(3), extent=1.0, height=height, width=width)
    hot = bool(example.planes[REFERENCE][EMISSION_PLANE].any())

    def lit(planes: torch.Tensor) -> np.ndarray:
        return decode_lightmaps(planes, hot=hot, camera=camera).shade([Light(_LIT_FROM)], background=_BEHIND).numpy()

    shown = {method: lit(planes) for method, planes in example.planes.items()}
    psnr = comparison.images[NETWORK][example.frame, example.view]
    place = f"frame {example.frame + 1} from {comparison.turns[example.view]:g}°"
    heading = f"{comparison.name}: {place}, {psnr:.2f} dB, under a light from the upper right in front"
    _beside(page, heading, REFERENCE, shown.pop(REFERENCE), shown, np.ones((height, width), bool))


def _begin(name: str, profile: str, warnings: Sequence[str], rows: Sequence[tuple[str, str]]) -> Document:
    """Starts a report with title, warnings and summary."""
    page = Document(f"{name}: {profile}")
    for warning in warnings:
        page.text(warning, warning=True)
    page.table("", ("", ""), rows)
    return page


def _beside(
    page: Document, heading: str, name: str, original: np.ndarray, others: Mapping[str, np.ndarray], mask: np.ndarray
) -> None:
    """Adds pictures of linear light [H, W, 3] inside a mask [H, W]: an original, others, and their errors."""
    display = Display(1.0 / white_of(original[mask]))
    lights = {key: np.where(mask[..., None], light, 0.0) for key, light in {name: original, **others}.items()}
    pictures = {key: display.picture(light) for key, light in lights.items()}
    single = len(others) == 1
    errors = {
        f"error × {_GAIN:g}" if single else f"{key}: error × {_GAIN:g}": display.picture(
            np.abs(lights[key] - lights[name]) * _GAIN
        )
        for key in others
    }
    if single:
        page.pictures(heading, pictures | errors, _SIDE)
    else:
        page.pictures(heading, pictures, _SMALL_SIDE)
        page.pictures("", errors, _SMALL_SIDE)


def _number(value: float | None, form: str, unit: str = "") -> str:
    if value is None or value != value:
        return "–"
    return f"{value:{form}} {unit}".rstrip()
