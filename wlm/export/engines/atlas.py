"""A compressed lightmap for an engine: a material that reads it, and its textures."""

import dataclasses
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from wlm.atlas.exporter import MESH_FILE, Output
from wlm.atlas.model import BLOCK_SIDE, AtlasModel
from wlm.atlas.shader import atlas_glsl
from wlm.errors import WlmError
from wlm.export.engines.kit import ENGINES, README_FILE, asset_name, filled, godot_uniforms
from wlm.export.shading import ENDINGS, check_language, custom_node, translate
from wlm.formats.dds import write_dds
from wlm.formats.folder import made_parents, staged, write_index

FORMAT = "wlm-bundle"
_VERSION = 1
INFO_FILE = "bundle.json"


def export_atlas(
    output: Output, directory: str | os.PathLike[str], engine: str, *, shader: str = "glsl", exact: bool = False
) -> list[Path]:
    """Writes what `wlm atlas compress` left for an engine: textures, the mesh, a material, and a page about it.

    Engines' materials read the tiles alone: the mips of a model that has some are in "raw" only.

    Args:
        output: The folder of the compression.
        directory: Another folder; made if it isn't there. A new export replaces an earlier one.
        engine: One of `wlm.export.engines.ENGINES`, or "raw": the shader alone beside textures and mesh.
        shader: Of "raw", its language, one of `wlm.export.shading.LANGUAGES`.
        exact: Of "raw", texels are fetched and mixed in floats rather than filtered.

    Returns:
        The files written, `atlas.json` last.

    Raises:
        WlmError: No such engine or language, a colour texture in ASTC for an engine that has no such textures, the
            folder holds something else, or a file is missing or can't be written.
    """
    if engine not in (*ENGINES, "raw"):
        raise WlmError(f"engine: expected one of raw, {', '.join(ENGINES)}, got {engine!r}")
    check_language(shader)
    model, ending = output.model, ".exr" if engine in ("godot", "unreal") else ".dds"
    if model.colour == "astc" and engine == "raw":
        ending = ".ktx2"
    if model.colour == "astc" and ending == ".dds":
        raise WlmError(f"{output.folder}: cannot export for {engine}: there is no DDS of ASTC; compress with bc6h")
    if engine != "raw":
        model = dataclasses.replace(model, tail=model.tail[:0])
    has = {"lut": model.method != "plain", "blocks": model.colour == "mixed", "tail": len(model.tail) > 0}
    names = ["colour", *(name for name, given in has.items() if given)]
    sizes = {name: made.shape[1::-1] for name, made in _made(model).items()}
    texts = _raw(model, shader, exact) if engine == "raw" else _TEXTS[engine](model)
    files = {name: name + (".bytes" if engine == "unity" else ending) for name in names}
    folder = Path(directory)
    if folder.resolve() == output.folder.resolve():
        raise WlmError(f"{folder}: expected another folder than that of the compression")
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        for name, file in files.items():
            if name == "colour" and engine != "raw" and ending == ".dds" and _odd_blocks(model):
                _write_halves(staging / file, model.texels)
            else:
                _copy(output.folder / (name + ending), staging / file)
        _copy(output.folder / MESH_FILE, staging / MESH_FILE)
        for name, text in texts.items():
            (staging / name).write_bytes(text.encode())
        info = {
            "format": FORMAT,
            "version": _VERSION,
            "name": model.name,
            "source": model.source,
            "method": model.method,
            "colour": model.colour,
            "system": "atlas",
            "engine": engine,
            "textures": {
                name: {"file": file, "width": sizes[name][0], "height": sizes[name][1], "layers": 0}
                for name, file in files.items()
            },
            "shader": next(iter(texts)),
            "uv_set": output.report.get("new_uv_set") if len(model.uv) else output.report.get("uv_set"),
        }
        write_index(staging / INFO_FILE, info)
    return [folder / name for name in (*texts, *files.values(), MESH_FILE, INFO_FILE)]


def _made(model: AtlasModel) -> dict[str, np.ndarray]:
    """The model's textures by name."""
    return {"colour": model.texels, "lut": model.lut, "blocks": model.block_texels, "tail": model.tail}


def _odd_blocks(model: AtlasModel) -> bool:
    """Whether the colours are blocks that don't fill their texture, which Direct3D and browsers refuse."""
    return model.colour == "bc6h" and any(side % BLOCK_SIDE for side in model.texels.shape[:2])


def _write_halves(path: Path, texels: np.ndarray) -> None:
    height, width = texels.shape[:2]
    whole = np.concatenate([texels.astype("<f2"), np.ones((height, width, 1), "<f2")], 2)
    # Under another ending in Unity's folder.
    made = path.with_suffix(".dds")
    write_dds(made, whole.tobytes(), width, height, fmt="R16G16B16A16_FLOAT")
    made.rename(path)


def _copy(source: Path, target: Path) -> None:
    try:
        shutil.copyfile(source, target)
    except FileNotFoundError as error:
        raise WlmError(f"{source}: no such file; compress again") from error


def _raw(model: AtlasModel, language: str, exact: bool) -> dict[str, str]:
    text = translate(atlas_glsl(model), language, ["WLM_ATLAS_EXACT"] if exact else [])
    return {"atlas" + ENDINGS[language]: text}


def _three(model: AtlasModel) -> dict[str, str]:
    return {
        "atlas.glsl": atlas_glsl(model),
        "atlas.js": filled("three_atlas.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_atlas.md", NAME=model.name),
    }


def _godot(model: AtlasModel) -> dict[str, str]:
    return {
        "atlas.gdshader": filled("godot_atlas.gdshader", SHADER=godot_uniforms(atlas_glsl(model))),
        README_FILE: filled("godot_atlas.md", NAME=model.name),
    }


def _unity(model: AtlasModel) -> dict[str, str]:
    return {
        "WlmAtlas.hlsl": translate(atlas_glsl(model), "hlsl"),
        "WlmAtlas.shader": filled("unity_atlas.shader"),
        "WlmAtlas.cs": filled("unity_atlas.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_atlas.md", NAME=model.name),
    }


def _unreal(model: AtlasModel) -> dict[str, str]:
    code, _ = custom_node(atlas_glsl(model), "wlm_atlas", "UV")
    place = asset_name(model.name)
    return {
        "wlm_atlas.py": filled("unreal_atlas.py.in", NAME=place, CODE=code, KIT=filled("unreal_kit.py.in")),
        README_FILE: filled("unreal_atlas.md", NAME=model.name, PLACE=place),
    }


_TEXTS: dict[str, Callable[[AtlasModel], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
    "unreal": _unreal,
}
_STEMS = {"atlas", "colour", "lut", "blocks", "tail", "WlmAtlas", "wlm_atlas"}
# ".usf" is of earlier versions.
_ENDINGS = {*ENDINGS.values(), ".dds", ".ktx2", ".exr", ".bytes", ".js", ".gdshader", ".shader", ".cs", ".py", ".usf"}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that such a folder may have."""
    path = Path(name)
    return name in (MESH_FILE, README_FILE, INFO_FILE) or (path.stem in _STEMS and path.suffix in _ENDINGS)
