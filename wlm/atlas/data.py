"""Reads triangles with lightmap UVs and their lightmaps from files or arrays, and checks and repairs them.

A scene has sheets. A sheet is one layout of charts with a lightmap for each state (an hour, a directional layer, a
shadow mask); it lights one or more objects. One mesh with one lightmap is a scene of one sheet and one state.

Input that contradicts itself is refused with one line; a flaw that can be repaired is repaired, with one line of
`warnings` for each kind and its count. Both are listed in docs/atlas.md, "Hard cases". Texels outside of charts are
replaced by the nearest texel in a chart. If no mask is given, it has the texels whose centre is in a triangle and the
texels that a triangle touches, except those that are 0 in every state, since they were probably never baked.

The method's inputs: lightmap-uv-clustering-cascade, section 3 (mesh, UVs and an HDR lightmap).
"""

import hashlib
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from wlm.atlas.charts import charts, welded
from wlm.atlas.coverage import covered_texels, touched_texels
from wlm.atlas.listing import Listing, SheetFiles, is_listing, read_listing
from wlm.atlas.matching import all_by_name, chart_map, choose_mesh, misfits, named, replace_strays
from wlm.atlas.materials import EXTENSIONS, Readings, Rectangle, own_lightmaps, settle, slot_readings
from wlm.errors import WlmError, counted
from wlm.formats.channels import read_encoded
from wlm.formats.exr import CROPPED
from wlm.formats.gltf import Arrays, GltfDocument, GltfPrimitive, document_from_meshes, read_gltf
from wlm.formats.gltf_slots import usual_set
from wlm.formats.gltf_writer import HARMLESS
from wlm.formats.light import noted, read_light
from wlm.formats.limits import FRAMES, PICTURE_GROWTH, check_growth
from wlm.formats.mask import read_mask
from wlm.formats.meshes import SUFFIXES, read_mesh
from wlm.ops.indoors import Indoors, indoors
from wlm.texels import doubts, fill_gaps, repair

_FLAT = 1e-12  # ratio of area to longest side squared below which float64 can't distinguish the area from 0
_FACES = 6  # faces of a cube
_TEXELS = 12.0  # UDIM tiles and repeated textures reach less far
_EDGE = 1e-6  # width of the border of the UV square that counts as inside
_WHOLE = (1.0, 1.0, 0.0, 0.0)
_MISSED = 0.01  # fraction of covered texels that a mask may miss without a warning


@dataclass(frozen=True, eq=False)
class Part:
    """The numbers of the first vertex and the first triangle of a glTF primitive in a sheet."""

    primitive: GltfPrimitive
    vertex: int
    triangle: int


@dataclass(frozen=True)
class Placed:
    """A node of the mesh file, by number and name, whose light is in a sheet (a UV layout with its lightmaps), by
    number; `scale_offset` is its rectangle there, v downwards: UV times the first two numbers, plus the last two."""

    node: int
    label: str
    sheet: int
    scale_offset: Rectangle = (1.0, 1.0, 0.0, 0.0)


@dataclass(frozen=True, eq=False)
class Sheet:
    """A layout of charts, the triangles that are lit by it, and its lightmaps.

    Attributes:
        name: Its name, for messages.
        position: float64 [V, 3], in the scene's space and unit, finite.
        triangle: int32 [F, 3], at least one; each vertex belongs to one primitive.
        uv: float64 [V, 2] in [0, 1]; u right, v down from the lightmap's top row.
        active: bool [F], false where a triangle has no area; at least one is true.
        lightmaps: float32 [M, H, W, 3], the lightmap of each state, linear, in [0, 65504], gaps filled from the
            nearest texel of a chart. M is 0 for a sheet that was read from a model.
        mask: bool [H, W], true where a texel belongs to a chart; at least one is.
        parts: The primitives that the triangles come from, in order.
        warnings: Repairs and oddities, one line each.
    """

    name: str
    position: np.ndarray
    triangle: np.ndarray
    uv: np.ndarray
    active: np.ndarray
    lightmaps: np.ndarray
    mask: np.ndarray
    parts: tuple[Part, ...]
    warnings: tuple[str, ...] = ()

    @property
    def lightmap(self) -> np.ndarray:
        """The lightmap of the first state, float32 [H, W, 3]."""
        return self.lightmaps[0]


@dataclass(frozen=True, eq=False)
class Triangles:
    """All triangles of a scene, int32 [F, 3], sheet by sheet, then those without a lightmap, which only hide others.

    Vertices are float64 [V, 3], with UVs float64 [V, 2], 0 for triangles without a lightmap; `sheet`, int32 [F], is the
    sheet that lights each triangle, or -1.
    """

    position: np.ndarray
    triangle: np.ndarray
    uv: np.ndarray
    sheet: np.ndarray


