"""The HTML page that shows a compressed lightmap on its mesh."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np

from wlm.atlas import codec
from wlm.atlas.model import BLOCK_SIDE, SIDE_BITS
from wlm.atlas.shader import glsl
from wlm.atlas.views import texel_triangles
from wlm.errors import WlmError
from wlm.export.page.html import Page, compare_sizes, pack_triangles
from wlm.export.page.materials import pack_materials
from wlm.formats.geometry import Geometry
from wlm.formats.light import read_light
from wlm.formats.shared_exponent import pack_rgb9e5
from wlm.metrics import psnr_from_mse
from wlm.system import load
from wlm.texels import exposure, fill_gaps

_FORMATS = {"half": "half floats", "rgb9e5": "RGB9E5", "bc6h": "BC6H", "astc": "ASTC", "mixed": "RGB9E5"}
_DARKEST = 0.02  # mean base colour for which a page is exposed


def atlas_page(
    paths: Sequence[Path], *, original: str | os.PathLike[str] | None = None, up: Literal["y", "z"] = "y"
) -> Page:
    """Makes the HTML page of a model with one lightmap; `original` is the lightmap that was compressed, to compare
    with, and `up` the axis that points up in the scene."""
    model = load(paths[0], "atlas")
    if model.method == "shared":
        raise WlmError(f"{model.name}: expected a model of one lightmap, found {len(model.sheets) * len(model.states)}")
    mesh, (height, width) = model.scene.sheets[0], model.sheets[0].size
    colours, blocks = model.texels[0], model.block_texels[0] if model.colour == "mixed" else model.texels[0]
    triangles = mesh.triangle[mesh.active]
    # Each corner becomes a vertex, since the new UVs belong to corners.
    corners = triangles.reshape(-1)
    position, uv = mesh.position[corners].astype(np.float32), mesh.uv[corners].astype(np.float32)
    drawn = Geometry(position, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3), uv)
    texels = np.ascontiguousarray(colours, np.float16)
    arrays, box = pack_triangles(drawn, up)
    shown, base = "base colours of the file", 1.0
    try:
        parts, base = pack_materials(model.scene.document, [part.primitive for part in mesh.parts])
        # Vertices of the sheet are those of its primitives, in order.
        arrays |= {name: values if name == "pictures" else values[corners] for name, values in parts.items()}
        shown = shown if parts else "white"
    except WlmError as error:  # light can be seen without them
        shown = f"white: {error}"
    arrays["colour"] = texels
    if model.colour == "mixed":
        arrays["blocks"] = np.ascontiguousarray(blocks, np.float16)
    if len(model.uv):
        arrays["coordinate"] = model.uv[mesh.active].reshape(-1, 2).astype(np.float32)
    if model.method != "plain":
        arrays["lut"] = np.ascontiguousarray(model.lut, np.uint16)
    decoded = model.decoder().lightmap()
    manifest: dict[str, Any] = {
        "width": width,
        "height": height,
        "shader": glsl(model),
        "exposure": (bare := exposure(decoded[mesh.mask])) / max(base, _DARKEST),
        "atlas": {
            "method": model.method,
            "colour": texels.shape[1::-1],
            "blocks": model.block_texels.shape[2:0:-1],
            "lut": model.lut.shape[1::-1],
            "tile": model.profile.tile,
            "size_bits": SIDE_BITS,
            "block_side": BLOCK_SIDE,
            "first_block_code": model.first_block_code,
        },
        **box,
    }
    if "pictures" in arrays:
        manifest |= {"picture": arrays["pictures"].shape[1], "bare": bare}
    scores: list[tuple[str, str]] = []
    if original is not None:
        lightmap = read_light(original)[0][..., :3]
        if lightmap.shape[:2] != (height, width):
            raise WlmError(
                f"{original}: expected a lightmap of {width}x{height}, found {lightmap.shape[1]}x{lightmap.shape[0]}"
            )
        light = np.nan_to_num(lightmap.astype(np.float32), posinf=65504.0)
        arrays["original_0"] = pack_rgb9e5(fill_gaps(light, mesh.mask))
        arrays["mask"] = mesh.mask.astype(np.uint8) * 255
        manifest["reference"] = {"times": [0.0]}
        inside = mesh.mask & (texel_triangles(mesh, height, width, "cpu")[0].numpy() >= 0)
        error = float(np.square(decoded - light)[inside].mean(dtype=np.float64)) if inside.any() else math.nan
        psnr = psnr_from_mse(error, float(np.ptp(light[mesh.mask])))
        scores = [("PSNR of texels", "–" if math.isnan(psnr) else f"{psnr:.2f} dB")]
    stored = int(np.subtract(*codec.sizes(model)))
    figures = [
        ("file without the mesh", f"{stored:,} bytes"),
        *compare_sizes(stored, 6 * width * height),
        *scores,
        ("textures on a GPU", f"{100 * (1.0 - model.compression_ratio):.1f}% of half floats"),
        ("lightmap", f"{width} × {height} texels"),
        ("colour texture", f"{texels.shape[1]} × {texels.shape[0]}, {_FORMATS[model.colour]}"),
        ("method", model.method),
        ("materials", shown),
        ("triangles", f"{len(triangles):,}"),
        ("profile", model.profile.name),
    ]
    if model.colour == "mixed":
        rows, columns = model.block_texels.shape[1:3]
        figures.insert(-5, ("its blocks", f"{columns} × {rows}, BC6H"))
    return Page("atlas", model.name, "A lightmap read through a table, on this GPU.", figures, manifest, arrays)
