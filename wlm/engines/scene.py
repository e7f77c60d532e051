"""The compressed lightmaps of a scene for an engine: a material that reads them, and their textures."""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from wlm.atlas.bundles import MESH_FILE, bundle, sheet_texels
from wlm.atlas.model import AtlasModel
from wlm.atlas.shader import glsl
from wlm.bundle import Bundle
from wlm.engines import unreal
from wlm.engines.kit import README_FILE, check_sides, filled, godot_uniforms
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import made_parents, staged, write_index
from wlm.lightmap.packed import MOST_LAYERS
from wlm.shading import ENDINGS, custom_node, translate

FORMAT = "wlm-scene-engine"
INFO_FILE = "scene.json"
_VERSION = 1

Pictures = dict[str, tuple[str, str, list[int]]]


def export_scene(
    model: AtlasModel, directory: str | os.PathLike[str], engine: str, *, shader: str = "glsl"
) -> list[Path]:
    """Writes shared tiles for an engine, as `wlm.engines.atlas.export_atlas`.

    Engines' materials read the sheets alone: `wlm_scene_grad` of a model with mips is in "raw" only.
    """
    folder = Path(directory)
    if engine != "raw":
        model = model.without_mips()
    made = bundle(model)
    uv_set = made.document["uv_set"]
    info: dict[str, Any] = {
        "format": FORMAT,
        "version": _VERSION,
        **{name: made.document[name] for name in ("name", "source", "states", "sheets", "objects", "uv_set")},
    }
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        if engine in ("godot", "unreal"):
            info["layer_heights"] = made.document["layer_heights"]
            pictures = _write_pictures(model, staging, engine)
        else:
            pictures = _write_textures(made, staging, ".bytes" if engine == "unity" else ".dds")
        info["textures"] = {name: file for name, (file, _, _) in pictures.items()}
        texts = _raw(model, shader) if engine == "raw" else _TEXTS[engine](model, uv_set, pictures)
        (staging / MESH_FILE).write_bytes(made.files[MESH_FILE])
        for name, text in texts.items():
            (staging / name).write_bytes(text.encode())
        write_index(staging / INFO_FILE, info)
        names = sorted(path.name for path in staging.iterdir() if path.name != INFO_FILE)
    return [folder / name for name in (*names, INFO_FILE)]


def _write_textures(made: Bundle, folder: Path, ending: str) -> Pictures:
    """All textures as DDS files: file, form and size by name."""
    files = {}
    for name, each in made.textures.items():
        if each.layers > MOST_LAYERS:
            raise WlmError(f"{made.name}: cannot export: {each.layers} layers of {name}, of at most {MOST_LAYERS}")
        # Under another ending in Unity's folder.
        data = np.ascontiguousarray(each.data).tobytes()
        write_dds(folder / f"{name}.dds", data, each.width, each.height, fmt=each.fmt, layers=each.layers)
        (folder / f"{name}.dds").rename(folder / (name + ending))
        files[name] = name + ending, each.fmt, [each.width, each.height]
    return files


def _write_pictures(model: AtlasModel, folder: Path, engine: str) -> Pictures:
    """The same as EXRs, the layers one below the other; the whole numbers are below 65,536, which floats hold."""
    pictures = {
        "sheets": ("floats", sheet_texels(model)),
        "lut": ("floats", np.pad(model.lut, ((0, 0), (0, 0), (0, 4 - model.lut.shape[2])))),
        "factors": ("floats", np.pad(model.factor, ((0, 0), (0, 0), (0, 1)))),
        "colour": ("halves", unreal.stacked(model.texels)),
    }
    if model.colour == "mixed":
        pictures["blocks"] = ("halves", unreal.stacked(model.block_texels))
    made = {}
    for name, (form, pixels) in pictures.items():
        height, width = pixels.shape[:2]
        check_sides(model.name, engine, f"{name}.exr", pixels)
        write_exr(folder / f"{name}.exr", np.asarray(pixels, np.float32), half=form == "halves")
        made[name] = f"{name}.exr", form, [width, height]
    return made


def _raw(model: AtlasModel, language: str) -> dict[str, str]:
    return {"scene" + ENDINGS[language]: translate(glsl(model), language)}


def _three(model: AtlasModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    return {
        "scene.glsl": glsl(model),
        "scene.js": filled("three_scene.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_scene.md", NAME=model.name),
    }


def _godot(model: AtlasModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    if uv_set > 1:
        raise WlmError(
            f"{model.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1, the light is at {uv_set}"
        )
    shader = godot_uniforms(glsl(model))
    return {
        "scene.gdshader": filled("godot_scene.gdshader", SHADER=shader, UV=("UV", "UV2")[uv_set]),
        "wlm_scene.gd": filled("godot_scene.gd"),
        README_FILE: filled("godot_scene.md", NAME=model.name),
    }


def _unity(model: AtlasModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    return {
        "WlmScene.hlsl": translate(glsl(model), "hlsl"),
        "WlmScene.shader": filled("unity_scene.shader", SET=str(uv_set)),
        "WlmScene.cs": filled("unity_scene.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_scene.md", NAME=model.name),
    }


def _unreal(model: AtlasModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    layers = {f"wlm_scene_{name}": (pages.shape[1], len(pages)) for name, pages in _layered(model).items()}
    code, _ = custom_node(glsl(model), "wlm_object", "UV, Place, int(Sheet + 0.5), State", layers)
    rows = [
        f'    "wlm_scene_{name}": {{"file": "{file}", "form": "{form}", "size": {size}}},\n'
        for name, (file, form, size) in pictures.items()
    ]
    place = unreal.asset_name(model.name)
    parts = {"CODE": code, "TEXTURES": "{\n" + "".join(rows) + "}", "KIT": filled("unreal_kit.py.in")}
    return {
        "wlm_scene.py": filled("unreal_scene.py.in", NAME=place, **parts),
        README_FILE: filled("unreal_scene.md", NAME=model.name, PLACE=place),
    }


def _layered(model: AtlasModel) -> dict[str, np.ndarray]:
    """The textures that are arrays: pages, rows, columns."""
    return {"colour": model.texels} | ({"blocks": model.block_texels} if model.colour == "mixed" else {})


_TEXTS: dict[str, Callable[[AtlasModel, int, Pictures], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
    "unreal": _unreal,
}
_STEMS = {"scene", "sheets", "lut", "factors", "colour", "blocks", "wlm_scene", "WlmScene"}
_ENDINGS = {*ENDINGS.values(), ".dds", ".exr", ".bytes", ".js", ".gd", ".gdshader", ".shader", ".cs", ".py"}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that such a folder may have."""
    path = Path(name)
    return name in (MESH_FILE, README_FILE, INFO_FILE) or (path.stem in _STEMS and path.suffix in _ENDINGS)