@dataclass(frozen=True, eq=False)
class LightmappedScene:
    """Triangles and their lightmaps, checked and repaired.

    Attributes:
        name: Its name, for messages.
        states: Names of the M states.
        sheets: At least one.
        objects: The nodes that are lit by the sheets.
        blocker: float64 [B, 3, 3], triangles without a lightmap that hide what is behind them.
        uv_set: n of the glTF attribute `TEXCOORD_n` that was read; 0 if the input is no glTF.
        metres: Whether positions are known to be in metres, as in glTF.
        source: Hash of all sheets, 16 hexadecimal digits of BLAKE2b.
        document: The file that the scene came from, or one made for it.
    """

    name: str
    states: tuple[str, ...]
    sheets: tuple[Sheet, ...]
    objects: tuple[Placed, ...]
    blocker: np.ndarray
    uv_set: int
    metres: bool
    source: str
    document: GltfDocument

    @property
    def warnings(self) -> tuple[str, ...]:
        """The warnings of all sheets, without repeats."""
        return tuple(dict.fromkeys(line for sheet in self.sheets for line in sheet.warnings))

    @property
    def texels(self) -> int:
        """The number of texels of all lightmaps, over all sheets and states."""
        return max(len(self.states), 1) * sum(sheet.mask.size for sheet in self.sheets)

    @cached_property
    def triangles(self) -> Triangles:
        """Returns all triangles of the scene in one mesh."""
        first = np.cumsum([0, *(len(sheet.position) for sheet in self.sheets)])
        owner = [np.where(sheet.active, number, -1) for number, sheet in enumerate(self.sheets)]
        corners = self.blocker.reshape(-1, 3)
        rest = first[-1] + np.arange(len(corners)).reshape(-1, 3)
        moved = [sheet.triangle + start for sheet, start in zip(self.sheets, first, strict=False)]
        return Triangles(
            np.concatenate([*(sheet.position for sheet in self.sheets), corners]),
            np.concatenate([*moved, rest]).astype(np.int32),
            np.concatenate([*(sheet.uv for sheet in self.sheets), np.zeros((len(corners), 2))]),
            np.concatenate([*owner, np.full(len(rest), -1)]).astype(np.int32),
        )

    @cached_property
    def indoors(self) -> Indoors:
        """Returns the places inside the scene, at eye height above a floor, where a camera can stand."""
        return indoors(self.triangles.position, self.triangles.triangle, metres=self.metres)


