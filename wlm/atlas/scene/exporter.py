"""The folder of a scene's compression: the model, the scene, textures for engines, a shader, a report.

scene.wlm                       the model in one file, see `codec`
scene.glb                       the scene; `extras.wlm` of a node says which sheet it reads, and its rectangle
sheets.dds, lut.dds             the sheets and their levels, and T_c
factors.dds                     the components' factors, a row for each state
colour_0.dds, colour_1.dds ...  the pages of T_p, RGB9E5
blocks_0.dds, blocks_1.dds ...  of colour "mixed" those of its second texture, BC6H
scene.glsl                      a function that reads them
report.json                     sheets, settings, warnings, and where the inputs were
"""

import copy
import dataclasses
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from wlm.atlas.model import SOURCE_BITS
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.model import SceneModel
from wlm.atlas.scene.shader import scene_glsl
from wlm.errors import WlmError
from wlm.formats.artifact import read_artifact
from wlm.formats.atomic import atomic_write
from wlm.formats.dds import MOST_SIDE, write_dds
from wlm.formats.folder import UNFINISHED, read_index, staged
from wlm.formats.gltf_writer import write_glb
from wlm.system import load, plain

FORMAT = "wlm-atlas-scene"
MODEL_FILE, SCENE_FILE, REPORT_FILE = "scene.wlm", "scene.glb", "report.json"
_VERSION = 1
LUT_FORMATS = {2: "R16G16_UINT", 4: "R16G16B16A16_UINT"}
"""Of T_c by the numbers of its entries."""
_NAMES = re.compile(r"scene\.(wlm|glb|glsl)|(lut|sheets|factors)\.dds|(colour|blocks)_\d+\.dds|report\.json")


