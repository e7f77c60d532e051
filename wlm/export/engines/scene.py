"""The compressed lightmaps of a scene for an engine: a material that reads them, and their textures."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from wlm.atlas.scene.exporter import LUT_FORMATS, REPORT_FILE, SCENE_FILE, factor_texels, read_scene, sheet_texels
from wlm.atlas.scene.model import SceneModel
from wlm.atlas.scene.shader import scene_glsl
from wlm.errors import WlmError
from wlm.export.engines.kit import ENGINES, README_FILE, asset_name, check_sides, filled, godot_uniforms, stacked
from wlm.export.shading import ENDINGS, check_language, custom_node, translate
from wlm.formats.dds import write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import made_parents, staged, write_index
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.bundle import MOST_LAYERS

FORMAT = "wlm-bundle"
INFO_FILE = "bundle.json"
_VERSION = 1
# An object's part: its rectangle, the number of its sheet, and the state.
_OBJECT = """
// An object's light: `place` is its scale and offset, and `sheet` its number, in `objects` of scene.json.
vec3 wlm_object(vec2 uv, vec4 place, int sheet, float state)
{
    return wlm_scene(uv * place.xy + place.zw, sheet, max(state, 0.0));
}
"""

Pictures = dict[str, tuple[str, str, list[int]]]


def export_scene(
    source: str | os.PathLike[str], directory: str | os.PathLike[str], engine: str, *, shader: str = "glsl"
) -> list[Path]:
    """Writes what `wlm atlas compress` left of a scene for an engine: textures, the scene, materials, and a page.

    Engines' materials read the sheets alone: `wlm_scene_grad` of a model with mips is in "raw" only.

    Args:
        source: The folder of the compression.
        directory: Another folder; made if it isn't there. A new export replaces an earlier one.
        engine: One of `wlm.export.engines.ENGINES`, or "raw": the shader alone beside textures and scene.
        shader: Of "raw", its language, one of `wlm.export.shading.LANGUAGES`.

    Returns:
        The files written, `scene.json` last.

    Raises:
        WlmError: No such engine or language, the folder holds something else, or a file is missing or can't be written.
    """
    if engine not in (*ENGINES, "raw"):
        raise WlmError(f"engine: expected one of raw, {', '.join(ENGINES)}, got {engine!r}")
    check_language(shader)
    folder, source = Path(directory), Path(source)
    model, report = read_scene(source)
    if folder.resolve() == source.resolve():
        raise WlmError(f"{folder}: expected another folder than that of the compression")
    objects, uv_set = report.get("objects"), report.get("uv_set")
    if not isinstance(objects, list) or not isinstance(uv_set, int):
        raise WlmError(f"{source / REPORT_FILE}: expected objects and uv_set; compress again")
    if engine != "raw":
        model = model.without_levels()
    info: dict[str, Any] = {
        "format": FORMAT,
        "system": "atlas",
        "engine": engine,
        "version": _VERSION,
        "name": model.name,
        "source": model.source,
        "states": list(model.states),
        "sheets": [{"name": each.name, "size": [each.width, each.height]} for each in model.sheets],
        "objects": objects,
        "uv_set": uv_set,
    }
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        if engine in ("godot", "unreal"):
            info["layer_heights"] = {name: pages.shape[1] for name, pages in _layered(model).items()}
            pictures = _write_pictures(model, staging, engine)
        else:
            pictures = _write_textures(model, staging, ".bytes" if engine == "unity" else ".dds")
        layers = {name: len(pages) for name, pages in _layered(model).items()}
        info["textures"] = {
            name: {"file": file, "width": size[0], "height": size[1], "layers": layers.get(name, 0)}
            for name, (file, _, size) in pictures.items()
        }
        texts = _raw(model, shader) if engine == "raw" else _TEXTS[engine](model, uv_set, pictures)
        try:
            shutil.copyfile(source / SCENE_FILE, staging / SCENE_FILE)
        except FileNotFoundError as error:
            raise WlmError(f"{source / SCENE_FILE}: no such file; compress again") from error
        for name, text in texts.items():
            (staging / name).write_bytes(text.encode())
        write_index(staging / INFO_FILE, info)
        names = sorted(path.name for path in staging.iterdir() if path.name != INFO_FILE)
    return [folder / name for name in (*names, INFO_FILE)]


def _write_textures(model: SceneModel, folder: Path, ending: str) -> Pictures:
    """All textures as DDS files: file, form and size by name."""
    textures = {
        "sheets": ("R16G16B16A16_UINT", sheet_texels(model)),
        "lut": (LUT_FORMATS[model.lut.shape[2]], model.lut.astype("<u2")),
        "factors": ("R32G32B32A32_FLOAT", factor_texels(model)),
        "colour": ("R9G9B9E5_SHAREDEXP", model.texels.astype("<u4")),
    }
    if model.colour == "mixed":
        textures["blocks"] = ("BC6H_UF16", model.blocks)
    layered, made = _layered(model), {}
    for name, (form, texels) in textures.items():
        layers = len(texels) if name in layered else 0
        height, width = layered[name].shape[1:3] if layers else texels.shape[:2]
        if layers > MOST_LAYERS:
            raise WlmError(f"{model.name}: cannot export: {layers} layers of {name}, of at most {MOST_LAYERS}")
        # Under another ending in Unity's folder.
        write_dds(folder / f"{name}.dds", texels.tobytes(), width, height, fmt=form, layers=layers)
        (folder / f"{name}.dds").rename(folder / (name + ending))
        made[name] = name + ending, form, [width, height]
    return made


def _write_pictures(model: SceneModel, folder: Path, engine: str) -> Pictures:
    """The same as EXRs, the layers one below the other; the whole numbers are below 65,536, which floats hold."""
    pictures = {
        "sheets": ("floats", sheet_texels(model)),
        "lut": ("floats", np.pad(model.lut, ((0, 0), (0, 0), (0, 4 - model.lut.shape[2])))),
        "factors": ("floats", factor_texels(model)),
        "colour": ("halves", stacked(unpack_rgb9e5(model.texels))),
    }
    if model.colour == "mixed":
        pictures["blocks"] = ("halves", stacked(model.block_texels))
    made = {}
    for name, (form, pixels) in pictures.items():
        height, width = pixels.shape[:2]
        check_sides(model.name, engine, f"{name}.exr", pixels)
        write_exr(folder / f"{name}.exr", np.asarray(pixels, np.float32), half=form == "halves")
        made[name] = f"{name}.exr", form, [width, height]
    return made


def _glsl(model: SceneModel) -> str:
    return scene_glsl(model) + _OBJECT


def _raw(model: SceneModel, language: str) -> dict[str, str]:
    return {"scene" + ENDINGS[language]: translate(_glsl(model), language)}


def _three(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    return {
        "scene.glsl": _glsl(model),
        "scene.js": filled("three_scene.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_scene.md", NAME=model.name),
    }


def _godot(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    if uv_set > 1:
        raise WlmError(
            f"{model.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1, the light is at {uv_set}"
        )
    shader = godot_uniforms(_glsl(model))
    return {
        "scene.gdshader": filled("godot_scene.gdshader", SHADER=shader, UV=("UV", "UV2")[uv_set]),
        "wlm_scene.gd": filled("godot_scene.gd"),
        README_FILE: filled("godot_scene.md", NAME=model.name),
    }


def _unity(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    return {
        "WlmScene.hlsl": translate(_glsl(model), "hlsl"),
        "WlmScene.shader": filled("unity_scene.shader", SET=str(uv_set)),
        "WlmScene.cs": filled("unity_scene.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_scene.md", NAME=model.name),
    }


def _unreal(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    layers = {f"wlm_scene_{name}": (pages.shape[1], len(pages)) for name, pages in _layered(model).items()}
    code, _ = custom_node(_glsl(model), "wlm_object", "UV, Place, int(Sheet + 0.5), State", layers)
    rows = [
        f'    "wlm_scene_{name}": {{"file": "{file}", "form": "{form}", "size": {size}}},\n'
        for name, (file, form, size) in pictures.items()
    ]
    place = asset_name(model.name)
    parts = {"CODE": code, "TEXTURES": "{\n" + "".join(rows) + "}", "KIT": filled("unreal_kit.py.in")}
    return {
        "wlm_scene.py": filled("unreal_scene.py.in", NAME=place, **parts),
        README_FILE: filled("unreal_scene.md", NAME=model.name, PLACE=place),
    }


def _layered(model: SceneModel) -> dict[str, np.ndarray]:
    """The textures that are arrays: pages, rows, columns."""
    return {"colour": model.texels} | ({"blocks": model.block_texels} if model.colour == "mixed" else {})


_TEXTS: dict[str, Callable[[SceneModel, int, Pictures], dict[str, str]]] = {
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
    return name in (SCENE_FILE, README_FILE, INFO_FILE) or (path.stem in _STEMS and path.suffix in _ENDINGS)