def load(
    mesh_path: str | os.PathLike[str],
    lights_path: str | os.PathLike[str] | None = None,
    *,
    mask_path: str | os.PathLike[str] | None = None,
    uv_set: int | None = None,
    node: str | None = None,
    encoding: str | None = None,
    flip: bool = False,
    slot: str | None = None,
    trust: bool = False,
) -> LightmappedScene:
    """Reads a mesh or scene and its lightmaps.

    Args:
        mesh_path: A `.glb`, `.gltf`, `.obj` or `.ply` file.
        lights_path: One lightmap (EXR, Radiance, KTX2, DDS: see `wlm.formats.light`; or PNG), row 0 at v = 0 of glTF
            and v = 1 of other formats; or a list of lightmaps, a folder of them or a Godot bake, see
            `wlm.atlas.listing`; None: the lightmaps that the glTF file names itself, see `wlm.atlas.materials`.
        mask_path: With one lightmap, a PNG of its size; a texel belongs to a chart where any colour channel is above
            0. None derives it from the triangles.
        uv_set: n of `TEXCOORD_n`, the lightmap's UVs. None: the set that a list of lightmaps names; without one, 1,
            where engines look for lightmap UVs, if any primitive has it; else 0. Formats other than glTF have only 0.
        node: If there is one lightmap, the node that it belongs to: the node's name, its mesh's name or its number.
        encoding: If there is one lightmap, a PNG's encoding, one of `wlm.formats.channels.ENCODINGS`; None: no PNG. For
            the glTF file's own lightmaps, that of images of 8 bits; None: that of their extension.
        flip: If there is one lightmap, whether its top row is at v = 1 of glTF.
        slot: "occlusion" or "emissive": the slot of the materials that holds the lightmaps.
        trust: Whether files may name files outside their folder, and decompress to huge data (`wlm.formats.limits`).

    Raises:
        WlmError: The input contradicts itself, or a file is missing or damaged; the message names file and field.
    """
    path = Path(mesh_path)
    document, primitives, metres = _read_triangles(path, trust)
    alone = not is_listing(lights_path)
    if not alone:
        given = {"mask": mask_path, "node": node, "encoding": lights_path and encoding, "flip": flip or None}
        for name, value in given.items():
            if value is not None:
                raise WlmError(f"{name}: can't be given with a list of lightmaps; state it in the list")
    if slot is not None and lights_path is not None:
        raise WlmError(
            "slot: only allowed without lightmaps from other files: it reads those in this slot of the mesh's materials"
        )
    sets = {number for each in primitives for number in each.uv}
    known = uv_set if uv_set in sets else None
    readings: Readings = {}
    if lights_path is None:
        listing, readings = own_lightmaps(document, primitives, slot, encoding, known)
        notes = listing.notes
    else:
        if alone:
            files = {"files": [os.fspath(lights_path)], "name": path.stem, "encoding": encoding, "flip": flip}
            sheet = SheetFiles(**files, mask=None if mask_path is None else os.fspath(mask_path))
            listing = Listing(os.fspath(lights_path), ("light",), (sheet,), direct=True)
        else:
            listing = read_listing(lights_path)
        known = listing.uv_set if known is None else known
        number = usual_set(primitives) if known is None else known
        readings, notes = slot_readings(document, primitives, number, Path(listing.sheets[0].files[0]).stem)
        notes = listing.notes + notes
    places: dict[int, tuple[int, Rectangle]] = {}
    if readings:
        document, primitives, known, places = settle(document, primitives, readings)
    if node is not None:
        primitives = named(str(path), primitives, node)
    wanted = known if uv_set is None or uv_set in sets else uv_set
    readers, uv_set, skipped = _select(str(path), primitives, wanted)
    placed: list[tuple[GltfPrimitive, Placed]] | None = None
    if lights_path is None:
        placed = [(each, Placed(each.node, each.label, *places[each.node])) for each in readers if each.node in places]
    elif listing.tiles and any((np.abs(each.uv[uv_set] - 0.5) > 0.5 + _EDGE).any() for each in readers):
        document, primitives, placed = _tiled(str(path), readers, uv_set, listing)
        notes = (
            *notes,
            f"{listing.path}: UDIM tiles {', '.join(map(str, listing.tiles))}, each with the charts inside it",
        )
    elif listing.objects is not None:
        placed = _placed(str(path), readers, listing, places)
    known = (*HARMLESS, *EXTENSIONS)
    if required := [name for name in document.content.get("extensionsRequired", []) if not str(name).startswith(known)]:
        listed = ", ".join(map(str, required[:8]))
        notes = (*notes, f"{path}: requires {listed}, which is not read: is the mesh whole without it?")
    sheets: list[Sheet] = []
    objects, owner = [], {}
    size, decoded = sum(map(len, document.buffers)), 0
    names_of = [files.name or Path(files.files[0]).stem for files in listing.sheets]
    by_name = {} if placed is not None or alone else all_by_name(names_of, readers)
    if by_name:
        matches = ", ".join(f"{names_of[number]} of {group[0].label}" for number, group in list(by_name.items())[:8])
        notes = (*notes, f"{listing.path}: each lightmap belongs to the mesh of its name: {matches}")
    for number, files in enumerate(listing.sheets):
        told: list[str] = []
        lightmaps, mask, names, read = _read_lightmaps(listing, files, trust, told)
        size, decoded = size + read, decoded + lightmaps.nbytes
        if not trust:
            check_growth(f"{listing.path}: its lightmaps", size, decoded, PICTURE_GROWTH, FRAMES)
        label, warnings = names_of[number], []
        if placed is not None:
            pairs = [(each, place) for each, place in placed if place.sheet == number]
        else:
            candidates = [(each, _base(places, each, number)) for each in by_name.get(number) or readers]
            moved = [_moved(each, uv_set, place) for each, place in candidates]
            chosen, warnings = choose_mesh(str(path), label, moved, uv_set, lightmaps[0], alone)
            keys = {(each.node, each.primitive) for each in chosen}
            pairs = [(each, place) for each, place in candidates if (each.node, each.primitive) in keys]
        if not pairs:
            raise WlmError(
                f"{listing.path}: sheets[{number}]: no triangle of the mesh is lit by it: no object has this sheet"
            )
        objects += [place for _, place in pairs]
        for each, _ in pairs:
            other = owner.setdefault((each.node, each.primitive), number)
            if other != number:
                raise WlmError(
                    f"{listing.path}: {names_of[other]} and {label} are both lightmaps of {each.label}: expected one "
                    "for each mesh, named like the mesh, or a .json list with objects"
                )
        warnings = (list(notes) if number == 0 else []) + skipped * alone + told + warnings
        chosen = [_moved(each, uv_set, place) for each, place in pairs]
        others = _alternatives(pairs, uv_set)
        sheets.append(_checked(str(path), label, chosen, uv_set, lightmaps, mask, names, warnings, others))
    rest = [] if alone else [each for each in primitives if (each.node, each.primitive) not in owner]
    blocker = np.concatenate([np.empty((0, 3, 3)), *(each.position[each.triangle] for each in rest)])
    settings = blocker, uv_set, metres, _hash(sheets), document
    return LightmappedScene(path.stem, listing.states, tuple(sheets), tuple(dict.fromkeys(objects)), *settings)


