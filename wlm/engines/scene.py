"""The compressed lightmaps of a scene for an engine: a material that reads them, and their textures."""

import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from wlm.atlas.scene.exporter import REPORT_FILE, SCENE_FILE, read_scene
from wlm.atlas.scene.model import SceneModel
from wlm.atlas.scene.shader import scene_glsl
from wlm.engines import unreal
from wlm.engines.kit import ENGINES, README_FILE, check_sides, filled, godot_uniforms
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import made_parents, staged, write_index
from wlm.formats.shared_exponent import unpack_rgb9e5
from wlm.lightmap.packed import MOST_LAYERS
from wlm.shading import ENDINGS, check_language, custom_node, translate

FORMAT = "wlm-scene-engine"
INFO_FILE = "scene.json"
_VERSION = 1
# An object's part: its rectangle; texels and first entry of its sheet; its tiles and its page.
_OBJECT = """
vec3 wlm_object(vec2 uv, vec4 place, vec4 sheet, vec3 tiles)
{
    return wlm_scene(uv * place.xy + place.zw, sheet.xy, ivec2(sheet.zw), ivec2(tiles.xy), int(tiles.z));
}
"""
# Factors from a texture, a row for each state; `wlm_state` is a state's number, or between two.
_STATE = """\
uniform sampler2D wlm_factors;
uniform float wlm_state;
vec3 wlm_factor(int k)
{
    int last = textureSize(wlm_factors, 0).y - 1;
    float at = clamp(wlm_state, 0.0, float(last));
    vec3 early = texelFetch(wlm_factors, ivec2(k, int(at)), 0).xyz;
    return mix(early, texelFetch(wlm_factors, ivec2(k, min(int(at) + 1, last)), 0).xyz, at - float(int(at)));
}
#define WLM_SCENE_FACTOR(k) wlm_factor(k)
"""

Pictures = dict[str, tuple[str, str, list[int]]]


def export_scene(
    source: str | os.PathLike[str], directory: str | os.PathLike[str], engine: str, *, shader: str = "glsl"
) -> list[Path]:
    """Writes what `wlm atlas compress` left of a scene for an engine: textures, the scene, materials, and a page.

    Args:
        source: The folder of the compression.
        directory: Another folder; made if it isn't there. A new export replaces an earlier one.
        engine: One of `wlm.engines.ENGINES`, or "raw": the shader alone beside textures and scene.
        shader: Of "raw", its language, one of `wlm.shading.LANGUAGES`.

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
    info: dict[str, Any] = {
        "format": FORMAT,
        "version": _VERSION,
        "name": model.name,
        "source": model.source,
        "states": list(model.states),
        "factors": model.factor.tolist(),
        "sheets": [asdict(sheet) for sheet in model.sheets],
        "objects": objects,
        "uv_set": uv_set,
    }
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        if engine in ("godot", "unreal"):
            info["layer_height"] = model.texels.shape[1]
            pictures = _write_pictures(model, staging, engine)
        else:
            pictures = {}
            _write_textures(model, staging, ".bytes" if engine == "unity" else ".dds")
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


def _write_textures(model: SceneModel, folder: Path, ending: str) -> None:
    """The table and the texture array; for Unity the factors too, as its reader of JSON has no arrays of arrays."""
    rows, columns = model.lut.shape[:2]
    lut = np.ascontiguousarray(model.lut, "<u2").tobytes()
    count, height, width = model.texels.shape
    if count > MOST_LAYERS:
        raise WlmError(f"{model.name}: cannot export: {count} layers of colours, of at most {MOST_LAYERS}")
    texels = np.ascontiguousarray(model.texels, "<u4").tobytes()
    write_dds(folder / "lut.dds", lut, columns, rows, fmt="R16G16_UINT")
    write_dds(folder / "colour.dds", texels, width, height, fmt="R9G9B9E5_SHAREDEXP", layers=count)
    if ending != ".dds":
        for name in ("lut", "colour"):
            (folder / f"{name}.dds").rename(folder / (name + ending))
        (folder / f"factors{ending}").write_bytes(_factors(model).astype("<f4").tobytes())


def _write_pictures(model: SceneModel, folder: Path, engine: str) -> Pictures:
    """The same as EXRs, the layers one below the other: file, form and size by the shader's names."""
    pictures = {
        "wlm_scene_lut": ("lut.exr", "floats", np.pad(model.lut, ((0, 0), (0, 0), (0, 1)))),
        "wlm_scene_colour": ("colour.exr", "halves", unreal.stacked(unpack_rgb9e5(model.texels))),
    }
    if engine == "unreal":
        pictures["wlm_factors"] = ("factors.exr", "floats", _factors(model))
    made = {}
    for name, (file, form, pixels) in pictures.items():
        height, width = pixels.shape[:2]
        check_sides(model.name, engine, file, pixels)
        write_exr(folder / file, np.asarray(pixels, np.float32), half=form == "halves")
        made[name] = file, form, [width, height]
    return made