def export_scene(
    model: SceneModel,
    directory: str | os.PathLike[str],
    scene: LightmappedScene,
    facts: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Writes a model and all that an engine needs, all of it or nothing.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        scene: What was compressed.
        facts: More entries of `report.json`, plain JSON values; "inputs" is what `wlm atlas evaluate` reads.

    Returns:
        The files written, `report.json` last.

    Raises:
        ValueError: The model is of another scene.
        WlmError: The folder holds something other than an earlier output, a file can't be written, or there are more
            sheets and levels than a texture has rows.
    """
    rows = len(model.rows)
    if rows > MOST_SIDE:
        raise WlmError(f"{model.name}: expected at most {MOST_SIDE} sheets and levels, found {rows}")
    if model.source != scene.source:
        raise ValueError(f"model of {model.source}, scene of {scene.source}: expected the scene that was compressed")
    folder = Path(directory)
    with staged(folder, REPORT_FILE, FORMAT, lambda name: _NAMES.fullmatch(name) is not None) as temporary:
        size = model.save(temporary / MODEL_FILE)
        if scene.document is not None:
            content = copy.deepcopy(scene.document.content)
            for each in scene.objects:
                node = content["nodes"][each.node]
                extras = node["extras"] if isinstance(node.get("extras"), dict) else {}
                place = {"sheet": each.sheet, "scale_offset": list(each.scale_offset), "uv_set": scene.uv_set}
                node["extras"] = extras | {"wlm": place}
            # The number is of a set to be added, and there is none.
            write_glb(temporary / SCENE_FILE, dataclasses.replace(scene.document, content=content), [], 1)
        rows, columns = model.lut.shape[:2]
        lut = np.ascontiguousarray(model.lut, "<u2").tobytes()
        write_dds(temporary / "lut.dds", lut, columns, rows, fmt=LUT_FORMATS[model.lut.shape[2]])
        sheets, factors = sheet_texels(model), factor_texels(model)
        write_dds(temporary / "sheets.dds", sheets.tobytes(), *sheets.shape[1::-1], fmt="R16G16B16A16_UINT")
        write_dds(temporary / "factors.dds", factors.tobytes(), *factors.shape[1::-1], fmt="R32G32B32A32_FLOAT")
        for number, layer in enumerate(model.texels):
            texels = np.ascontiguousarray(layer, "<u4").tobytes()
            write_dds(temporary / f"colour_{number}.dds", texels, *layer.shape[::-1], fmt="R9G9B9E5_SHAREDEXP")
        for number, blocks in enumerate(model.blocks):
            sides = model.block_texels.shape[2:0:-1]
            write_dds(temporary / f"blocks_{number}.dds", blocks.tobytes(), *sides, fmt="BC6H_UF16")
        atomic_write(temporary / "scene.glsl", scene_glsl(model).encode())
        report = {
            "format": FORMAT,
            "version": _VERSION,
            "name": model.name,
            "source": model.source,
            "states": list(model.states),
            "sheets": [dataclasses.asdict(sheet) for sheet in model.rows],
            "objects": [dataclasses.asdict(each) for each in scene.objects],
            "uv_set": scene.uv_set,
            "cr": model.compression_ratio,
            "cr_disk": 1.0 - 8 * size / scene.source_bits,
            "profile": model.profile.model_dump(mode="json"),
            "warnings": list(scene.warnings),
            "found": {name: value for name, value in model.report.items() if name != "seconds"},
            "seconds": model.report.get("seconds", {}),
        }
        report = plain(report | dict(facts or {}))
        names = sorted(path.name for path in temporary.iterdir())
        atomic_write(temporary / REPORT_FILE, (json.dumps(report, indent=1, allow_nan=False) + "\n").encode())
    return [folder / name for name in (*names, REPORT_FILE)]


def sheet_texels(model: SceneModel) -> np.ndarray:
    """The texture `sheets`, uint16 [rows, 2, 4]: texels and first entry, x before y; tiles, smaller level, 0."""
    table = model.table()
    texels = np.zeros((len(table), 2, 4), "<u2")
    texels[:, 0] = table[:, [1, 0, 3, 2]]
    texels[:, 1, :3] = table[:, [5, 4, 6]]
    return texels


def factor_texels(model: SceneModel) -> np.ndarray:
    """The texture `factors`, float32 [M, C, 4]."""
    return np.pad(model.factor.astype("<f4"), ((0, 0), (0, 0), (0, 1)))


def is_scene(path: str | os.PathLike[str]) -> bool:
    """Whether a folder is one that `export_scene` wrote, or a file a scene's model.

    Raises:
        WlmError: A file is no artifact.
    """
    if os.path.isfile(path):
        return read_artifact(path).system == SceneModel.SYSTEM
    report = Path(path) / REPORT_FILE
    return report.is_file() and read_index(report).get("format") == FORMAT


def describe_scene(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Says what a scene's folder or model holds.

    Returns:
        JSON's own types: name, bytes, states, sheets with their sizes, how many levels, whether states are apart, the
        texture's width, height and pages, the table's size, factors, compression ratios by eq. 9 and on disk, source,
        bytes by part, the model's report and the profile.

    Raises:
        WlmError: It is another folder or file, or damaged.
    """
    file = Path(path) / MODEL_FILE if os.path.isdir(path) else Path(path)
    model = read_scene(path)[0] if os.path.isdir(path) else load(file, SceneModel.SYSTEM)
    artifact = read_artifact(file, SceneModel.SYSTEM)
    texels = sum(each.height * each.width for each in model.sheets) * len(model.states)
    return {
        "name": model.name,
        "bytes": artifact.file_bytes,
        "states": list(model.states),
        "sheets": [{"name": each.name, "size": [each.width, each.height]} for each in model.sheets],
        "levels": len(model.levels),
        "apart": bool(model.later),
        "colour": model.colour,
        "block_size": list(model.block_texels.shape[2::-1]),
        "colour_size": list(model.texels.shape[::-1]),
        "lut_size": list(model.lut.shape[1::-1]),
        "factors": model.factor.shape[1],
        "cr": model.compression_ratio,
        "cr_disk": 1.0 - 8 * artifact.file_bytes / (SOURCE_BITS * texels),
        "source": model.source,
        "parts": {"header": artifact.header_bytes} | artifact.parts,
        "found": plain(model.report),
        "profile": model.profile.model_dump(mode="json"),
    }


def read_scene(directory: str | os.PathLike[str]) -> tuple[SceneModel, dict[str, Any]]:
    """Reads the model and the report of a folder that `export_scene` wrote.

    Raises:
        WlmError: It is another folder, its files were never all there, or the model is damaged or of another run.
    """
    folder = Path(directory)
    report = read_index(folder / REPORT_FILE)
    if report.get("format") != FORMAT or UNFINISHED in report or report.get("version") != _VERSION:
        raise WlmError(f"{folder}: expected a folder that compress wrote of a scene, all of its files")
    model = load(folder / MODEL_FILE, SceneModel.SYSTEM)
    if report.get("source") != model.source:
        raise WlmError(f"{folder}: {MODEL_FILE} and {REPORT_FILE} are not of one run")
    return model, report
