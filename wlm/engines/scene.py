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
from wlm.engines.kit import ENGINES, README_FILE, filled
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.formats.folder import made_parents, staged, write_index
from wlm.shading import ENDINGS, check_language, translate

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
    texts = _raw(model, shader) if engine == "raw" else _TEXTS[engine](model)
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        _write_textures(model, staging)
        try:
            shutil.copyfile(source / SCENE_FILE, staging / SCENE_FILE)
        except FileNotFoundError as error:
            raise WlmError(f"{source / SCENE_FILE}: no such file; compress again") from error
        for name, text in texts.items():
            (staging / name).write_bytes(text.encode())
        write_index(staging / INFO_FILE, info)
        names = sorted(path.name for path in staging.iterdir() if path.name != INFO_FILE)
    return [folder / name for name in (*names, INFO_FILE)]


def _write_textures(model: SceneModel, folder: Path) -> None:
    rows, columns = model.lut.shape[:2]
    lut = np.ascontiguousarray(model.lut, "<u2").tobytes()
    write_dds(folder / "lut.dds", lut, columns, rows, fmt="R16G16_UINT")
    count, height, width = model.texels.shape
    texels = np.ascontiguousarray(model.texels, "<u4").tobytes()
    write_dds(folder / "colour.dds", texels, width, height, fmt="R9G9B9E5_SHAREDEXP", layers=count)


def _raw(model: SceneModel, language: str) -> dict[str, str]:
    return {"scene" + ENDINGS[language]: translate(scene_glsl(model) + _OBJECT, language)}


def _three(model: SceneModel) -> dict[str, str]:
    return {
        "scene.glsl": scene_glsl(model) + _OBJECT,
        "scene.js": filled("three_scene.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_scene.md", NAME=model.name),
    }


_TEXTS: dict[str, Callable[[SceneModel], dict[str, str]]] = {"three": _three}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that such a folder may have."""
    path = Path(name)
    ours = path.stem in ("scene", "lut", "colour") and path.suffix in {*ENDINGS.values(), ".dds", ".js"}
    return ours or name in (SCENE_FILE, README_FILE, INFO_FILE)
