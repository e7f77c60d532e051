"""The folder of a scene's compression: the model, the scene, textures for engines, a shader, a report.

scene.wlm                       the model in one file, see `codec`
scene.glb                       the scene; `extras.wlm` of a node says which sheet it reads, and its rectangle
lut.dds                         T_c
colour_0.dds, colour_1.dds ...  the layers of T_p, RGB9E5
scene.glsl                      a function that reads them
report.json                     sheets, factors by state, settings, warnings, and where the inputs were
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

from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.model import SceneModel
from wlm.atlas.scene.shader import scene_glsl
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.dds import write_dds
from wlm.formats.folder import UNFINISHED, read_index, staged
from wlm.formats.gltf_writer import write_glb
from wlm.system import load, plain

FORMAT = "wlm-atlas-scene"
MODEL_FILE, SCENE_FILE, REPORT_FILE = "scene.wlm", "scene.glb", "report.json"
_VERSION = 1
_NAMES = re.compile(r"scene\.(wlm|glb|glsl)|lut\.dds|colour_\d+\.dds|report\.json")


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
        WlmError: The folder holds something other than an earlier output, or a file can't be written.
    """
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
        write_dds(temporary / "lut.dds", lut, columns, rows, fmt="R16G16_UINT")
        for number, layer in enumerate(model.texels):
            texels = np.ascontiguousarray(layer, "<u4").tobytes()
            write_dds(temporary / f"colour_{number}.dds", texels, *layer.shape[::-1], fmt="R9G9B9E5_SHAREDEXP")
        atomic_write(temporary / "scene.glsl", scene_glsl(model).encode())
        report = {
            "format": FORMAT,
            "version": _VERSION,
            "name": model.name,
            "source": model.source,
            "states": list(model.states),
            "sheets": [dataclasses.asdict(sheet) for sheet in model.sheets],
            "objects": [dataclasses.asdict(each) for each in scene.objects],
            "uv_set": scene.uv_set,
            "factors": model.factor.tolist(),
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


def is_scene(directory: str | os.PathLike[str]) -> bool:
    """Whether a folder is one that `export_scene` wrote."""
    report = Path(directory) / REPORT_FILE
    return report.is_file() and read_index(report).get("format") == FORMAT


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