def from_arrays(
    position: np.ndarray,
    triangle: np.ndarray,
    uv: np.ndarray,
    lightmap: np.ndarray,
    mask: np.ndarray | None = None,
    name: str = "array",
    *,
    metres: bool = False,
) -> LightmappedScene:
    """Makes a scene of one sheet from arrays, with the same checks and repairs as `load`.

    Args:
        position: [V, 3] of numbers, in any unit; rounded to float32, as in files.
        triangle: [F, 3] of integers, 0 to V - 1.
        uv: [V, 2] of numbers; u right, v down from the lightmap's top row; rounded to float32.
        lightmap: [H, W, 3] of numbers, linear RGB, or [M, H, W, 3] for M states; copied.
        mask: [H, W], true where a texel belongs to a chart. None derives it from the triangles.
        name: The scene's name, used in messages too.
        metres: Whether the unit is the metre.

    Returns:
        The scene. Vertices that no triangle uses are left out.

    Raises:
        WlmError: A shape is wrong, or the input contradicts itself.
    """
    light = np.asarray(lightmap)
    light = light[None] if light.ndim == 3 else light
    if light.ndim != 4 or light.shape[3] != 3 or 0 in light.shape:
        raise WlmError(f"{name}: expected a lightmap [H, W, 3] with at least one texel, got {np.shape(lightmap)}")
    valid = None if mask is None else np.array(mask).astype(bool)
    if valid is not None and valid.shape != light.shape[1:3]:
        raise WlmError(f"{name}: expected a mask of the lightmap's {light.shape[1:3]} texels, got {valid.shape}")
    mesh = _compact(name, name, np.asarray(position), np.asarray(triangle), np.asarray(uv))
    document, primitives = document_from_meshes([mesh], name)
    with np.errstate(over="ignore"):  # float64 beyond float32 becomes infinity and is repaired as infinity
        copied = np.array(light, np.float32, order="C")
    states = tuple(str(number) for number in range(len(copied)))
    names = [f"{name}: lightmap{f' {state}' * (len(states) > 1)}" for state in states]
    sheet = _checked(name, name, primitives, 0, copied, valid, [*names, f"{name}: mask"])
    objects = (Placed(0, primitives[0].label, 0),)
    source = _hash([sheet])
    return LightmappedScene(name, states, (sheet,), objects, np.empty((0, 3, 3)), 0, metres, source, document)


def join(scenes: Sequence[LightmappedScene], name: str = "scene") -> LightmappedScene:
    """Joins several scenes into one that has all their sheets.

    Args:
        scenes: At least one, in the same space. All have the same number of states (lightmaps of a sheet, such as one
            for each hour); the new scene has the states' names of the first.
        name: The name of the new scene.

    Raises:
        WlmError: The numbers of states differ.
    """
    counts = [len(scene.states) for scene in scenes]
    if len(set(counts)) != 1:
        raise WlmError(f"{name}: expected scenes with the same number of states, got {', '.join(map(str, counts))}")
    sheets = [sheet for scene in scenes for sheet in scene.sheets]
    meshes = [(sheet.name, sheet.position, sheet.triangle, sheet.uv) for sheet in sheets]
    document, primitives = document_from_meshes(meshes, name)
    sheets = [replace(sheet, parts=(Part(each, 0, 0),)) for sheet, each in zip(sheets, primitives, strict=True)]
    return LightmappedScene(
        name,
        scenes[0].states,
        tuple(sheets),
        tuple(Placed(number, each.label, number) for number, each in enumerate(primitives)),
        np.concatenate([scene.blocker for scene in scenes]),
        0,
        all(scene.metres for scene in scenes),
        _hash(sheets),
        document,
    )


def place_objects(
    where: str, primitives: list[GltfPrimitive], uv_set: int, objects: Sequence[Placed], masks: Sequence[np.ndarray]
) -> tuple[tuple[Sheet, ...], np.ndarray]:
    """Makes a model's sheets, without lightmaps, from the triangles in its file. Also returns the corners of all B
    triangles that no sheet lights, float64 [B, 3, 3]."""
    by_node: dict[int, list[GltfPrimitive]] = {}
    for each in primitives:
        by_node.setdefault(each.node, []).append(each)
    sheets, used = [], set()
    for number, mask in enumerate(masks):
        chosen = [
            _moved(each, uv_set, place)
            for place in objects
            if place.sheet == number
            for each in by_node.get(place.node, ())
            if uv_set in each.uv
        ]
        if not chosen:
            raise WlmError(f"{where}: sheet {number}: no triangle of the mesh is lit by it")
        used |= {(each.node, each.primitive) for each in chosen}
        lightmaps = np.empty((0, *mask.shape, 3), np.float32)
        sheets.append(_checked(where, f"sheet {number}", chosen, uv_set, lightmaps, mask, [where]))
    rest = [each.position[each.triangle] for each in primitives if (each.node, each.primitive) not in used]
    return tuple(sheets), np.concatenate([np.empty((0, 3, 3)), *rest])


