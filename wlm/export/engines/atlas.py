"""Kits of compressed lightmaps: textures, the mesh, and a material that reads them.

Materials read the lightmaps at their own resolution: a kit has no mips. A kit of one lightmap has the files `atlas.*`,
and one of shared tiles has `scene.*` with a component that sets the objects' rectangles and states.
"""

from collections.abc import Callable
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
    """Writes the kit of compressed lightmaps.

    Args:
        bundle: The bundle.
        folder: The folder; it must exist.
        engine: One of `wlm.export.ENGINES`.

    Returns:
        Entries of the index: shader and textures.

    Raises:
        WlmError: The colours are ASTC, which the engine's kit can't load, the engine can't read the UV set, or a
            texture is larger than the engine accepts.
    """
    if bundle.model.mips:
        bundle = make_bundle(bundle.model.without_mips())
    pictures = engine in ("godot", "unreal")
    entries = _write_pictures(bundle, folder, engine) if pictures else _write_textures(bundle, folder, engine)
    for name, content in bundle.files.items():
        (folder / name).write_bytes(content)
    texts = (_SCENE if bundle.document["method"] == "shared" else _ONE)[engine](bundle, entries)
    write_texts(folder, texts)
    return {"shader": next(iter(texts)), "textures": entries}


def _write_textures(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    """Writes DDS files."""
    ending, entries = ".bytes" if engine == "unity" else None, {}
    for name, texture in bundle.textures.items():
        if texture.fmt not in DXGI_FORMATS:
            raise WlmError(f"{bundle.name}: cannot export for {engine}: there is no DDS of ASTC; compress with bc6h")
        if texture.image is not None and (texture.width % BLOCK_SIDE or texture.height % BLOCK_SIDE):
            # Direct3D and browsers refuse blocks that don't fill their texture.
            whole = np.concatenate([texture.image, np.ones((*texture.image.shape[:2], 1), np.float32)], 2)
            texture = Texture.from_texels(whole.astype("<f2"), "R16G16B16A16_FLOAT")
        entries[name] = write_texture(folder, name, texture, ending)
    return entries


def _write_pictures(bundle: Bundle, folder: Path, engine: str) -> dict[str, Any]:
    """Writes EXR files, the layers of an array one below the other; whole numbers are exact in floats."""
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


def _three(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    return {
        "atlas.glsl": bundle.shader,
        "atlas.js": filled("three_atlas.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_atlas.md", NAME=bundle.name),
    }


def _godot(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    return {
        "atlas.gdshader": filled("godot_atlas.gdshader", SHADER=godot_uniforms(bundle.shader)),
        README_FILE: filled("godot_atlas.md", NAME=bundle.name),
    }


def _unity(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    return {
        "WlmAtlas.hlsl": translate(bundle.shader, "hlsl"),
        "WlmAtlas.shader": filled("unity_atlas.shader"),
        "WlmAtlas.cs": filled("unity_atlas.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_atlas.md", NAME=bundle.name),
    }


def _unreal(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    code, _ = custom_node(bundle.shader, "wlm_atlas", "UV")
    place = asset_name(bundle.name)
    return {
        "wlm_atlas.py": filled("unreal_atlas.py.in", NAME=place, CODE=code, KIT=filled("unreal_kit.py.in")),
        README_FILE: filled("unreal_atlas.md", NAME=bundle.name, PLACE=place),
    }


def _scene_three(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    return {
        "scene.glsl": bundle.shader,
        "scene.js": filled("three_scene.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_scene.md", NAME=bundle.name),
    }


def _scene_godot(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    uv_set = bundle.document["uv_set"]
    if uv_set > 1:
        raise WlmError(
            f"{bundle.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1, the light is at {uv_set}"
        )
    shader = godot_uniforms(bundle.shader)
    return {
        "scene.gdshader": filled("godot_scene.gdshader", SHADER=shader, UV=("UV", "UV2")[uv_set]),
        "wlm_scene.gd": filled("godot_scene.gd"),
        README_FILE: filled("godot_scene.md", NAME=bundle.name),
    }


def _scene_unity(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    return {
        "WlmScene.hlsl": translate(bundle.shader, "hlsl"),
        "WlmScene.shader": filled("unity_scene.shader", SET=str(bundle.document["uv_set"])),
        "WlmScene.cs": filled("unity_scene.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_scene.md", NAME=bundle.name),
    }


def _scene_unreal(bundle: Bundle, entries: dict[str, Any]) -> dict[str, str]:
    arrays = {f"wlm_scene_{name}": (each.height, each.layers) for name, each in bundle.textures.items() if each.layers}
    code, _ = custom_node(bundle.shader, "wlm_object", "UV, Place, int(Sheet + 0.5), State", arrays)
    rows = [
        f'    "wlm_scene_{name}": {{"file": "{entry["file"]}", "form": "{_form(name)}", '
        f'"size": [{entry["width"]}, {entry["height"]}]}},\n'
        for name, entry in entries.items()
    ]
    place = asset_name(bundle.name)
    parts = {"CODE": code, "TEXTURES": "{\n" + "".join(rows) + "}", "KIT": filled("unreal_kit.py.in")}
    return {
        "wlm_scene.py": filled("unreal_scene.py.in", NAME=place, **parts),
        README_FILE: filled("unreal_scene.md", NAME=bundle.name, PLACE=place),
    }


def _form(name: str) -> str:
    return "halves" if name in ("colour", "blocks") else "floats"


_Texts = dict[str, Callable[[Bundle, dict[str, Any]], dict[str, str]]]
_ONE: _Texts = {"three": _three, "godot": _godot, "unity": _unity, "unreal": _unreal}
_SCENE: _Texts = {"three": _scene_three, "godot": _scene_godot, "unity": _scene_unity, "unreal": _scene_unreal}
