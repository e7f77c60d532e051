"""Input: a scene of many meshes whose lightmaps have several states: hours, directional layers, a shadow mask.

A sheet is one layout of charts, with a lightmap for each state; one mesh, or many with a rectangle each, read it. What
is said of one mesh and its lightmap in `wlm.atlas.data` holds for each sheet; on top of it:

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
nodes without a lightmap              hide what is behind them; nothing else
a node that is named, but not there   error that lists those there are
a sheet that no triangle reads        error
a texel that is dark in some states   belongs to a chart where any state has light in it
lightmaps of one sheet that differ    error that names the file
in size
a position or UV NaN or infinite,     as for one mesh
overlapping UVs, charts without area
====================================  ================================================================
"""

import hashlib
import os
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from wlm.atlas.belonging import choose_mesh, named, replace_strays
from wlm.atlas.coverage import covered_texels, touched_texels
from wlm.atlas.data import LightmappedMesh, checked_mesh
from wlm.atlas.scene.description import Description, SheetFiles, material_lightmaps, read_description
from wlm.errors import WlmError
from wlm.formats.channels import read_encoded
from wlm.formats.gltf import GltfDocument, GltfPrimitive, read_gltf, reported
from wlm.formats.light import read_light
from wlm.formats.mask import read_mask
from wlm.ops.indoors import Indoors, indoors
from wlm.texels import fill_gaps, repair


@dataclass(frozen=True, eq=False)
class Sheet:
    """A layout of charts and its lightmaps.

    Attributes:
        name: For people.
        mesh: All that reads it, with UVs of the sheet, and the first state's lightmap.
        frames: float32 [M, H, W, 3], the lightmap of each state, its gaps filled.
    """

    name: str
    mesh: LightmappedMesh
    frames: np.ndarray