def _read_triangles(path: Path, trust: bool) -> tuple[GltfDocument, list[GltfPrimitive], bool]:
    """Reads a mesh file. Returns its document, its primitives, and whether its unit is the metre."""
    suffix = path.suffix.lower()
    if suffix in (".glb", ".gltf"):
        document, primitives = read_gltf(path, trust)
        if not primitives:
            raise WlmError(f"{path}: has no triangles")
        return document, primitives, True
    if suffix not in SUFFIXES:
        names = ", ".join((".glb", ".gltf", *SUFFIXES))
        raise WlmError(f"{path}: expected a name that ends in one of {names}, found {suffix or 'none'}")
    arrays = read_mesh(path)
    if not len(arrays.triangle):
        raise WlmError(f"{path}: has no triangles")
    if arrays.uv is None:
        raise WlmError(f"{path}: the mesh has no UVs, or some of its triangles have none")
    mesh = _compact(str(path), path.stem, arrays.position, arrays.triangle, arrays.uv)
    return *document_from_meshes([mesh], path.stem), False


def _compact(where: str, name: str, position: np.ndarray, triangle: np.ndarray, uv: np.ndarray) -> Arrays:
    """Checks the shapes and ranges of arrays, and returns them without the vertices that no triangle uses."""
    for field, array, kinds in (("position", position, "iuf"), ("triangle", triangle, "iu"), ("uv", uv, "iuf")):
        width = 2 if field == "uv" else 3
        if array.ndim != 2 or array.shape[1] != width or array.dtype.kind not in kinds:
            raise WlmError(f"{where}: {field}: expected numbers [N, {width}], got {array.dtype} {array.shape}")
    if len(uv) != len(position):
        raise WlmError(f"{where}: uv: expected {len(position)} rows, one per position, got {len(uv)}")
    if not len(triangle):
        raise WlmError(f"{where}: has no triangles")
    if triangle.min() < 0 or triangle.max() >= len(position):
        raise WlmError(
            f"{where}: triangle: expected vertex numbers 0 to {len(position) - 1}, found {triangle.min()} to "
            f"{triangle.max()}"
        )
    used, corner = np.unique(triangle, return_inverse=True)
    with np.errstate(over="ignore"):  # `_check_finite` reports it as infinite
        return name, position[used].astype(np.float32), corner.reshape(-1, 3), uv[used].astype(np.float32)


def _select(
    where: str, primitives: list[GltfPrimitive], uv_set: int | None
) -> tuple[list[GltfPrimitive], int, list[str]]:
    """Selects the UV set and the primitives that have it. Also returns a warning if some primitives lack it."""
    uv_set = usual_set(primitives) if uv_set is None else uv_set
    selected = [each for each in primitives if uv_set in each.uv]
    if not selected:
        sets = sorted({number for each in primitives for number in each.uv})
        names = ", ".join(f"TEXCOORD_{number}" for number in sets) or "a mesh without UVs"
        raise WlmError(f"{where}: expected the UV set TEXCOORD_{uv_set}, found {names}")
    skipped = [each for each in primitives if uv_set not in each.uv]
    if not skipped:
        return selected, uv_set, []
    line = (
        f"{where}: {counted(len(skipped), 'primitive')} of {len(primitives)} without TEXCOORD_{uv_set}, first "
        f"{skipped[0].name}: left out"
    )
    return selected, uv_set, [line]


def _placed(
    where: str, readers: list[GltfPrimitive], listing: Listing, places: dict[int, tuple[int, Rectangle]]
) -> list[tuple[GltfPrimitive, Placed]]:
    """Returns the primitives that the objects of a list of lightmaps name, each with its sheet and its rectangle in the
    sheet: the object's, applied to UVs after the rectangle of the node's texture transform, in `places`."""
    pairs = []
    for each in listing.objects or ():
        for primitive in named(where, readers, each.node):
            sx, sy, x, y = _base(places, primitive, each.sheet).scale_offset
            width, height, left, top = each.scale_offset
            rectangle = (width * sx, height * sy, width * x + left, height * y + top)
            pairs.append((primitive, Placed(primitive.node, primitive.label, each.sheet, rectangle)))
    found: dict[tuple[int, int], tuple[GltfPrimitive, Placed]] = {}
    for primitive, place in pairs:
        if found.setdefault((primitive.node, primitive.primitive), (primitive, place))[1] != place:
            raise WlmError(
                f"{listing.path}: objects: {primitive.label} is listed twice, with different sheets or rectangles"
            )
    return list(found.values())


