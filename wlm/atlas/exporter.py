"""What a compression leaves in its folder: the model, a mesh, textures for engines and viewers, a shader, a report.

    atlas.wlm                       the model in one file, see ``codec``
    mesh.glb                        the mesh, with its new UVs as one more set if it has any
    mask.png                        the texels that belong to charts, unless those are all that triangles touch
    lut.exr, .ktx2, .dds            T_c, unless the model is "plain"
    colour.exr, .ktx2, .dds         T_p; blocks of ASTC have no DDS
    atlas.glsl                      a function that reads them
    report.json                     settings, sizes, times, warnings, and where the inputs were
"""

from __future__ import annotations

import dataclasses
import json
import os
import secrets
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm.atlas import codec
from wlm.atlas.coverage import touched_texels
from wlm.atlas.data import LightmappedMesh, from_arrays, write_mesh
from wlm.atlas.model import SOURCE_BITS, AtlasModel
from wlm.atlas.shader import atlas_glsl
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.dds import write_dds
from wlm.formats.exr import write_exr
from wlm.formats.gltf import read_gltf
from wlm.formats.gltf_writer import write_glb
from wlm.formats.ktx2 import write_ktx2
from wlm.formats.mask import read_mask, write_mask

__all__ = [
    "FORMAT",
    "MASK_FILE",
    "MESH_FILE",
    "MODEL_FILE",
    "REPORT_FILE",
    "Output",
    "check_folder",
    "check_run",
    "disk_ratio",
    "export",
    "geometry",
    "read_folder",
    "read_report",
]

FORMAT = "wlm-atlas"
_VERSION = 1
MODEL_FILE = "atlas.wlm"
MESH_FILE = "mesh.glb"
MASK_FILE = "mask.png"
SHADER_FILE = "atlas.glsl"
REPORT_FILE = "report.json"
_TEXTURES = ("lut", "colour")
_SUFFIXES = (".exr", ".ktx2", ".dds")
_FILES = (
    MODEL_FILE,
    MESH_FILE,
    MASK_FILE,
    *(name + end for name in _TEXTURES for end in _SUFFIXES),
    SHADER_FILE,
    REPORT_FILE,
)
_MARKER = "unfinished"  # stands in the report while files are being moved
_MOST_SIDE = 16384  # texels of a texture on GPUs
_LUT_FORMATS = {"tiles": "R16G16_UINT", "cascade": "R16G16_UNORM"}
_STEPS = 65535.0  # of a coordinate in T_c


@dataclass(frozen=True)
class Output:
    """What is in the folder of a compression.

    Attributes:
        folder: The folder.
        model: The model.
        report: report.json.
        model_bytes: Of atlas.wlm.
    """

    folder: Path
    model: AtlasModel
    report: dict[str, Any]
    model_bytes: int


def disk_ratio(model_bytes: int, model: AtlasModel | codec.Contents) -> float:
    """CR of bytes on disk: 1 less those of atlas.wlm over the lightmap's at 48 bits a texel."""
    return 1.0 - model_bytes * 8 / (model.height * model.width * SOURCE_BITS)


