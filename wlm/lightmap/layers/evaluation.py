"""Scoring a layered set: each sheet as `wlm.lightmap.evaluation` scores a set.

Errors of light are relative to the range of each tile at each time. Directions, ratios and masks have a range of their
own, [0, 1] or [-1, 1], to which their errors are relative in all tiles alike. FLIP and views are of light alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap import evaluation
from wlm.lightmap.evaluation import SCORES, Report, memory_bytes, part_bytes
from wlm.lightmap.layers.codec import sheet_bytes
from wlm.lightmap.layers.data import LayeredSet
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import Sheet
from wlm.lightmap.views import VIEWS
from wlm.metrics.tiled import nanmean
from wlm.system import OnProgress, plain

_SHARED = ("header", "times", "mask")  # parts of a sheet's own file that it may share with others


@dataclass(frozen=True)
class LayeredReport:
    """Size and error of a compressed layered set.

    Attributes:
        bytes: Size of the file on disk.
        bpp: Bits per texel of the atlases and time, all layers together.
        memory_bpp: The same of what a GPU holds.
        sheets: The report of each sheet; its bytes are those of its parts in the file.
        psnr_by_layer: For each layer the mean over the tiles of its sheets, each channel as much as another, decibels.
        warnings: Those of the sheets.
    """

    bytes: int
    bpp: float
    memory_bpp: float
    sheets: dict[Sheet, Report]
    psnr_by_layer: dict[str, float]
    warnings: list[str]

    def to_json(self) -> dict[str, Any]:
        """The report as JSON's own types; NaN and infinity are None."""
        values = vars(self) | {"sheets": [vars(sheet) | report.to_json() for sheet, report in self.sheets.items()]}
        return plain(values)


def evaluate(
    model: LayeredModel,
    lightmaps: LayeredSet,
    *,
    device: str = "cpu",
    metrics: Sequence[str] = SCORES,
    views: int = VIEWS,
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
) -> LayeredReport:
    """Decodes every sheet and compares it with the input.

    Args:
        model: The model.
        lightmaps: The input, or another set with the same sheets.
        device, metrics, views, progress, file_bytes: As for `wlm.lightmap.evaluation.evaluate`.

    Returns:
        The report.

    Raises:
        WlmError: The sets' sheets aren't the model's; or as `wlm.lightmap.evaluation.evaluate`.
    """
    file_bytes = model.file_bytes() if file_bytes is None else file_bytes
    own_bytes, reports = sheet_bytes(model), {}
    for sheet in lightmaps.sheets.keys() ^ model.sheets.keys():
        holder = lightmaps.name if sheet in lightmaps.sheets else f"the file {model.name}"
        raise WlmError(
            f"{lightmaps.name}: expected the sheets of the file {model.name}; {holder} alone has {sheet.label}"
        )
    for sheet, own in model.sheets.items():
        report = evaluation.evaluate(
            own,
            lightmaps.sheets[sheet],
            device=device,
            metrics=[metric for metric in metrics if not (sheet.linear and metric == "flip")],
            views=0 if sheet.linear else views,
            progress=progress,
        )
        size, span = own_bytes[sheet], sheet.span
        parts = {name: count for name, count in part_bytes(own, report.bytes).items() if name not in _SHARED}
        reports[sheet] = replace(
            report,
            bytes=size,
            bpp=report.bpp * size / report.bytes,
            parts=parts | {"shared and sizes": size - sum(parts.values())},
            max_abs_error=report.max_abs_error * span,
            max_abs_error_unscored=report.max_abs_error_unscored * span,
        )
    texels = sum(height * width for height, width in model.atlases.values()) * len(model.times)
    memory = sum(memory_bytes(own) for own in model.sheets.values())
    layers = dict.fromkeys(sheet.layer for sheet in model.sheets)
    return LayeredReport(
        bytes=file_bytes,
        bpp=8 * file_bytes / texels,
        memory_bpp=8 * memory / texels,
        sheets=reports,
        psnr_by_layer={layer: _mean(reports, layer) for layer in layers},
        warnings=list(dict.fromkeys(text for report in reports.values() for text in report.warnings)),
    )


def _mean(reports: dict[Sheet, Report], layer: str) -> float:
    """Mean PSNR of a layer, see `LayeredReport`."""
    grids = [
        report.psnr_by_tile.ravel().repeat(len(sheet.channels))
        for sheet, report in reports.items()
        if sheet.layer == layer
    ]
    return float(nanmean(np.concatenate(grids)))
