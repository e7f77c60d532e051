"""The HTML page that shows lightmaps over time."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wlm.errors import WlmError
from wlm.export.engines.kit import filled
from wlm.export.page.html import Page, pack_triangles
from wlm.formats.geometry import read_geometry
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.lightmap.bundle import sheet_bundle
from wlm.lightmap.data import SheetFrames, load
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.evaluation import count_kinds, psnr_of
from wlm.lightmap.model import SheetModel
from wlm.lightmap.sheet import LIGHT, first_light
from wlm.system import Meter, OnProgress
from wlm.system import load as load_model
from wlm.texels import exposure, fill_gaps

_DESCRIBED = (
    *("times", "period", "interpolation", "time_axis", "tau", "tiles", "images", "slices", "record", "tile_columns"),
    *("tile_size", "hidden", "gamma", "height"),
)


def lightmap_page(
    paths: Sequence[Path],
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    hours: int = 6,
    up: Literal["y", "z"] = "y",
    progress: OnProgress | None = None,
) -> Page:
    """Makes the HTML page of a lightmap model's first layer of light; for the arguments see `make_page`.

    Raises:
        WlmError: The mesh or the original lightmap set cannot be read, or the set has another size.
    """
    whole, file_bytes = load_model(paths[0], "lightmap"), paths[0].stat().st_size
    sheet, others = first_light(whole.sheets), len(whole.sheets) - 1
    model = whole.sheets[sheet]
    bundle = sheet_bundle(sheet, model, whole.name, whole.source)
    textures = {name: texture for name, texture in bundle.textures.items() if name != "valid"}
    described = {name: bundle.document[name] for name in _DESCRIBED}
    described["textures"] = {
        name: {"size": [each.width, each.height], "layers": each.layers} for name, each in textures.items()
    }
    networks = bundle.buffers.get("networks", np.zeros((0, 4), np.float32))
    arrays: dict[str, np.ndarray] = {"networks": networks, "valid": np.packbits(bundle.textures["valid"].data > 0)}
    arrays |= {f"tiles_{name}": texture.data for name, texture in textures.items()}
    times = model.times
    time = float(times[len(times) // 2])
    reference: dict[str, Any] | None = None
    if original is not None:
        reference, originals = _originals(model, load(original).find(sheet), original, hours, progress)
        arrays |= originals
        # The page starts at an hour with an original.
        time = min(reference["times"], key=lambda stored: abs(stored - time))
    manifest: dict[str, Any] = {
        "width": model.width,
        "height": model.height,
        "shader": bundle.shader,
        "exposure": exposure(SheetDecoder(model).frame(time)),
        "time": time,
        "lightmap": described,
    }
    if mesh is not None:
        triangles, box = pack_triangles(read_geometry(mesh), up)
        arrays |= triangles
        manifest |= box
    kinds = ", ".join(f"{count} {kind}" for kind, count in count_kinds(model).items() if count)
    figures = [
        ("file", f"{file_bytes:,} bytes"),
        ("bits per texel and hour", f"{file_bytes * 8 / (model.width * model.height * len(times)):.3f}"),
        ("lightmaps", f"{model.width} × {model.height}, {len(times)} {'hour' if len(times) == 1 else 'hours'}"),
        ("tiles", kinds),
        ("profile", model.profile.name),
    ]
    if reference is not None:
        manifest["reference"] = reference
    note = "Lightmaps over time, decoded on this GPU."
    if sheet != LIGHT or others:
        rest = f", without the file's {others} other sheet{'' if others == 1 else 's'}" if others else ""
        note += f" Shown is {sheet.label}{rest}."
    return Page("lightmap", whole.name, note, figures, manifest, arrays, [filled("lightmap_table.js").rstrip("\n")])


def _originals(
    model: SheetModel,
    lightmaps: SheetFrames,
    path: str | os.PathLike[str],
    hours: int,
    progress: OnProgress | None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns original lightmaps at up to `hours` evenly spread times, and the scores of the compressed ones."""
    if hours < 1:
        raise WlmError(f"--hours: expected at least 1, got {hours}")
    size = lightmaps.mask.shape
    if size != (model.height, model.width):
        raise WlmError(f"{path}: expected lightmaps of {model.width}x{model.height}, found {size[1]}x{size[0]}")
    count = len(lightmaps.times)
    chosen = np.unique(np.linspace(0, count - 1, min(hours, count)).round().astype(int))
    frames = fill_gaps(lightmaps.frames[chosen], lightmaps.mask)
    arrays = {f"original_{i}": pack_rgb9e5(frame) for i, frame in enumerate(frames)}
    # Texels outside of the mask were not compressed and have no error.
    arrays["mask"] = lightmaps.mask.astype(np.uint8) * 255
    times, decoder, scores = lightmaps.times[chosen].tolist(), SheetDecoder(model), []
    meter = Meter(progress, "score", len(times))
    for number, time in zip(chosen.tolist(), times, strict=True):
        scores.append(psnr_of(model, lightmaps, number, decoder.frame(time)))
        if meter.due(len(scores)):
            meter.report(len(scores))
    return {"times": times, "psnr": [None if math.isnan(score) else score for score in scores]}, arrays