def export(
    directory: str | os.PathLike[str],
    model: AtlasModel,
    mesh: LightmappedMesh,
    facts: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Writes a model and all that an engine needs.

    All files are made beside the folder and moved into it at the end, ``report.json`` last. Into a folder of an earlier
    output the new one is written over the old; other files there stay. Where the moving is stopped half-way the folder
    can't be read, but can be written again.

    Args:
        directory: The folder; made if it isn't there.
        model: The model.
        mesh: The mesh that was compressed.
        facts: More for ``report.json``, plain JSON values: "inputs" for example.

    Returns:
        The files written, ``report.json`` last.

    Raises:
        ValueError: The model is of another mesh.
        WlmError: The folder holds something other than an earlier output, a file can't be written, or a texture has
            more texels along a side than GPUs take.
    """
    if model.source != mesh.source:
        raise ValueError(f"model of {model.source}, mesh of {mesh.source}: expected the mesh that was compressed")
    folder = Path(directory)
    check_folder(folder)
    for name, texture in (("T_p", model.texels), ("T_c", model.lut)):
        side = max(texture.shape[:2])
        if side > _MOST_SIDE:
            raise WlmError(f"{model.name}: {name}: expected at most {_MOST_SIDE} texels along a side, found {side}")
    with _staged(folder) as temporary:
        # Times differ from run to run; without them one seed gives one file.
        kept = dict(model.report)
        seconds = kept.pop("seconds", {})
        model = dataclasses.replace(model, report=kept)
        model_bytes = codec.write(temporary / MODEL_FILE, model)
        new_set = None
        if len(model.uv):
            new_set = write_mesh(temporary / MESH_FILE, mesh, model.uv)
        else:
            # The number is of a set to be added, and there is none.
            write_glb(temporary / MESH_FILE, mesh.document, [], 1)
        if not np.array_equal(mesh.mask, _touched(mesh)):
            write_mask(temporary / MASK_FILE, mesh.mask)
        if model.method != "plain":
            _write_lut(temporary, model)
        _write_colour(temporary, model)
        atomic_write(temporary / SHADER_FILE, atlas_glsl(model).encode())
        written = sorted(path.name for path in temporary.iterdir())
        report = _report(model, mesh, new_set, model_bytes) | {"seconds": seconds} | dict(facts or {})
        report["bytes"] = {name: (temporary / name).stat().st_size for name in written}
        atomic_write(temporary / REPORT_FILE, (json.dumps(report, indent=1, allow_nan=False) + "\n").encode())
        names = [*written, REPORT_FILE]
    return [folder / name for name in names]


def check_folder(directory: str | os.PathLike[str]) -> None:
    """Checks, before long work, that a folder can be written.

    Raises:
        WlmError: It is a file, holds something other than an earlier output, or it or its parent can't be written.
    """
    folder = Path(directory)
    try:
        if folder.exists() and any(folder.iterdir()) and _json_of(folder).get("format") != FORMAT:
            raise WlmError(f"{folder}: expected an empty folder or one of an earlier output, found other files")
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    parent = folder.resolve().parent
    if not parent.is_dir():
        raise WlmError(f"{folder}: cannot write: the folder {parent} does not exist")
    for place in (parent, folder):
        if place.exists() and not os.access(place, os.W_OK):
            raise WlmError(f"{folder}: cannot write: the folder {place} is read-only")


def read_folder(directory: str | os.PathLike[str]) -> Output:
    """Reads what ``export`` wrote: the model and the report.

    Raises:
        WlmError: As ``read_report``; or the model is damaged or of another run than the report.
    """
    folder, report = Path(directory), read_report(directory)
    model = codec.read(folder / MODEL_FILE)
    check_run(folder, report, model.source)
    return Output(folder, model, report, (folder / MODEL_FILE).stat().st_size)


def read_report(directory: str | os.PathLike[str]) -> dict[str, Any]:
    """Reads the report that ``export`` wrote.

    Raises:
        WlmError: There is no such folder, it isn't of a compression, or its files were never all there.
    """
    folder = Path(directory)
    if not folder.is_dir():
        raise WlmError(f"{folder}: expected a folder that compress wrote")
    report = _json_of(folder)
    if report.get("format") != FORMAT:
        raise WlmError(f"{folder}: expected a folder that compress wrote, found no {REPORT_FILE} of it")
    if report.get("version") != _VERSION:
        raise WlmError(f"{folder / REPORT_FILE}: version: expected {_VERSION}, found {report.get('version')}")
    if _MARKER in report:
        raise WlmError(f"{folder}: expected all files of a run; writing them was stopped half-way, so compress again")
    return report


def check_run(folder: Path, report: Mapping[str, Any], source: str) -> None:
    """Checks that a model's ``source`` is its report's.

    Raises:
        WlmError: It is not.
    """
    if report.get("source") != source:
        raise WlmError(f"{folder}: {MODEL_FILE} and {REPORT_FILE} are not of one run")


def geometry(output: Output) -> LightmappedMesh:
    """The mesh in the folder, without its lightmap: what it takes to decode where the inputs are gone.

    Args:
        output: The folder.

    Returns:
        The mesh, its triangles in the model's order, with the mask that it was compressed with. Its lightmap is all
        ones. ``source`` is the model's.

    Raises:
        WlmError: mesh.glb, or a mask that the report names, is missing, damaged, or not of this model.
    """
    path, number = output.folder / MESH_FILE, output.report.get("uv_set")
    _, primitives = read_gltf(path)
    parts = [each for each in primitives if number in each.uv]
    triangles, expected = sum(len(each.triangle) for each in parts), output.report.get("triangles")
    if triangles != expected:
        raise WlmError(f"{path}: expected {expected} triangles with TEXCOORD_{number}, found {triangles}")
    first = np.cumsum([0, *(len(each.position) for each in parts)])
    model, mask, files = output.model, None, output.report.get("bytes")
    if isinstance(files, dict) and MASK_FILE in files:
        size = model.height, model.width
        mask = read_mask(output.folder / MASK_FILE, output.folder / MODEL_FILE, size)
    mesh = from_arrays(
        np.concatenate([each.position for each in parts]),
        np.concatenate([each.triangle + start for each, start in zip(parts, first[:-1], strict=True)]),
        np.concatenate([each.uv[number] for each in parts]),
        np.ones((model.height, model.width, 3), np.float32),
        mask,
        name=str(path),
    )
    return dataclasses.replace(mesh, source=model.source)


def _touched(mesh: LightmappedMesh) -> np.ndarray:
    """The mask that ``geometry`` derives."""
    return touched_texels(mesh.uv, mesh.triangle[mesh.active], *mesh.mask.shape)


def _json_of(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / REPORT_FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        found = None
    return found if isinstance(found, dict) else {}


@contextmanager
def _staged(folder: Path) -> Iterator[Path]:
    """Gives a new folder beside the real one, and moves its files there at the end if nothing went wrong."""
    temporary = folder.resolve().parent / f".wlm-{secrets.token_hex(8)}.tmp"
    try:
        temporary.mkdir()
        yield temporary
        fresh = {path.name for path in temporary.iterdir()}
        marker = temporary / _MARKER
        marker.write_text(json.dumps({"format": FORMAT, "version": _VERSION, _MARKER: True}))
        folder.mkdir(exist_ok=True)
        # An old report must not vouch for new files, nor may the folder become one that can't be written again.
        os.replace(marker, folder / REPORT_FILE)
        for name in _FILES:
            if name not in fresh:
                (folder / name).unlink(missing_ok=True)
        for name in sorted(fresh, key=lambda name: name == REPORT_FILE):
            os.replace(temporary / name, folder / name)
    except OSError as error:
        raise WlmError(f"{folder}: cannot write there: {error.strerror or error}") from error
    except WlmError as error:
        # Messages name the file as the user will know it.
        raise WlmError(str(error).replace(str(temporary), str(folder))) from error
    finally:
        with suppress(OSError):
            shutil.rmtree(temporary)


def _write_lut(folder: Path, model: AtlasModel) -> None:
    """T_c. The EXR has the two numbers of an entry as red and green: integers of tiles, exact, else coordinates."""
    height, width = model.lut.shape[:2]
    data, fmt = np.ascontiguousarray(model.lut, "<u2").tobytes(), _LUT_FORMATS[model.method]
    picture = np.zeros((height, width, 3), np.float32)
    picture[..., :2] = model.lut if model.method == "tiles" else model.lut / _STEPS
    write_exr(folder / "lut.exr", picture, half=False)
    write_ktx2(folder / "lut.ktx2", data, width, height, fmt)
    write_dds(folder / "lut.dds", data, width, height, fmt=fmt)


def _write_colour(folder: Path, model: AtlasModel) -> None:
    """T_p. The EXR has what blocks decode to."""
    height, width = model.texels.shape[:2]
    write_exr(folder / "colour.exr", model.texels)
    ktx2, dds = folder / "colour.ktx2", folder / "colour.dds"
    if model.colour == "half":
        texels = np.ascontiguousarray(model.texels, "<f2")
        write_ktx2(ktx2, texels.tobytes(), width, height, "R16G16B16_SFLOAT")
        # DXGI has no half floats of three channels.
        whole = np.concatenate([texels, np.ones((height, width, 1), "<f2")], 2)
        write_dds(dds, whole.tobytes(), width, height, fmt="R16G16B16A16_FLOAT")
        return
    blocks = np.ascontiguousarray(model.blocks).tobytes()
    if model.colour == "bc6h":
        write_ktx2(ktx2, blocks, width, height, "BC6H_UFLOAT_BLOCK")
        write_dds(dds, blocks, width, height, fmt="BC6H_UF16")
    else:
        write_ktx2(ktx2, blocks, width, height, "ASTC_4x4_SFLOAT_BLOCK")


def _report(model: AtlasModel, mesh: LightmappedMesh, new_set: int | None, model_bytes: int) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "version": _VERSION,
        "name": model.name,
        "source": model.source,
        "method": model.method,
        "colour": model.colour,
        "size": [model.width, model.height],
        "colour_size": [model.texels.shape[1], model.texels.shape[0]],
        "lut_size": [model.lut.shape[1], model.lut.shape[0]],
        "triangles": len(mesh.triangle),
        "uv_set": mesh.uv_set,
        "new_uv_set": new_set,
        "cr": model.compression_ratio,
        "cr_disk": disk_ratio(model_bytes, model),
        "profile": model.profile.model_dump(mode="json"),
        "warnings": list(mesh.warnings),
        "found": model.report,
    }
