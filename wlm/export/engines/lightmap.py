"""Kits of lightmaps over time for engines: textures, tables, and a component that decodes them into lightmaps."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.export.engines.kit import (
    README_FILE,
    asset_name,
    check_sides,
    filled,
    godot_uniforms,
    label,
    picture_entry,
    stacked,
    write_texts,
)
from wlm.export.files import decode_texture, write_buffer, write_texture
from wlm.export.shading import custom_node, translate
from wlm.formats.exr import write_exr

_ROW = 1024  # RGBA texels in a row of a buffer that is stored as a picture
# `wlm_hour` is the index of the stored hour in the picture of all hours.
_HOUR = """\
uniform float wlm_hour;
#define WLM_LIGHTMAP_HOUR_AT(i) texelFetch(WLM_LIGHTMAP_HOUR, wlm_lightmap_place(i, wlm_hour), 0)
ivec2 wlm_lightmap_place(int i, float hour)
{
    return ivec2(i & 1023, (i >> 10) + ROWS * int(hour + 0.5));
}
"""


def write_kit(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    """Writes the kit of a lightmap over time for an engine into an existing folder. Returns entries for the folder's
    index: shader, textures and buffers."""
    if engine == "unreal":
        return {"textures": _write_unreal(bundle, folder)}
    ending = ".bytes" if engine == "unity" else None
    textures = {name: write_texture(folder, name, each, ending) for name, each in bundle.textures.items()}
    # The script for three.js computes the tables of the hours itself.
    names = [name for name in bundle.buffers if name != "hours" or engine != "three"]
    buffers = {name: write_buffer(folder, name, bundle.buffers[name], ending or ".bin") for name in names}
    texts = _TEXTS[engine](bundle)
    write_texts(folder, texts)
    return {"shader": next(iter(texts)), "textures": textures, "buffers": buffers}


def write_collection(bundle: Bundle, folder: Path, engine: str) -> None:
    """Writes what the kits of a collection's parts need together: the script that adds the light groups."""
    if len({sheet["group"] for sheet in bundle.document["sheets"]}) == 1:
        return
    if engine != "three":
        raise WlmError(
            f"{bundle.name}: the kit for {engine} does not add light groups: export for three, or without an engine, "
            "which writes a shader and textures for each group"
        )
    part = next(name for name, each in bundle.parts.items() if "values" not in each.document)
    script = filled("three_groups.js", PART=part)
    write_texts(folder, {"groups.js": script, README_FILE: filled("three_groups.md", NAME=bundle.name)})


def _three(bundle: Bundle) -> dict[str, str]:
    parts = {"DDS": filled("three_dds.js"), "TABLE": filled("lightmap_table.js")}
    return {
        "lightmap.glsl": bundle.shader,
        "lightmap.js": filled("three_lightmap.js", **parts),
        README_FILE: filled("three_lightmap.md", NAME=bundle.name),
    }


def _godot(bundle: Bundle) -> dict[str, str]:
    names = [*bundle.textures, "hour", *(["networks"] if "networks" in bundle.buffers else [])]
    # Only two textures are filtered; others, floats among them, cannot be everywhere.
    shader = re.sub(
        r"(wlm_lightmap_(?!uvt|planes)\w+) : filter_linear", r"\1 : filter_nearest", godot_uniforms(bundle.shader)
    )
    size = f"{bundle.document['width']}, {bundle.document['height']}"
    return {
        "lightmap.gdshader": filled("godot_lightmap.gdshader", SHADER=shader, SIZE=size),
        "wlm_lightmap.gd": filled("godot_lightmap.gd", NAMES=", ".join(f'"{name}"' for name in names)),
        "lit.gdshader": filled("godot_lit.gdshader"),
        README_FILE: filled("godot_lightmap.md", NAME=bundle.name),
    }


def _unity(bundle: Bundle) -> dict[str, str]:
    return {
        "WlmLightmap.hlsl": translate(bundle.shader, "hlsl"),
        "WlmLightmap.shader": filled("unity_lightmap.shader", NAME=label(bundle.name)),
        "WlmLightmap.cs": filled("unity_lightmap.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_lightmap.md", NAME=bundle.name),
    }


_TEXTS: dict[str, Callable[[Bundle], dict[str, str]]] = {"three": _three, "godot": _godot, "unity": _unity}


def _write_unreal(bundle: Bundle, folder: Path) -> dict[str, Any]:
    """Writes pictures for Unreal's editor, and a script that imports them and makes materials."""
    pictures = {name: decode_texture(each) for name, each in bundle.textures.items()}
    layers = {name: each.layers for name, each in bundle.textures.items() if each.layers}
    arrays = {f"wlm_lightmap_{name}": (bundle.textures[name].height, count) for name, count in layers.items()}
    pictures["hour"] = np.stack([_rows(table) for table in bundle.buffers["hours"]])
    if "networks" in bundle.buffers:
        pictures["networks"] = _rows(bundle.buffers["networks"])
    entries, inputs = {}, {}
    for name, pixels in pictures.items():
        pixels, form = stacked(pixels), "bytes" if pixels.dtype == np.uint8 else "floats"
        check_sides(bundle.name, "unreal", name, pixels)
        file = name + (".tga" if form == "bytes" else ".exr")
        if form == "bytes":
            Image.fromarray(_as_colours(pixels)).save(folder / file)
        else:
            write_exr(folder / file, pixels, half=False)
        entries[name] = picture_entry(file, pixels, layers.get(name, 0))
        inputs[name] = {"file": file, "form": form, "size": [pixels.shape[1], pixels.shape[0]]}
    size = f"{bundle.document['width']}, {bundle.document['height']}"
    texel = f"min(int2(UV * float2({size})), int2({size}) - 1)"
    rows = -(-bundle.buffers["hours"].shape[1] // _ROW)
    decode, _ = custom_node(_HOUR.replace("ROWS", str(rows)) + bundle.shader, "wlm_radiance", texel, arrays)
    fill, _ = custom_node(bundle.shader, "wlm_source", texel, arrays)
    fill = re.sub(r"return (wlm\.wlm_source\(.*\));\n", r"return Decoded.Load(int3(\1, 0)).rgb;\n", fill)
    place = asset_name(bundle.name)
    listed = "{\n" + "".join(f'    "{name}": {value},\n' for name, value in inputs.items()) + "}"
    parts = {"DECODE": decode, "FILL": fill, "INPUTS": listed.replace("'", '"'), "KIT": filled("unreal_kit.py.in")}
    texts = {
        "wlm_lightmap.py": filled("unreal_lightmap.py.in", NAME=place, **parts),
        README_FILE: filled("unreal_lightmap.md", NAME=bundle.name, PLACE=place),
    }
    write_texts(folder, texts)
    return entries


def _as_colours(pixels: np.ndarray) -> np.ndarray:
    """Extends uint8 [H, W, 1 or 2] to [H, W, 3]: one channel is repeated, two get a third one of 0."""
    channels = pixels.shape[2]
    if channels == 1:
        return np.repeat(pixels, 3, 2)
    return np.pad(pixels, ((0, 0), (0, 0), (0, 1))) if channels == 2 else pixels


def _rows(table: np.ndarray) -> np.ndarray:
    return np.pad(table, ((0, -len(table) % _ROW), (0, 0))).reshape(-1, _ROW, 4)
