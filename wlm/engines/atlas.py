"""Compressed lightmaps for an engine: a material that reads them, and their textures."""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from wlm.atlas.bundles import MESH_FILE, bundle
from wlm.atlas.model import BLOCK_SIDE, AtlasModel
from wlm.atlas.shader import glsl
from wlm.bundle import Texture
from wlm.engines import unreal
from wlm.engines.kit import ENGINES, README_FILE, filled, godot_uniforms
from wlm.engines.scene import export_scene
from wlm.errors import WlmError
from wlm.formats.dds import write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import made_parents, staged, write_index
from wlm.formats.ktx2 import write_ktx2
from wlm.shading import ENDINGS, check_language, translate

FORMAT = "wlm-atlas-engine"
_VERSION = 1
INFO_FILE = "atlas.json"


def export_atlas(
    model: AtlasModel, directory: str | os.PathLike[str], engine: str, *, shader: str = "glsl", exact: bool = False
) -> list[Path]:
    """Writes a model for an engine: textures, the mesh, a material, and a page about it.

    Engines' materials read the tiles alone: the mips of a model that has some are in "raw" only.

    Args:
        model: The model.
        directory: The folder; made if it isn't there. A new export replaces an earlier one.
        engine: One of `wlm.engines.ENGINES`, or "raw": the shader alone beside textures and mesh.
        shader: For "raw", its language, one of `wlm.shading.LANGUAGES`.
        exact: For "raw", whether texels are fetched and mixed in floats rather than filtered.

    Returns:
        The files written, the index last.

    Raises:
        WlmError: No such engine or language, a colour texture in ASTC for an engine that has no such textures, the
            folder holds something else, or a file can't be written.
    """
    if engine not in (*ENGINES, "raw"):
        raise WlmError(f"engine: expected one of raw, {', '.join(ENGINES)}, got {engine!r}")
    check_language(shader)
    if model.method == "shared":
        return export_scene(model, directory, engine, shader=shader)
    ending = ".exr" if engine in ("godot", "unreal") else ".dds"
    if model.colour == "astc" and engine == "raw":
        ending = ".ktx2"
    if model.colour == "astc" and ending == ".dds":
        raise WlmError(f"{model.name}: cannot export for {engine}: there is no DDS of ASTC; compress with bc6h")
    if engine != "raw":
        model = model.without_mips()
    made = bundle(model)
    texts = _raw(model, shader, exact) if engine == "raw" else _TEXTS[engine](model)
    files = {name: name + (".bytes" if engine == "unity" else ending) for name in made.textures}
    folder = Path(directory)
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _is_exported) as staging:
        for name, file in files.items():
            texture = made.textures[name]
            if name == "colour" and engine != "raw" and ending == ".dds" and _odd_blocks(model):
                texture = _halves(model.texels[0])
            _write(texture, staging / file, ending)
        (staging / MESH_FILE).write_bytes(made.files[MESH_FILE])
        for name, text in texts.items():
            (staging / name).write_bytes(text.encode())
        info = {
            "format": FORMAT,
            "version": _VERSION,
            "name": model.name,
            "source": model.source,
            "method": model.method,
            "colour": model.colour,
            "textures": files,
            "sizes": {name: [each.width, each.height] for name, each in made.textures.items()},
            "shader": next(iter(texts)),
            "uv_set": made.document["uv_set"],
        }
        write_index(staging / INFO_FILE, info)
    return [folder / name for name in (*texts, *files.values(), MESH_FILE, INFO_FILE)]


def _odd_blocks(model: AtlasModel) -> bool:
    """Whether the colours are blocks that don't fill their texture, which Direct3D and browsers refuse."""
    return model.colour == "bc6h" and any(side % BLOCK_SIDE for side in model.texels.shape[1:3])


def _halves(texels: np.ndarray) -> Texture:
    whole = np.concatenate([texels.astype("<f2"), np.ones((*texels.shape[:2], 1), "<f2")], 2)
    return Texture(whole, "R16G16B16A16_FLOAT", *texels.shape[1::-1])


def _write(texture: Texture, path: Path, ending: str) -> None:
    """Writes a texture in the format of an ending, under a path that may have another ending."""
    if ending == ".exr":
        write_exr(path, texture.image[..., :3], half=not texture.fmt.endswith(("UINT", "UNORM")))
        return
    size, made = (texture.width, texture.height), path.with_suffix(ending)
    data = np.ascontiguousarray(texture.data).tobytes()
    if ending == ".dds":
        write_dds(made, data, *size, fmt=texture.fmt, mips=texture.mips)
    else:
        write_ktx2(made, data, *size, texture.fmt, mips=texture.mips)
    made.rename(path)


def _raw(model: AtlasModel, language: str, exact: bool) -> dict[str, str]:
    text = translate(glsl(model), language, ["WLM_ATLAS_EXACT"] if exact else [])
    return {"atlas" + ENDINGS[language]: text}


def _three(model: AtlasModel) -> dict[str, str]:
    return {
        "atlas.glsl": glsl(model),
        "atlas.js": filled("three_atlas.js", DDS=filled("three_dds.js")),
        README_FILE: filled("three_atlas.md", NAME=model.name),
    }


def _godot(model: AtlasModel) -> dict[str, str]:
    return {
        "atlas.gdshader": filled("godot_atlas.gdshader", SHADER=godot_uniforms(glsl(model))),
        README_FILE: filled("godot_atlas.md", NAME=model.name),
    }


def _unity(model: AtlasModel) -> dict[str, str]:
    return {
        "WlmAtlas.hlsl": translate(glsl(model), "hlsl"),
        "WlmAtlas.shader": filled("unity_atlas.shader"),
        "WlmAtlas.cs": filled("unity_atlas.cs", DDS=filled("unity_dds.cs")),
        README_FILE: filled("unity_atlas.md", NAME=model.name),
    }


_TEXTS: dict[str, Callable[[AtlasModel], dict[str, str]]] = {
    "three": _three,
    "godot": _godot,
    "unity": _unity,
    "unreal": unreal.atlas_texts,
}
_STEMS = {"atlas", "colour", "lut", "blocks", "tail", "WlmAtlas", "wlm_atlas"}
# ".usf" is of earlier versions.
_ENDINGS = {*ENDINGS.values(), ".dds", ".ktx2", ".exr", ".bytes", ".js", ".gdshader", ".shader", ".cs", ".py", ".usf"}


def _is_exported(name: str) -> bool:
    """Whether a file's name is one that such a folder may have."""
    path = Path(name)
    return name in (MESH_FILE, README_FILE, INFO_FILE) or (path.stem in _STEMS and path.suffix in _ENDINGS)
