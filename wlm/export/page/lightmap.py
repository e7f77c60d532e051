"""The HTML page that shows lightmaps over time."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.export.engines.kit import filled
from wlm.export.page.html import Page, compare_sizes, pack_triangles
from wlm.formats.geometry import read_geometry
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.lightmap.bundle import sheet_bundle
from wlm.lightmap.data import SheetFrames, load
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.evaluation import count_kinds, psnr_of
from wlm.lightmap.group_scores import sum_of
from wlm.lightmap.groups import times_of
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.sheet import LIGHT, Sheet, first_light
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
    """Makes the HTML page of a lightmap model's first layer of light, the sum of its light groups, each with a slider.
    For the arguments see `make_page`; `original` is a set with the same groups, or a bake of all lights together."""
    whole, file_bytes = load_model(paths[0], "lightmap"), paths[0].stat().st_size
    sheet = first_light(whole.sheets)
    groups = whole.maps(sheet)
    others, model = len(whole.sheets) - len(groups), groups[sheet.group]
    described, arrays = pack_groups(whole, sheet)
    decoders = [SheetDecoder(own) for own in groups.values()]

    def decode(time: float) -> np.ndarray:
        return sum(decoder.frame(time) for decoder in decoders)

    times = times_of({replace(sheet, group=name): own for name, own in groups.items()})
    time = float(times[len(times) // 2])
    reference: dict[str, Any] | None = None
    if original is not None:
        given = load(original)
        light = given.find(sheet) if len(given.groups) == 1 else sum_of(given, sheet)
        reference, originals = pack_originals(model, light, decode, original, hours, progress)
        arrays |= originals
        # The page starts at an hour with an original.
        time = min(reference["times"], key=lambda stored: abs(stored - time))
    manifest: dict[str, Any] = {
        "width": model.width,
        "height": model.height,
        "exposure": exposure(decode(time)),
        "time": time,
        "times": times.tolist(),
        "period": model.period,
        "groups": described,
    }
    if mesh is not None:
        triangles, box = pack_triangles(read_geometry(mesh), up)
        arrays |= triangles
        manifest |= box
    counts = [count_kinds(own) for own in groups.values()]
    kinds = {kind: sum(count[kind] for count in counts) for kind in counts[0]}
    figures = [
        ("file", f"{file_bytes:,} bytes"),
        *compare_sizes(file_bytes, half_bytes(whole)),
        ("bits per texel and hour", f"{file_bytes * 8 / (model.width * model.height * len(times)):.3f}"),
        ("lightmaps", f"{model.width} × {model.height}, {len(times)} {'hour' if len(times) == 1 else 'hours'}"),
        ("tiles", ", ".join(f"{count} {kind}" for kind, count in kinds.items() if count)),
        ("profile", model.profile.name),
    ]
    if len(groups) > 1:
        figures.append(("light groups", str(len(groups))))
    if reference is not None:
        manifest["reference"] = reference
    note = "Lightmaps over time, decoded on this GPU."
    if sheet.plain != LIGHT or others:
        rest = f", without the file's {others} other sheet{'' if others == 1 else 's'}" if others else ""
        note += f" Shown is {sheet.plain.label}{rest}."
    return Page("lightmap", whole.name, note, figures, manifest, arrays, [filled("lightmap_table.js").rstrip("\n")])


def half_bytes(whole: LightmapModel) -> int:
    """Returns the bytes of the lightmaps of a model, of all sheets and times, as half floats."""
    return sum(6 * own.width * own.height * len(own.times) for own in whole.sheets.values())


def pack_groups(whole: LightmapModel, sheet: Sheet) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
    """Returns what the script needs to decode the light groups of a sheet: a description of each group, and arrays."""
    described, arrays = [], dict[str, np.ndarray]()
    for number, (name, own) in enumerate(whole.maps(sheet).items()):
        bundle = sheet_bundle(replace(sheet, group=name), own, whole.name, whole.source)
        described.append({"name": name, "shader": bundle.shader, "lightmap": _described(bundle)})
        textures = {key: texture for key, texture in bundle.textures.items() if key != "valid"}
        arrays |= {f"{number}_{key}": texture.data for key, texture in textures.items()}
        arrays[f"{number}_networks"] = bundle.buffers.get("networks", np.zeros((0, 4), np.float32))
        arrays["valid"] = np.packbits(own.mask)
    return described, arrays


def _described(bundle: Bundle) -> dict[str, Any]:
    """Returns what the script needs to know of the bundle of a light group."""
    textures = {
        name: {"size": [each.width, each.height], "layers": each.layers}
        for name, each in bundle.textures.items()
        if name != "valid"
    }
    return {name: bundle.document[name] for name in _DESCRIBED} | {"textures": textures}


def pack_originals(
    model: SheetModel,
    lightmaps: SheetFrames,
    decode: Callable[[float], np.ndarray],
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
    times, scores = lightmaps.times[chosen].tolist(), list[float]()
    meter = Meter(progress, "score", len(times))
    for number, time in zip(chosen.tolist(), times, strict=True):
        scores.append(psnr_of(model, lightmaps, number, decode(time)))
        if meter.due(len(scores)):
            meter.report(len(scores))
    return {"times": times, "psnr": [None if math.isnan(score) else score for score in scores]}, arrays
