"""The page of lightmaps over the day."""

from __future__ import annotations

import math
import os
from typing import Any, Literal

import numpy as np

from wlm.errors import WlmError
from wlm.formats.geometry import read_geometry
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.lightmap.data import LightmapSet
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import count_kinds, psnr_of
from wlm.lightmap.exporter import document
from wlm.lightmap.front import load_light
from wlm.lightmap.layers.sheet import Sheet
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.shader import decode_glsl
from wlm.lightmap.tiles import TileKind, valid_texels
from wlm.system import Meter, OnProgress
from wlm.texels import exposure, fill_gaps
from wlm.web.page import Page, pack_triangles

_TIMES = ("times", "period", "interpolation", "time_axis", "tau", "tiles")
_LAYERS = ("W1", "b1", "W2", "b2", "W3", "b3")


def lightmap_page(
    model: LightmapModel,
    file_bytes: int,
    *,
    mesh: str | os.PathLike[str] | None = None,
    original: str | os.PathLike[str] | None = None,
    hours: int = 6,
    up: Literal["y", "z"] = "y",
    progress: OnProgress | None = None,
    sheet: Sheet | None = None,
    others: int = 0,
) -> Page:
    """Makes the page of a lightmap model.

    Args:
        model: The model.
        file_bytes: Size of its file, or of its part of a layered one.
        mesh, original, hours, up, progress: As for `wlm.web.pages.make_page`.
        sheet: Which sheet of a layered file it is; None: of none.
        others: How many sheets more that file has.

    Raises:
        WlmError: The mesh or the set can't be read, or the set is of another size.
    """
    described = document(model)
    networks = [
        np.concatenate([np.ravel(tile.pop(layer)) for layer in _LAYERS]) for tile in described["tiles"] if "W1" in tile
    ]
    arrays: dict[str, np.ndarray] = {
        "networks": np.concatenate(networks or [np.zeros(0)]).astype(np.float32),
        "valid": np.packbits(model.mask),
    }
    dynamic = np.flatnonzero(model.kind == TileKind.DYNAMIC).tolist()
    for place, number in enumerate(model.mapped.tolist()):
        arrays[f"{number}_uv"] = model.uv[place]
        if number in dynamic:
            row = dynamic.index(number)
            arrays |= {f"{number}_{name}": getattr(model, name)[row] for name in ("uvt", "ut", "vt")}
    for row, number in enumerate(np.flatnonzero(model.kind == TileKind.FRAMES).tolist()):
        arrays[f"{number}_frames"] = model.frames[row]
    for row, number in enumerate(np.flatnonzero(model.kind == TileKind.VIDEO).tolist()):
        # The gaps' light is that of charts: what lies there packs better as nothing.
        arrays[f"{number}_video"] = model.video_levels[row] * valid_texels(model.mask, number)
    profile, times = model.profile, model.times
    time = float(times[len(times) // 2])
    reference: dict[str, Any] | None = None
    if original is not None:
        reference, originals = _originals(model, load_light(original, sheet), original, hours, progress)
        arrays |= originals
        # A page begins where its original is.
        time = min(reference["times"], key=lambda stored: abs(stored - time))
    manifest: dict[str, Any] = {
        "width": model.width,
        "height": model.height,
        "shader": decode_glsl(model),
        "exposure": exposure(Decoder(model).frame(time)),
        "time": time,
        "lightmap": {name: described[name] for name in _TIMES}
        | {
            "maps": {
                "resolution": profile.uvt_resolution,
                "slices": profile.uvt_slices,
                "columns": profile.plane_columns,
                "rows": profile.plane_rows,
            }
        },
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
        ("profile", profile.name),
    ]
    if reference is not None:
        manifest["reference"] = reference
    note = "Lightmaps over the day, decoded on this GPU."
    if sheet is not None:
        rest = f", without the file's {others} other sheet{'' if others == 1 else 's'}" if others else ""
        note += f" Shown is {sheet.label}{rest}."
    return Page("lightmap", model.name, note, figures, manifest, arrays)


def _originals(
    model: LightmapModel,
    lightmaps: LightmapSet,
    path: str | os.PathLike[str],
    hours: int,
    progress: OnProgress | None,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Some frames of the set, spread evenly, their gaps filled: what a filter would read there; with their scores."""
    if hours < 1:
        raise WlmError(f"--hours: expected at least 1, got {hours}")
    size = lightmaps.mask.shape
    if size != (model.height, model.width):
        raise WlmError(f"{path}: expected lightmaps of {model.width}x{model.height}, found {size[1]}x{size[0]}")
    count = len(lightmaps.times)
    chosen = np.unique(np.linspace(0, count - 1, min(hours, count)).round().astype(int))
    frames = fill_gaps(lightmaps.frames[chosen], lightmaps.mask)
    arrays = {f"original_{i}": pack_rgb9e5(frame) for i, frame in enumerate(frames)}
    # Texels outside of it were never compressed: they have no error.
    arrays["mask"] = lightmaps.mask.astype(np.uint8) * 255
    times, decoder, scores = lightmaps.times[chosen].tolist(), Decoder(model), []
    meter = Meter(progress, "score", len(times))
    for number, time in zip(chosen.tolist(), times, strict=True):
        scores.append(psnr_of(model, lightmaps, number, decoder.frame(time)))
        if meter.due(len(scores)):
            meter.report(len(scores))
    return {"times": times, "psnr": [None if math.isnan(score) else score for score in scores]}, arrays