def _base(places: dict[int, tuple[int, Rectangle]], primitive: GltfPrimitive, sheet: int) -> Placed:
    """Returns a primitive's rectangle in a sheet: that of its node's texture transform, else the whole sheet."""
    rectangle = places[primitive.node][1] if primitive.node in places else _WHOLE
    return Placed(primitive.node, primitive.label, sheet, rectangle)


def _tiled(
    where: str, readers: Sequence[GltfPrimitive], uv_set: int, listing: Listing
) -> tuple[GltfDocument, list[GltfPrimitive], list[tuple[GltfPrimitive, Placed]]]:
    """Splits primitives by UDIM tile: tile 1001 + i + 10 j has u from i to i + 1 and v, up, from j to j + 1. Returns a
    document with a mesh for each primitive and tile, its primitives, and their places in the sheets."""
    meshes, sheets = [], []
    for each in readers:
        _check_finite(where, each, uv_set)
        uv = each.uv[uv_set].astype(np.float64)
        middle = uv[each.triangle].mean(axis=1)
        column, row = np.floor(middle[:, 0]), np.floor(1.0 - middle[:, 1])
        tile = np.where((column < 0) | (column > 9) | (row < 0), -1, 1001 + column + 10 * row)
        for number in np.unique(tile).astype(np.int64).tolist():
            if number not in listing.tiles:
                at = ", ".join(f"{x:.3g}" for x in middle[tile == number][0])
                raise WlmError(
                    f"{where}: {each.name}: {counted(int((tile == number).sum()), 'triangle')} at UV ({at}) of "
                    f"TEXCOORD_{uv_set}: expected UDIM tiles {', '.join(map(str, listing.tiles))}, which have lightmaps"
                )
            here = tile == number
            local = uv + [-float((number - 1001) % 10), float((number - 1001) // 10)]
            name = f"{each.label}.{number}"
            meshes.append(_compact(where, name, each.position, each.triangle[here], local))
            sheets.append(listing.tiles.index(number))
    document, primitives = document_from_meshes(meshes, Path(where).stem, uv_set)
    placed = [(each, Placed(each.node, each.label, sheet)) for each, sheet in zip(primitives, sheets, strict=True)]
    return document, primitives, placed


def _alternatives(pairs: Sequence[tuple[GltfPrimitive, Placed]], uv_set: int) -> list[tuple[str, np.ndarray]]:
    """Lists other UVs that a sheet's triangles might have been baked with: words for a message, and UVs [V, 2]."""
    found = []
    for number in sorted(set.intersection(*(set(each.uv) for each, _ in pairs)) - {uv_set}):
        uv = [_moved(each, number, place).uv[number] for each, place in pairs]
        found.append((f"TEXCOORD_{number} (--uv-set {number})", np.concatenate(uv)))
    if any(place.scale_offset != _WHOLE for _, place in pairs):
        stored = np.concatenate([each.uv[uv_set] for each, _ in pairs])
        found.append((f"TEXCOORD_{uv_set} as stored, without rectangle or texture transform", stored))
        turned = []
        for each, place in pairs:
            sx, sy, x, y = place.scale_offset
            turned.append(_moved(each, uv_set, replace(place, scale_offset=(sx, sy, x, 1.0 - sy - y))).uv[uv_set])
        found.append(("rectangles that are counted from the bottom (convention unity)", np.concatenate(turned)))
    return found


def _moved(primitive: GltfPrimitive, uv_set: int, place: Placed) -> GltfPrimitive:
    sx, sy, x, y = place.scale_offset
    if place.scale_offset == _WHOLE:
        return primitive
    uv = primitive.uv[uv_set] * np.float32([sx, sy]) + np.float32([x, y])
    return replace(primitive, uv=primitive.uv | {uv_set: uv})


def _read_lightmaps(
    listing: Listing, files: SheetFiles, trust: bool, warnings: list[str]
) -> tuple[np.ndarray, np.ndarray | None, list[str], int]:
    """Reads a sheet's lightmaps, float32 [M, H, W, 3], and its mask, or None. Also returns the names of their files for
    messages, and the bytes of the lightmaps that are files of their own; assumptions and doubts are added to
    `warnings`."""
    lightmaps: list[np.ndarray] = []
    notes: list[list[str]] = []
    names, size = [], 0
    for name in files.files:
        notes.append([])
        with listing.opened(name, trust) as (path, label):
            if files.encoding is None:
                light = read_light(path, notes[-1])[0]
                notes[-1] += doubts(light[..., :3])
            else:
                light = read_encoded(path, files.encoding, notes[-1])
            size += 0 if name in listing.held else os.path.getsize(path)
        names.append(label)
        light = np.array(light[:: -1 if files.flip else 1, :, :3], np.float32, order="C")
        if files.intensity != 1.0:
            with np.errstate(invalid="ignore", over="ignore"):  # an overflow is repaired like an infinity in the file
                light *= np.float32(files.intensity)
        if lightmaps and light.shape != lightmaps[0].shape:
            shape, first = ("x".join(map(str, each.shape[1::-1])) for each in (light, lightmaps[0]))
            raise WlmError(f"{label}: expected {first} texels, the size of the sheet's first lightmap, found {shape}")
        lightmaps.append(light)
    warnings += noted(names, notes)
    stack = np.stack(lightmaps) if len(lightmaps) > 1 else lightmaps[0][None]
    mask_path = None if files.mask is None else listing.file(files.mask, trust)
    mask = None if mask_path is None else read_mask(mask_path, names[0], stack.shape[1:3])
    return stack, mask, [*names, str(mask_path)], size


def _checked(
    where: str,
    name: str,
    primitives: Sequence[GltfPrimitive],
    uv_set: int,
    lightmaps: np.ndarray,  # [M, H, W, 3], repaired in place
    mask: np.ndarray | None,  # [H, W]
    names: Sequence[str],
    warnings: Sequence[str] = (),
    alternatives: Sequence[tuple[str, np.ndarray]] = (),
) -> Sheet:
    """Checks and repairs the triangles and lightmaps [M, H, W, 3] of a sheet. If there are no lightmaps (M = 0), the
    mask is required. `names` are the files of the lightmaps and the mask, for messages; `alternatives` are other UVs
    [V, 2] to compare with, and words for them."""
    warnings, parts, vertices, triangles = list(warnings), [], 0, 0
    for primitive in primitives:
        _check_finite(where, primitive, uv_set)
        parts.append(Part(primitive, vertices, triangles))
        vertices, triangles = vertices + len(primitive.position), triangles + len(primitive.triangle)
    position = np.concatenate([part.primitive.position for part in parts])
    triangle = np.concatenate([part.primitive.triangle + part.vertex for part in parts], dtype=np.int32)
    uv = np.concatenate([part.primitive.uv[uv_set] for part in parts]).astype(np.float64)

    beyond = np.maximum(-uv, uv - 1.0).max(axis=1)
    outside = np.count_nonzero(beyond > 0)
    if outside:
        _check_inside(where, position, uv, triangle, uv_set, alternatives)
        warnings.append(
            f"{name}: {counted(outside, 'vertex', 'vertices')} with UVs outside [0, 1], by up to {beyond.max():.3g}: "
            "clamped"
        )
        uv = uv.clip(0.0, 1.0)
    active = _has_area(position, triangle) & _has_area(uv, triangle)
    flat = len(active) - np.count_nonzero(active)
    if flat == len(active):
        raise WlmError(f"{where}: no triangle has an area in space and in TEXCOORD_{uv_set}")
    if flat:
        warnings.append(f"{name}: {counted(flat, 'triangle')} without area in space or in UV: left out")
    if len(lightmaps):
        chart = chart_map(position, uv, triangle[active], *lightmaps.shape[1:3])
        used = f"TEXCOORD_{uv_set}"
        # Without the texels that a file leaves out, stretched UVs would seem to fit the light better.
        cropped = any(CROPPED in line for line in warnings)
        given = name, lightmaps[0], position, triangle[active], uv, chart, used, alternatives
        lines = [] if cropped else misfits(*given)
        mask, repairs = _checked_light(name, uv, triangle[active], used, lightmaps, mask, names)
        warnings += lines + repairs
        lightmaps = fill_gaps(lightmaps, mask)
    return Sheet(name, position, triangle, uv, active, lightmaps, mask, tuple(parts), tuple(warnings))


def _checked_light(
    name: str,
    uv: np.ndarray,
    triangle: np.ndarray,  # only active triangles
    used: str,
    lightmaps: np.ndarray,
    mask: np.ndarray | None,
    names: Sequence[str],
) -> tuple[np.ndarray, list[str]]:
    """Makes the mask if it is None, else checks it, and repairs the lightmaps in place. Returns mask and warnings."""
    warnings = []
    height, width = lightmaps.shape[1:3]
    if max(height, width) == _FACES * min(height, width):
        warnings.append(f"{names[0]}: {width} x {height}, as a cube's six faces: is it a reflection probe?")
    ab, ac = uv[triangle[:, 1]] - uv[triangle[:, 0]], uv[triangle[:, 2]] - uv[triangle[:, 0]]
    texels = 0.5 * float(np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]).sum()) * height * width
    if texels < 1.0:
        warnings.append(
            f"{name}: all triangles together have {texels:.2g} texels of {width} x {height} in {used}: are "
            "its UVs in [0, 1]?"
        )
    coverage = covered_texels(uv, triangle, height, width).numpy()
    overlaps = np.count_nonzero(coverage > 1)
    if overlaps:
        warnings.append(f"{name}: {counted(overlaps, 'texel')} in several triangles: their UVs overlap")
    if mask is None:
        touched = touched_texels(uv, triangle, height, width)
        # A baker that samples texel centres leaves the fringe of a chart at 0: a gap to fill, not darkness.
        mask = touched & ((coverage > 0) | (lightmaps != 0).any(axis=(0, 3)))
        if not mask.any():
            mask = touched
    else:
        if not mask.any():
            raise WlmError(f"{names[-1]}: the mask is empty: no texel belongs to a chart")
        missed, covered = np.count_nonzero((coverage > 0) & ~mask), np.count_nonzero(coverage)
        if missed > _MISSED * covered:
            warnings.append(
                f"{name}: {counted(missed, 'texel')} of {covered} that triangles cover are outside the mask: "
                f"does it belong to another UV set than {used}, or is it upside down?"
            )
    for lightmap, path in zip(lightmaps, names, strict=False):
        if specks := replace_strays(lightmap, mask, coverage > 0):
            warnings.append(f"{path}: {counted(specks, 'texel')} in specks far above all other light: replaced")
        warnings += [f"{path}: {text}" for text in repair(lightmap, mask, path)]
    return mask, warnings


