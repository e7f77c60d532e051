"""Kits of compressed lightmaps for engines: textures, the mesh, and a material that reads the textures.

Materials read the lightmaps at their own resolution: a kit has no mips. A kit of one lightmap has the files `atlas.*`.
A kit of a scene with several lightmaps has the files `scene.*` and a component that sets each object's rectangle
in its lightmap and its lighting state.
"""

from pathlib import Path
from typing import Any

import numpy as np

from wlm.atlas.bundle import bundle as make_bundle
from wlm.atlas.model import BLOCK_SIDE
from wlm.bundle import Bundle, Texture
from wlm.errors import WlmError
from wlm.export.engines.kit import (
    README_FILE,
    asset_name,
    check_sides,
    filled,
    godot_uniforms,
    picture_entry,
    stacked,
    write_texts,
)
from wlm.export.files import decode_texture, write_texture
from wlm.export.shading import custom_node, translate
from wlm.formats.dds import DXGI_FORMATS
from wlm.formats.exr import write_exr


def write_kit(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    """Writes the kit of compressed lightmaps for one of `wlm.export.ENGINES` into an existing folder; returns the
    entries of the folder's index: shader and textures."""
    if bundle.model.levels:
        bundle = make_bundle(bundle.model.without_mips())
    pictures = engine in ("godot", "unreal")
    entries = _write_pictures(bundle, folder, engine) if pictures else _write_textures(bundle, folder, engine)
    for name, content in bundle.files.items():
        (folder / name).write_bytes(content)
    texts = _texts(bundle, engine, entries)
    write_texts(folder, texts)
    return {"shader": next(iter(texts)), "textures": entries}


def _write_textures(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    ending, entries = ".bytes" if engine == "unity" else None, {}
    for name, texture in bundle.textures.items():
        if texture.fmt not in DXGI_FORMATS:
            raise WlmError(
                f"{bundle.name}: cannot export for {engine}: a DDS file cannot hold ASTC; compress with --colour bc6h"
            )
        if texture.image is not None and (texture.width % BLOCK_SIDE or texture.height % BLOCK_SIDE):
            # Direct3D and browsers refuse blocks that don't fill their texture.
            whole = np.concatenate([texture.image, np.ones((*texture.image.shape[:2], 1), np.float32)], 2)
            texture = Texture.from_texels(whole.astype("<f2"), "R16G16B16A16_FLOAT")
        entries[name] = write_texture(folder, name, texture, ending)
    return entries


def _write_pictures(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    """Writes the textures as EXR files of floats, with the layers of an array one below the other."""
    entries = {}
    for name, texture in bundle.textures.items():
        pixels = stacked(decode_texture(texture)).astype(np.float32)
        if pixels.shape[2] == 2:
            pixels = np.pad(pixels, ((0, 0), (0, 0), (0, 1)))
        if name in ("colour", "blocks"):
            pixels = pixels[..., :3]
        check_sides(bundle.name, engine, f"{name}.exr", pixels)
        write_exr(folder / f"{name}.exr", pixels, half=name in ("colour", "blocks"))
        entries[name] = picture_entry(f"{name}.exr", pixels, texture.layers)
    return entries


def _texts(bundle: Bundle, engine: str, entries: dict[str, Any]) -> dict[str, str]:
    """Returns the contents of a kit's text files by file name, the shader first."""
    shared, uv_set, place = bundle.document["method"] == "shared", bundle.document["uv_set"], asset_name(bundle.name)
    kind, title = ("scene", "WlmScene") if shared else ("atlas", "WlmAtlas")
    if engine == "three":
        texts = {f"{kind}.glsl": bundle.shader, f"{kind}.js": filled(f"three_{kind}.js", DDS=filled("three_dds.js"))}
    elif engine == "unity":
        texts = {
            f"{title}.hlsl": translate(bundle.shader, "hlsl"),
            f"{title}.shader": filled(f"unity_{kind}.shader", SET=str(uv_set)),
            f"{title}.cs": filled(f"unity_{kind}.cs", DDS=filled("unity_dds.cs")),
        }
    elif engine == "godot":
        if shared and uv_set > 1:
            raise WlmError(
                f"{bundle.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1, not TEXCOORD_{uv_set}"
            )
        marks = {"SHADER": godot_uniforms(bundle.shader), "UV": "UV2" if uv_set else "UV"}
        texts = {f"{kind}.gdshader": filled(f"godot_{kind}.gdshader", **marks)}
        texts |= {"wlm_scene.gd": filled("godot_scene.gd")} if shared else {}
    else:
        arrays = {f"wlm_scene_{name}": (t.height, t.layers) for name, t in bundle.textures.items() if t.layers}
        call = ("wlm_object", "UV, Place, int(Sheet + 0.5), State") if shared else ("wlm_atlas", "UV")
        marks = {"CODE": custom_node(bundle.shader, *call, arrays)[0], "KIT": filled("unreal_kit.py.in")}
        rows = [
            f'    "wlm_scene_{name}": {{"file": "{entry["file"]}", '
            f'"form": "{"halves" if name in ("colour", "blocks") else "floats"}", '
            f'"size": [{entry["width"]}, {entry["height"]}]}},\n'
            for name, entry in entries.items()
        ]
        marks["TEXTURES"] = "{\n" + "".join(rows) + "}"
        texts = {f"wlm_{kind}.py": filled(f"unreal_{kind}.py.in", NAME=place, **marks)}
    return texts | {README_FILE: filled(f"{engine}_{kind}.md", NAME=bundle.name, PLACE=place)}
