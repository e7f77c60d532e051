"""Folders for Unreal: pictures that its editor imports as they are, and a script that makes materials of them."""

import re
from pathlib import Path

import numpy as np
from PIL import Image

from wlm.atlas.model import AtlasModel
from wlm.atlas.shader import glsl
from wlm.engines.kit import README_FILE, check_sides, filled
from wlm.formats.bc7 import blocks_image
from wlm.formats.bc7_modes import decode_blocks
from wlm.formats.exr import write_exr
from wlm.lightmap import packed
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.shader import decode_glsl, texture_names
from wlm.shading import custom_node

_ROW = 1024  # fours of floats in a row of a texture
# Of the table of all hours: `wlm_hour` is the stored hour's number.
_HOUR = """\
uniform float wlm_hour;
#define WLM_LIGHTMAP_HOUR_AT(i) texelFetch(WLM_LIGHTMAP_HOUR, wlm_lightmap_place(i, wlm_hour), 0)
ivec2 wlm_lightmap_place(int i, float hour)
{
    return ivec2(i & 1023, (i >> 10) + ROWS * int(hour + 0.5));
}
"""


def atlas_texts(model: AtlasModel) -> dict[str, str]:
    """The script and the page of an atlas."""
    code, _ = custom_node(glsl(model), "wlm_atlas", "UV")
    place = asset_name(model.name)
    return {
        "wlm_atlas.py": filled("unreal_atlas.py.in", NAME=place, CODE=code, KIT=filled("unreal_kit.py.in")),
        README_FILE: filled("unreal_atlas.md", NAME=model.name, PLACE=place),
    }


def write_lightmap(model: LightmapModel, folder: Path) -> dict[str, str]:
    """Writes the textures of a lightmap, and gives the script and the page.

    Args:
        model: The model.
        folder: Where; it must exist.

    Raises:
        WlmError: A texture would be larger than Unreal imports.
    """
    pictures, layers = _pictures(model)
    inputs = {}
    for name, (pixels, form) in pictures.items():
        height, width = pixels.shape[:2]
        check_sides(model.name, "unreal", name, pixels)
        file = name + (".tga" if form == "bytes" else ".exr")
        if form == "bytes":
            Image.fromarray(pixels).save(folder / file)
        else:
            write_exr(folder / file, pixels, half=form == "halves")
        inputs[name] = {"file": file, "form": form, "size": [width, height]}
    rows = -(-packed.hour_tables(model).shape[1] // _ROW)
    size = f"{model.width}, {model.height}"
    texel = f"min(int2(UV * float2({size})), int2({size}) - 1)"
    decode, _ = custom_node(_HOUR.replace("ROWS", str(rows)) + decode_glsl(model), "wlm_radiance", texel, layers)
    fill, _ = custom_node(decode_glsl(model), "wlm_source", texel, layers)
    fill = re.sub(r"return (wlm\.wlm_source\(.*\));\n", r"return Decoded.Load(int3(\1, 0)).rgb;\n", fill)
    place = asset_name(model.name)
    listed = "{\n" + "".join(f'    "{name}": {value},\n' for name, value in inputs.items()) + "}"
    parts = {"DECODE": decode, "FILL": fill, "INPUTS": listed.replace("'", '"'), "KIT": filled("unreal_kit.py.in")}
    return {
        "wlm_lightmap.py": filled("unreal_lightmap.py.in", NAME=place, **parts),
        README_FILE: filled("unreal_lightmap.md", NAME=model.name, PLACE=place),
    }


def asset_name(name: str) -> str:
    """A name as Unreal's assets may have one."""
    return re.sub(r"\W", "_", name, flags=re.ASCII) or "_"


def stacked(images: np.ndarray) -> np.ndarray:
    """Layers [T, H, W, C] one below the other."""
    return images.reshape(-1, *images.shape[2:])


def _pictures(model: LightmapModel) -> tuple[dict[str, tuple[np.ndarray, str]], dict[str, tuple[int, int]]]:
    """The textures by the shader's names, each with its form, and of arrays rows of a layer and layers."""
    pictures, layers = {}, {}
    for name, texture in packed.textures(model).items():
        data, form = texture.data, "bytes"
        if texture.layers:
            layers[f"wlm_lightmap_{name}"] = texture.height, texture.layers
        if texture.fmt == "BC7_UNORM":
            pixels = blocks_image(decode_blocks(data.reshape(-1, texture.width // 4, 16)))
        elif texture.fmt == "R8G8_UNORM":
            pixels = np.pad(data.reshape(texture.height, texture.width, 2), ((0, 0), (0, 0), (0, 1)))
        else:
            words = np.ascontiguousarray(data).view("<u4").reshape(-1, texture.width)
            levels = np.stack([words >> shift & 1023 for shift in (0, 10, 20)], 2)
            pixels, form = (levels / 1023.0).astype(np.float32), "halves"
        pictures[name] = pixels, form
    pictures["valid"] = np.repeat(model.mask[..., None].astype(np.uint8) * 255, 3, 2), "bytes"
    pictures["hour"] = stacked(np.stack([_rows(table) for table in packed.hour_tables(model)])), "floats"
    if "networks" in texture_names(model):
        pictures["networks"] = _rows(packed.networks(model)[0]), "floats"
    return pictures, layers


def _rows(fours: np.ndarray) -> np.ndarray:
    """Fours of floats as a picture, the last row filled up."""
    return np.pad(fours, ((0, -len(fours) % _ROW), (0, 0))).reshape(-1, _ROW, 4)