def _check_inside(
    where: str,
    position: np.ndarray,
    uv: np.ndarray,
    triangle: np.ndarray,
    uv_set: int,
    alternatives: Sequence[tuple[str, np.ndarray]],
) -> None:
    """Raises an error if a chart lies wholly outside [0, 1]: its light would be lost."""
    corner = uv[triangle]
    beyond = ((corner <= _EDGE).all(axis=1) | (corner >= 1.0 - _EDGE).all(axis=1)).any(axis=1)
    if not (beyond & _has_area(uv, triangle)).any():
        return
    number = charts(welded(position, uv, triangle))
    count = number.max() + 1
    lost = np.bincount(number, _has_area(uv, triangle), count) > 0
    lost &= np.bincount(number, ~beyond, count) == 0
    if not lost.any():
        return
    (u, v), (right, bottom) = corner.reshape(-1, 2).min(axis=0), corner.reshape(-1, 2).max(axis=0)
    extent = f"u {u:.3g} to {right:.3g}, v {v:.3g} to {bottom:.3g}"
    inside = [words for words, other in alternatives if other.min() >= -_EDGE and other.max() <= 1.0 + _EDGE]
    if max(right, bottom) - min(u, v) > _TEXELS:
        advice = (
            "are they in texels? Divide them by the size of the lightmap; whole numbers of KHR_mesh_quantization need "
            "the KHR_texture_transform of a material that reads them"
        )
    else:
        advice = (
            "are they those of a repeated texture, or of UDIM tiles? Tiles need a folder of lightmaps NAME.1001.exr"
        )
    if inside:
        advice = f"those of {inside[0]} lie within it; {advice}"
    what = "all UVs lie" if lost.all() else f"{int(lost.sum())} of {count} charts lie wholly"
    raise WlmError(f"{where}: {what} outside [0, 1] in TEXCOORD_{uv_set} ({extent}): {advice}")