def _factors(model: SceneModel) -> np.ndarray:
    """The factors as fours, float32 [M, K, 4]."""
    return np.pad(model.factor, ((0, 0), (0, 0), (0, 1)))


def _raw(model: SceneModel, language: str) -> dict[str, str]:
    return {"scene" + ENDINGS[language]: translate(scene_glsl(model) + _OBJECT, language)}


def _three(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    return {
        "scene.glsl": scene_glsl(model) + _OBJECT,
        "scene.js": filled("three_scene.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_scene.md", NAME=model.name),
    }


def _godot(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    if uv_set > 1:
        raise WlmError(
            f"{model.name}: cannot export for godot: its shaders read TEXCOORD_0 and 1, the light is at {uv_set}"
        )
    shader = godot_uniforms(scene_glsl(model) + _OBJECT)
    return {
        "scene.gdshader": filled("godot_scene.gdshader", SHADER=shader, UV=("UV", "UV2")[uv_set]),
        "wlm_scene.gd": filled("godot_scene.gd"),
        README_FILE: filled("godot_scene.md", NAME=model.name),
    }


def _unity(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    # Of float3 in an array of constants it isn't said how far apart they are.
    count = model.factor.shape[1]
    factors = f"uniform vec4 wlm_factors[{count}];\n#define WLM_SCENE_FACTOR(k) wlm_factors[k].xyz\n"
    return {
        "WlmScene.hlsl": translate(factors + scene_glsl(model) + _OBJECT, "hlsl"),
        "WlmScene.shader": filled("unity_scene.shader", SET=str(uv_set)),
        "WlmScene.cs": filled("unity_scene.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_scene.md", NAME=model.name),
    }


def _unreal(model: SceneModel, uv_set: int, pictures: Pictures) -> dict[str, str]:
    count, height, _ = model.texels.shape
    arguments = "UV, Place, Sheet, Tiles.xyz"
    code, _ = custom_node(
        _STATE + scene_glsl(model) + _OBJECT, "wlm_object", arguments, {"wlm_scene_colour": (height, count)}
    )
    rows = [
        f'    "{name}": {{"file": "{file}", "form": "{form}", "size": {size}}},\n'
        for name, (file, form, size) in pictures.items()
    ]
    place = unreal.asset_name(model.name)
    parts = {"CODE": code, "TEXTURES": "{\n" + "".join(rows) + "}", "KIT": filled("unreal_kit.py.in")}
    return {
        "wlm_scene.py": filled("unreal_scene.py.in", NAME=place, **parts),
        README_FILE: filled("unreal_scene.md", NAME=model.name, PLACE=place),
    }


_TEXTS: dict[str, Callable[[SceneModel, int, Pictures], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
    "unreal": _unreal,
}
_STEMS = {"scene", "lut", "colour", "factors", "wlm_scene", "WlmScene"}
_ENDINGS = {*ENDINGS.values(), ".dds", ".exr", ".bytes", ".js", ".gd", ".gdshader", ".shader", ".cs", ".py"}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that such a folder may have."""
    path = Path(name)
    return name in (SCENE_FILE, README_FILE, INFO_FILE) or (path.stem in _STEMS and path.suffix in _ENDINGS)
