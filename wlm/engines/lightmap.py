"""A lightmap over the day for an engine: its decoder in the engine's own languages, and what it reads."""

import os
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from wlm.engines import unreal
from wlm.engines.kit import ENGINES, README_FILE, filled
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.formats.folder import made_parents, read_index, staged, write_index
from wlm.lightmap import exporter, packed
from wlm.lightmap.layers.exporter import SheetFolders, export_sheets
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import Sheet
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.shader import decode_glsl, texture_names
from wlm.shading import translate

FORMAT = "wlm-lightmap-engine"
MASK_FILE = "valid.dds"
LAYERS_FORMAT = "wlm-lightmap-layers-engine"
UNITY_SCRIPT = "WlmLightmap.cs"
"""The component of Unity, which a project can have but once."""
_ABOUT = "Each sheet is a folder whose README.md says how to use it: the light of an atlas."
_UNREAL_KEYS = ("format", "version", "name", "source", "width", "height", "times", "period")


def export_lightmap(model: LightmapModel | LayeredModel, directory: str | os.PathLike[str], engine: str) -> list[Path]:
    """Writes a model for an engine: textures, floats, a component that decodes them, and a page about it.

    Of a model with layers each sheet of light has a folder of its own, and `sheets.json` says which is whose; the
    components show light alone.

    Args:
        model: The model.
        directory: The folder; made if it isn't there. A new export replaces an earlier one.
        engine: One of `wlm.engines.ENGINES`.

    Returns:
        The files written, `weights.json` last, or `sheets.json`.

    Raises:
        WlmError: No such engine, no layer of light, or as `wlm.lightmap.export`.
    """
    if engine not in ENGINES:
        raise WlmError(f"engine: expected one of {', '.join(ENGINES)}, got {engine!r}")
    if isinstance(model, LayeredModel):
        return _export_sheets(model, Path(directory), engine)
    return _export(model, Path(directory), engine)


def _export_sheets(model: LayeredModel, folder: Path, engine: str) -> list[Path]:
    chosen = [sheet for sheet in model.sheets if not sheet.linear]
    if not chosen:
        found = ", ".join(dict.fromkeys(sheet.layer for sheet in model.sheets))
        raise WlmError(f"{model.name}: cannot export for {engine}: expected a layer of light, found {found}")
    script = None if engine != "unity" else _unity(model.sheets[chosen[0]])[UNITY_SCRIPT]

    def write(sheet: Sheet, place: Path) -> list[Path]:
        # Engines name materials and shaders after the model.
        own = replace(model.sheets[sheet], name=f"{model.name} {sheet.label.replace('/', ' ')}")
        return _export(own, place, engine, without=UNITY_SCRIPT)

    kind = SheetFolders(LAYERS_FORMAT, _ABOUT, FORMAT, _is_exported, {UNITY_SCRIPT: script})
    return export_sheets(model, folder, chosen, kind, write)


def _export(model: LightmapModel, folder: Path, engine: str, without: str | None = None) -> list[Path]:
    with made_parents(folder), staged(folder, exporter.WEIGHTS_FILE, FORMAT, _is_exported) as staging:
        parts = exporter.write_parts(model, staging, form=FORMAT)
        (staging / exporter.VALID_FILE).unlink()
        height, width = model.mask.shape
        mask = model.mask.astype(np.uint8) * 255
        write_dds(staging / MASK_FILE, mask.tobytes(), width, height, fmt="R8_UNORM")
        parts = [MASK_FILE if name == exporter.VALID_FILE else name for name in parts]
        if engine == "unity":
            # Unity reads files of bytes under this ending alone.
            for name in parts[:-1]:
                (staging / name).rename(staging / _of_unity(name))
            parts = [*map(_of_unity, parts[:-1]), parts[-1]]
        if engine == "unreal":
            # Of other files, and tables of them, its script reads none.
            for name in parts[:-1]:
                (staging / name).unlink()
            index = read_index(staging / parts[-1])
            write_index(staging / parts[-1], {key: index[key] for key in _UNREAL_KEYS})
            texts = unreal.write_lightmap(model, staging)
            parts = [*sorted(path.name for path in staging.iterdir() if path.name != parts[-1]), parts[-1]]
        else:
            texts = _TEXTS[engine](model)
        if without is not None:
            texts.pop(without, None)
        for name, text in texts.items():
            (staging / name).write_bytes(text.encode())
    return [folder / name for name in (*texts, *parts)]


def _of_unity(name: str) -> str:
    return Path(name).with_suffix(".bytes").name


def _three(model: LightmapModel) -> dict[str, str]:
    script = filled("three_lightmap.js", DDS=filled("three_dds.js"), TABLE=packed.table_script())
    return {
        "lightmap.js": script,
        exporter.SHADER_STEM + ".glsl": decode_glsl(model),
        README_FILE: filled("three_lightmap.md", NAME=model.name),
    }


def _godot(model: LightmapModel) -> dict[str, str]:
    names = texture_names(model)
    bindings = "".join(f"#define WLM_LIGHTMAP_{name.upper()}_BINDING {i}\n" for i, name in enumerate(names))
    shader = bindings + decode_glsl(model)
    listed = ", ".join(f'"{name}"' for name in names)
    return {
        "lightmap.glsl": filled("godot_lightmap.glsl", SHADER=shader),
        "wlm_lightmap.gd": filled("godot_lightmap.gd", NAMES=listed),
        "lit.gdshader": filled("godot_lit.gdshader"),
        README_FILE: filled("godot_lightmap.md", NAME=model.name),
    }


def _unity(model: LightmapModel) -> dict[str, str]:
    return {
        "WlmLightmap.hlsl": translate(decode_glsl(model), "hlsl"),
        "WlmLightmap.shader": filled("unity_lightmap.shader", NAME=re.sub(r"[^\w .-]", "_", model.name)),
        UNITY_SCRIPT: filled("unity_lightmap.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_lightmap.md", NAME=model.name),
    }


_TEXTS: dict[str, Callable[[LightmapModel], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
}
# ".usf" is of earlier versions.
_ENDINGS = {".hlsl", ".shader", ".cs", ".py", ".gd", ".gdshader", ".js", ".glsl", ".usf"}
_STEMS = {"lightmap", "lit", "wlm_lightmap", "WlmLightmap"}
_BYTES = {f"{name}.bytes" for name in ("uv", "uvt", "planes", "frames", "video", "networks", "hours", "valid")}
_PICTURES = {f"{name}.tga" for name in ("uv", "uvt", "planes", "frames", "valid")} | {
    f"{name}.exr" for name in ("video", "hour", "networks")
}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that an export for an engine may have."""
    path = Path(name)
    ours = path.stem in _STEMS and path.suffix in _ENDINGS
    return ours or name in (README_FILE, MASK_FILE) or name in _BYTES | _PICTURES or exporter.is_exported(name)