def _check_finite(where: str, primitive: GltfPrimitive, uv_set: int) -> None:
    limit = float(np.finfo(np.float32).max)
    for field, values in (("POSITION", primitive.position), (f"TEXCOORD_{uv_set}", primitive.uv[uv_set])):
        bad = np.flatnonzero(~(np.abs(values) <= limit).all(axis=1))
        if len(bad):
            text = ", ".join(f"{x:g}" for x in values[bad[0]])
            raise WlmError(
                f"{where}: {primitive.name}: {field} of vertex {primitive.row[bad[0]]}: expected finite numbers, "
                f"got ({text})"
            )


def _has_area(point: np.ndarray, triangle: np.ndarray) -> np.ndarray:
    """Tests which triangles of points [V, 2 or 3] have an area above 0, however small: bool [F]."""
    a, b, c = (point[triangle[:, k]] for k in range(3))
    ab, ac = b - a, c - a
    longest = np.sqrt(np.maximum.reduce([(edge * edge).sum(axis=1) for edge in (ab, ac, c - b)]))
    # Triangles are scaled to a longest side of 1, so that neither tiny nor huge ones leave float64's range.
    scale = np.divide(1.0, longest, out=np.zeros_like(longest), where=longest > 0)[:, None]
    ab, ac = ab * scale, ac * scale
    if point.shape[1] == 2:
        twice_area = np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
    else:
        twice_area = np.linalg.norm(np.cross(ab, ac), axis=1)
    return twice_area > 2 * _FLAT


def _hash(sheets: Sequence[Sheet]) -> str:
    digest = hashlib.blake2b(digest_size=8)
    for sheet in sheets:
        for array in (sheet.position, sheet.triangle, sheet.uv, sheet.lightmaps, sheet.mask):
            digest.update(np.asarray(array.shape, "<i8").tobytes())
            digest.update(np.ascontiguousarray(array, array.dtype.newbyteorder("<")))
    return digest.hexdigest()
