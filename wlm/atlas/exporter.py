"""The folder of a compression: the model, a mesh, textures for engines and viewers, a shader, a report.

atlas.wlm                       the model in one file, see `codec`
mesh.glb                        the mesh, with its new UVs as one more set if it has any
mask.png                        the texels that belong to charts, unless those are all that triangles touch
lut.exr, .ktx2, .dds            T_c, unless the model is "plain"
colour.exr, .ktx2, .dds         T_p; blocks of ASTC have no DDS
blocks.exr, .ktx2, .dds         the second texture of colour "mixed", BC6H
tail.dds, or .ktx2 of ASTC      the mips, if the model has them
atlas.glsl                      a function that reads them
report.json                     settings, sizes, times, warnings, and where the inputs were
"""

import dataclasses
import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm import system
from wlm.atlas import codec
from wlm.atlas.coverage import touched_texels
from wlm.atlas.data import LightmappedMesh, from_arrays, load, write_mesh
from wlm.atlas.model import BLOCKS, LUT_STEPS, TEXELS, AtlasModel, disk_ratio, tail_codec, tail_shapes
from wlm.atlas.scene.exporter import FORMAT as SCENE_FORMAT
from wlm.atlas.shader import atlas_glsl
from wlm.errors import WlmError, one_line
from wlm.formats.atomic import atomic_write
from wlm.formats.dds import write_dds
from wlm.formats.exr import write_exr
from wlm.formats.folder import UNFINISHED, read_index, staged
from wlm.formats.gltf import read_gltf
from wlm.formats.gltf_writer import write_glb
from wlm.formats.ktx2 import write_ktx2
from wlm.formats.mask import read_mask, write_mask
from wlm.formats.shared_exponent import pack_rgb9e5

FORMAT = "wlm-atlas"
_VERSION = 1
MODEL_FILE = "atlas.wlm"
MESH_FILE = "mesh.glb"
MASK_FILE = "mask.png"
SHADER_FILE = "atlas.glsl"
REPORT_FILE = "report.json"
_TEXTURES = tuple(name + suffix for name in ("lut", "colour", "blocks") for suffix in (".exr", ".ktx2", ".dds"))
_TAILS = ("tail.dds", "tail.ktx2")
READING = {"node": str, "encoding": str, "flip": bool}
"""Options of `load` that the report keeps among the inputs."""
_FILES = (MODEL_FILE, MESH_FILE, MASK_FILE, *_TEXTURES, *_TAILS, SHADER_FILE, REPORT_FILE)
_MOST_SIDE = 16384  # texels of a texture on GPUs
_LUT_FORMATS = {"tiles": "R16G16_UINT", "cascade": "R16G16_UNORM"}


@dataclass(frozen=True)
class Output:
    """The content of an exported folder.

    Attributes:
        folder: The folder.
        model: The model.
        report: Content of report.json.
        model_bytes: Size of atlas.wlm.
    """

    folder: Path
    model: AtlasModel
    report: dict[str, Any]
    model_bytes: int


def export(
    model: AtlasModel,
    directory: str | os.PathLike[str],
    mesh: LightmappedMesh,
    facts: Mapping[str, Any] | None = None,
) -> list[Path]:
    """Writes a model and all that an engine needs.

    All files are made beside the folder and moved into it at the end, `report.json` last. Into a folder of an earlier
    output the new one is written over the old; other files there stay. Where the moving is stopped half-way the folder
    can't be read, but can be written again.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        mesh: The mesh that was compressed.
        facts: More entries of `report.json`, plain JSON values. "inputs", a mapping with the paths "mesh",
            "lightmap" and "mask" (None: none) and the options of `READING`, is what `read_inputs` reads.

    Returns:
        The files written, `report.json` last.

    Raises:
        ValueError: The model is of another mesh.
        WlmError: The folder holds something other than an earlier output, a file can't be written, or a texture has
            more texels along a side than GPUs take.
    """
    if model.source != mesh.source:
        raise ValueError(f"model of {model.source}, mesh of {mesh.source}: expected the mesh that was compressed")
    for name, texture in (("T_p", model.texels), ("T_p's blocks", model.block_texels), ("T_c", model.lut)):
        side = max(texture.shape[:2])
        if side > _MOST_SIDE:
            raise WlmError(f"{model.name}: {name}: expected at most {_MOST_SIDE} texels along a side, found {side}")
    folder = Path(directory)
    with staged(folder, REPORT_FILE, FORMAT, _FILES.__contains__) as temporary:
        model_bytes = model.save(temporary / MODEL_FILE)
        new_set = None
        if len(model.uv):
            new_set = write_mesh(temporary / MESH_FILE, mesh, model.uv)
        else:
            # The number is of a set to be added, and there is none.
            write_glb(temporary / MESH_FILE, mesh.document, [], 1)
        # `geometry` derives the mask from the triangles where there is no file of it.
        if not np.array_equal(mesh.mask, touched_texels(mesh.uv, mesh.triangle[mesh.active], *mesh.mask.shape)):
            write_mask(temporary / MASK_FILE, mesh.mask)
        if model.method != "plain":
            _write_lut(temporary, model)
        _write_colour(temporary, model)
        if len(model.tail):
            (rows, columns), *rest = tail_shapes(model.height, model.width)
            blocks, size = model.tail.tobytes(), (columns, rows)
            if tail_codec(model.colour) == "astc":
                write_ktx2(temporary / "tail.ktx2", blocks, *size, "ASTC_4x4_SFLOAT_BLOCK", mips=len(rest))
            else:
                write_dds(temporary / "tail.dds", blocks, *size, fmt="BC6H_UF16", mips=len(rest))
        atomic_write(temporary / SHADER_FILE, atlas_glsl(model).encode())
        names = sorted(path.name for path in temporary.iterdir())
        report = _report(model, mesh, new_set, model_bytes) | dict(facts or {})
        report["bytes"] = {name: (temporary / name).stat().st_size for name in names}
        atomic_write(temporary / REPORT_FILE, (json.dumps(report, indent=1, allow_nan=False) + "\n").encode())
    return [folder / name for name in (*names, REPORT_FILE)]