@dataclass(frozen=True)
class Placed:
    """A node that reads a sheet.

    Attributes:
        node: Its number in the document.
        label: Its name.
        sheet: Number of the sheet.
        scale_offset: Its rectangle, v down: UV times the first two, plus the last two.
    """

    node: int
    label: str
    sheet: int
    scale_offset: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class LightmappedScene:
    """A scene and its lightmaps, checked.

    Attributes:
        name: For people.
        states: Names of the states, M.
        sheets: At least one.
        objects: The nodes that read them.
        blocker: float64 [B, 3, 3], triangles without a lightmap.
        uv_set: n of `TEXCOORD_n`.
        metres: Whether the unit is known to be the metre.
        source: 16 hexadecimal digits of BLAKE2b over all sheets.
        warnings: Repairs and oddities, one line each.
        document: The file that the scene came from; None: it came from arrays.
    """

    name: str
    states: tuple[str, ...]
    sheets: tuple[Sheet, ...]
    objects: tuple[Placed, ...]
    blocker: np.ndarray
    uv_set: int
    metres: bool
    source: str
    warnings: tuple[str, ...]
    document: GltfDocument | None

    @property
    def source_bits(self) -> int:
        """Bits of all lightmaps at 48 a texel (eq. 9)."""
        return sum(48 * len(self.states) * sheet.mesh.mask.size for sheet in self.sheets)

    def geometry(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """All triangles: positions float64 [V, 3], triangles int32 [F, 3], UVs float64 [V, 2] and the sheet of each
        triangle, int32 [F], -1 for those that only hide."""
        meshes = [sheet.mesh for sheet in self.sheets]
        first = np.cumsum([0, *(len(mesh.position) for mesh in meshes)])
        sheets = [np.where(mesh.active, number, -1) for number, mesh in enumerate(meshes)]
        corners = self.blocker.reshape(-1, 3)
        rest = first[-1] + np.arange(len(corners)).reshape(-1, 3)
        return (
            np.concatenate([*(mesh.position for mesh in meshes), corners]),
            np.concatenate([*(mesh.triangle + start for mesh, start in zip(meshes, first, strict=False)), rest]).astype(
                np.int32
            ),
            np.concatenate([*(mesh.uv for mesh in meshes), np.zeros((len(corners), 2))]),
            np.concatenate([*sheets, np.full(len(rest), -1)]).astype(np.int32),
        )

    def indoors(self) -> Indoors:
        """Where viewers can stand in it."""
        position, triangle, _, _ = self.geometry()
        return indoors(position, triangle, metres=self.metres)


def load_scene(
    scene_path: str | os.PathLike[str],
    lights_path: str | os.PathLike[str] | None = None,
    *,
    uv_set: int | None = None,
    trust: bool = False,
) -> LightmappedScene:
    """Reads a glTF scene and its lightmaps.

    Args:
        scene_path: A `.glb` or `.gltf`.
        lights_path: A JSON file or a folder, `description`; None: the materials' own lightmaps.
        uv_set: n of `TEXCOORD_n`, the lightmaps' UVs; None: as the description says, else 1 if any primitive has it,
            else 0.
        trust: Whether the files may name files outside their folders, and draw more than their bytes account for.

    Raises:
        WlmError: One line that names the file and the field.
    """
    document, primitives = read_gltf(scene_path, trust)
    where, name = str(scene_path), Path(scene_path).stem
    if not primitives:
        raise WlmError(f"{where}: has no triangles")
    if lights_path is not None:
        description = read_description(lights_path)
    else:
        with reported(scene_path):
            description = material_lightmaps(document)
        if description is None:
            raise WlmError(f"{where}: no material has a lightmap (MOZ_lightmap): expected a list of them beside it")
    uv_set = description.uv_set if uv_set is None else uv_set
    sets = sorted({number for each in primitives for number in each.uv})
    if uv_set is None:
        uv_set = 1 if 1 in sets else 0
    readers = [each for each in primitives if uv_set in each.uv]
    if not readers:
        raise WlmError(f"{where}: expected the UV set TEXCOORD_{uv_set}, found {sets or 'none'}")
    placed = [] if description.objects is None else _placed(where, readers, description)
    sheets, objects, warnings, used = [], [], [], set()
    for number, files in enumerate(description.sheets):
        frames, mask = _read_frames(description, files, trust)
        label = files.name or Path(files.files[0]).stem
        if description.objects is None:
            chosen, lines = choose_mesh(where, label, readers, uv_set, frames[0])
            warnings += lines
            objects += [Placed(each.node, each.label, number, (1, 1, 0, 0)) for each in _by_node(chosen)]
        else:
            chosen = [_moved(each, uv_set, place) for each, place in placed if place.sheet == number]
            objects += [place for each, place in placed if place.sheet == number and each is not None]
        if not chosen:
            raise WlmError(f"{description.path}: sheets[{number}]: no triangle reads it")
        used |= {(each.node, each.primitive) for each in chosen}
        sheet = _sheet(where, label, document, chosen, uv_set, frames, mask)
        warnings += sheet.mesh.warnings
        sheets.append(sheet)
    rest = [each for each in primitives if (each.node, each.primitive) not in used]
    blocker = np.concatenate([np.empty((0, 3, 3)), *(each.position[each.triangle] for each in rest)])
    return LightmappedScene(
        name,
        description.states,
        tuple(sheets),
        tuple(dict.fromkeys(objects)),
        blocker,
        uv_set,
        True,
        _hash(sheets),
        tuple(dict.fromkeys(warnings)),
        document,
    )


def scene_of(
    meshes: list[LightmappedMesh], frames: list[np.ndarray] | None = None, name: str = "array"
) -> LightmappedScene:
    """Makes a scene of meshes, each with a sheet of its own.

    Args:
        meshes: At least one, in one space.
        frames: For each of them its lightmaps, numbers [M, H, W, 3], the same M for all; None: each has its own alone.
        name: The scene's name.

    Raises:
        WlmError: The shapes don't fit, or a lightmap has no finite texel in a chart.
    """
    frames = [mesh.lightmap[None] for mesh in meshes] if frames is None else frames
    if len(frames) != len(meshes) or not meshes or len({len(each) for each in frames}) != 1:
        raise WlmError(f"{name}: expected as many lightmaps for each of {len(meshes)} meshes")
    sheets = []
    for mesh, each in zip(meshes, frames, strict=True):
        each = np.array(each, np.float32)
        if each.shape[1:] != mesh.lightmap.shape or not len(each):
            raise WlmError(f"{mesh.name}: expected lightmaps [M, *{mesh.lightmap.shape}], got {each.shape}")
        covered = _covered(mesh.uv, mesh.triangle[mesh.active], *mesh.mask.shape)
        sheets.append(Sheet(mesh.name, mesh, _repaired(each, mesh.mask, covered, mesh.name)[0]))
    states = tuple(str(i) for i in range(len(frames[0])))
    objects = tuple(Placed(i, mesh.name, i, (1.0, 1.0, 0.0, 0.0)) for i, mesh in enumerate(meshes))
    metres = all(mesh.metres for mesh in meshes)
    return LightmappedScene(
        name, states, tuple(sheets), objects, np.empty((0, 3, 3)), 0, metres, _hash(sheets), (), None
    )


def _placed(where: str, readers: list[GltfPrimitive], description: Description) -> list[tuple[GltfPrimitive, Placed]]:
    pairs = []
    for each in description.objects or ():
        for primitive in named(where, readers, each.node):
            pairs.append((primitive, Placed(primitive.node, primitive.label, each.sheet, tuple(each.scale_offset))))
    seen: dict[tuple[int, int], Placed] = {}
    for primitive, place in pairs:
        key = primitive.node, primitive.primitive
        if seen.setdefault(key, place) != place:
            raise WlmError(f"{description.path}: objects: {primitive.label} is given two lightmaps")
    return pairs


def _moved(primitive: GltfPrimitive, uv_set: int, place: Placed) -> GltfPrimitive:
    sx, sy, x, y = place.scale_offset
    uv = primitive.uv[uv_set] * np.float32([sx, sy]) + np.float32([x, y])
    return replace(primitive, uv=primitive.uv | {uv_set: uv})


def _by_node(primitives: list[GltfPrimitive]) -> list[GltfPrimitive]:
    return list({each.node: each for each in primitives}.values())


def _read_frames(description: Description, files: SheetFiles, trust: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """The lightmaps of a sheet as they are in their files, float32 [M, H, W, 3], and its mask if it has one."""
    frames: list[np.ndarray] = []
    for name in files.files:
        path = description.file(name, trust)
        light = read_light(path)[0] if files.encoding is None else read_encoded(path, files.encoding)
        light = np.array(light[:: -1 if files.flip else 1, :, :3], np.float32)
        if files.intensity != 1.0:
            with np.errstate(invalid="ignore", over="ignore"):  # repaired as infinity, as it may be in the file
                light *= np.float32(files.intensity)
        if frames and light.shape != frames[0].shape:
            size, first = ("x".join(map(str, each.shape[1::-1])) for each in (light, frames[0]))
            raise WlmError(f"{path}: expected {first} texels as the sheet's other lightmaps, found {size}")
        frames.append(light)
    mask = None
    if files.mask is not None:
        mask = read_mask(description.file(files.mask, trust), files.files[0], frames[0].shape[:2])
    return np.stack(frames), mask


def _covered(uv: np.ndarray, triangle: np.ndarray, height: int, width: int) -> np.ndarray:
    return covered_texels(uv, triangle, height, width) > 0


def _sheet(
    where: str,
    label: str,
    document: GltfDocument,
    primitives: list[GltfPrimitive],
    uv_set: int,
    frames: np.ndarray,  # [M, H, W, 3], repaired in place
    mask: np.ndarray | None,
) -> Sheet:
    """Checks a sheet: first its mesh under its first lightmap, then the other lightmaps by the same charts."""
    height, width = frames.shape[1:3]
    first = frames[0].copy()
    mesh = checked_mesh(
        where, label, document, primitives, uv_set, first, mask, label, label, metres=True, choose=False
    )
    frames[0] = first
    triangle = mesh.triangle[mesh.active]
    covered = _covered(mesh.uv, triangle, height, width)
    if mask is None:
        lit = (frames != 0).any(axis=(0, 3))
        mask = touched_texels(mesh.uv, triangle, height, width) & (covered | lit)
        mask = mask if mask.any() else mesh.mask
    frames, warnings = _repaired(frames, mask, covered, label)
    mesh = replace(mesh, mask=mask, lightmap=frames[0], warnings=tuple(dict.fromkeys((*mesh.warnings, *warnings))))
    return Sheet(label, mesh, frames)


def _repaired(frames: np.ndarray, mask: np.ndarray, covered: np.ndarray, label: str) -> tuple[np.ndarray, list[str]]:
    """Repairs lightmaps in place and fills their gaps; what was done."""
    warnings = []
    for frame in frames:
        if specks := replace_strays(frame, mask, covered):
            warnings.append(f"{label}: {specks} texels in specks far above all other light: replaced")
        warnings += [f"{label}: {text}" for text in repair(frame, mask, label)]
    return fill_gaps(frames, mask), warnings


def _hash(sheets: list[Sheet]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for sheet in sheets:
        digest.update(sheet.mesh.source.encode())
        digest.update(np.ascontiguousarray(sheet.frames, "<f4"))
        digest.update(np.packbits(sheet.mesh.mask).tobytes())
    return digest.hexdigest()