def read_folder(directory: str | os.PathLike[str]) -> Output:
    """Reads what `export` wrote: the model and the report.

    Raises:
        WlmError: There is no such folder, it isn't an exported one, its files were never all there, or the model is
            damaged or of another run than the report.
    """
    folder, report = Path(directory), _read_report(directory)
    model = system.load(folder / MODEL_FILE, AtlasModel.SYSTEM)
    _check_run(folder, report, model.source)
    return Output(folder, model, report, (folder / MODEL_FILE).stat().st_size)


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Says what an exported folder's model, or a model's file, holds: `codec.describe`.

    Raises:
        WlmError: As `read_folder` for a folder, and as `codec.describe`.
    """
    if not os.path.isdir(path):
        return codec.describe(path)
    folder, report = Path(path), _read_report(path)
    facts = codec.describe(folder / MODEL_FILE)
    _check_run(folder, report, facts["source"])
    return facts


def geometry(output: Output) -> LightmappedMesh:
    """The mesh in the folder, without its lightmap: what it takes to decode where the inputs are gone.

    Args:
        output: The folder.

    Returns:
        The mesh, its triangles in the model's order, with the mask that it was compressed with. Its lightmap is all
        ones. `source` is the model's.

    Raises:
        WlmError: mesh.glb, or a mask that the report names, is missing, damaged, or not of this model.
    """
    path, number = output.folder / MESH_FILE, output.report.get("uv_set")
    if type(number) is not int:
        raise WlmError(f"{output.folder / REPORT_FILE}: uv_set: expected a whole number, found {one_line(number, 60)}")
    _, primitives = read_gltf(path)
    # A report of an earlier version names no parts: they are all that have the set.
    of_mesh = output.report.get("parts")
    parts = [each for each in primitives if number in each.uv]
    if isinstance(of_mesh, list):
        parts = [each for each in parts if [each.node, each.primitive] in of_mesh]
    triangles, expected = sum(len(each.triangle) for each in parts), output.report.get("triangles")
    if triangles != expected or not triangles:
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
    return dataclasses.replace(mesh, source=model.source, metres=output.report.get("metres") is True)


def read_inputs(
    output: Output,
    mesh_path: str | os.PathLike[str] | None = None,
    lightmap_path: str | os.PathLike[str] | None = None,
    mask_path: str | os.PathLike[str] | None = None,
    trust: bool = False,
) -> LightmappedMesh:
    """Reads the mesh and lightmap that were compressed.

    Args:
        output: The folder; its report names them ("inputs").
        mesh_path, lightmap_path, mask_path: Where they are now; None: where they were.
        trust: As for `load`.

    Raises:
        WlmError: A path isn't known, a file is missing or damaged, or it isn't what was compressed. The line names
            the option of `wlm atlas evaluate` that gives the path.
    """
    stored = output.report.get("inputs")
    stored = stored if isinstance(stored, dict) else {}
    paths = {"mesh": mesh_path, "lightmap": lightmap_path, "mask": mask_path}
    paths = {name: Path(path or stored[name]) for name, path in paths.items() if path or stored.get(name)}
    for name in ("mesh", "lightmap"):
        if name not in paths:
            raise WlmError(f"{output.folder / REPORT_FILE}: inputs.{name}: expected a path, found none; give --{name}")
        if not paths[name].is_file():
            raise WlmError(f"{paths[name]}: no such {name}; if it has moved, give --{name}")
    reading = {name: stored[name] for name in READING if stored.get(name) is not None}
    for name, value in reading.items():
        if type(value) is not READING[name]:
            raise WlmError(
                f"{output.folder / REPORT_FILE}: inputs.{name}: expected {READING[name].__name__}, found "
                f"{one_line(value, 60)}"
            )
    options = {"mask_path": paths.get("mask"), "uv_set": output.report.get("uv_set"), "trust": trust} | reading
    mesh = load(paths["mesh"], paths["lightmap"], **options)
    if mesh.source != output.model.source:
        names = ", ".join(map(str, paths.values()))
        raise WlmError(
            f"{output.folder}: made of other inputs than {names}: expected source {output.model.source}, found "
            f"{mesh.source}"
        )
    return mesh


def _read_report(directory: str | os.PathLike[str]) -> dict[str, Any]:
    folder = Path(directory)
    if not folder.is_dir():
        raise WlmError(f"{folder}: expected a folder that compress wrote")
    report = read_index(folder / REPORT_FILE)
    if report.get("format") == SCENE_FORMAT:
        raise WlmError(
            f"{folder}: the lightmaps of a scene: expected a folder of one; evaluate, info and export take it"
        )
    if report.get("format") != FORMAT:
        raise WlmError(f"{folder}: expected a folder that compress wrote, found no {REPORT_FILE} of it")
    if UNFINISHED in report:
        raise WlmError(f"{folder}: expected all files of a run; writing them was stopped half-way, so compress again")
    if report.get("version") != _VERSION:
        raise WlmError(f"{folder / REPORT_FILE}: version: expected {_VERSION}, found {report.get('version')}")
    return report


def _check_run(folder: Path, report: Mapping[str, Any], source: str) -> None:
    if report.get("source") != source:
        raise WlmError(f"{folder}: {MODEL_FILE} and {REPORT_FILE} are not of one run")


def _write_lut(folder: Path, model: AtlasModel) -> None:
    """T_c. The EXR has the two numbers of an entry as red and green: integers of tiles, exact, else coordinates."""
    height, width = model.lut.shape[:2]
    data, fmt = np.ascontiguousarray(model.lut, "<u2").tobytes(), _LUT_FORMATS[model.method]
    picture = np.zeros((height, width, 3), np.float32)
    picture[..., :2] = model.lut if model.method == "tiles" else model.lut / LUT_STEPS
    write_exr(folder / "lut.exr", picture, half=False)
    if model.method == "tiles":
        write_ktx2(folder / "lut.ktx2", data, width, height, fmt)
    else:
        # Loaders refuse levels of 16 bits; floats hold them exactly enough, to half a step of 2^-24.
        places = (model.lut / np.float32(LUT_STEPS)).astype("<f4")
        write_ktx2(folder / "lut.ktx2", places.tobytes(), width, height, "R32G32_SFLOAT")
    write_dds(folder / "lut.dds", data, width, height, fmt=fmt)


def _write_colour(folder: Path, model: AtlasModel) -> None:
    """T_p, of "mixed" both its textures."""
    if model.colour == "mixed":
        _write_texture(folder, "colour", TEXELS, model.texels)
        _write_texture(folder, "blocks", BLOCKS, model.block_texels, model.blocks)
    else:
        _write_texture(folder, "colour", model.colour, model.texels, model.blocks)


def _write_texture(folder: Path, name: str, colour: str, decoded: np.ndarray, blocks: np.ndarray | None = None) -> None:
    """A texture as engines load it, and as an EXR of what it decodes to."""
    height, width = decoded.shape[:2]
    write_exr(folder / f"{name}.exr", decoded)
    ktx2, dds = folder / f"{name}.ktx2", folder / f"{name}.dds"
    if colour == "half":
        # DXGI has no half floats of three channels, and loaders of KTX2 refuse them.
        whole = np.concatenate([np.asarray(decoded, "<f2"), np.ones((height, width, 1), "<f2")], 2)
        write_ktx2(ktx2, whole.tobytes(), width, height, "R16G16B16A16_SFLOAT")
        write_dds(dds, whole.tobytes(), width, height, fmt="R16G16B16A16_FLOAT")
        return
    if colour == "rgb9e5":
        words = pack_rgb9e5(decoded).astype("<u4").tobytes()
        write_ktx2(ktx2, words, width, height, "E5B9G9R9_UFLOAT_PACK32")
        write_dds(dds, words, width, height, fmt="R9G9B9E5_SHAREDEXP")
        return
    data = np.ascontiguousarray(blocks).tobytes()
    if colour == "bc6h":
        write_ktx2(ktx2, data, width, height, "BC6H_UFLOAT_BLOCK")
        write_dds(dds, data, width, height, fmt="BC6H_UF16")
    else:
        write_ktx2(ktx2, data, width, height, "ASTC_4x4_SFLOAT_BLOCK")


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
        "block_size": [model.block_texels.shape[1], model.block_texels.shape[0]],
        "lut_size": [model.lut.shape[1], model.lut.shape[0]],
        "triangles": len(mesh.triangle),
        "parts": [[each.primitive.node, each.primitive.primitive] for each in mesh.parts],
        "uv_set": mesh.uv_set,
        "metres": mesh.metres,
        "new_uv_set": new_set,
        "cr": model.compression_ratio,
        "cr_disk": disk_ratio(model_bytes, mesh.mask.shape),
        "profile": model.profile.model_dump(mode="json"),
        "warnings": list(mesh.warnings),
        "found": {name: value for name, value in model.report.items() if name != "seconds"},
        "seconds": model.report.get("seconds", {}),
    }
