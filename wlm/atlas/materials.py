"""Finds the lightmaps that a glTF file names itself, and the texture transforms of lightmap UVs.

==========================  =======================  ================================================================
named by                    UV set without texCoord  rectangle, factor and encoding
==========================  =======================  ================================================================
`MOZ_lightmap`,             1                        `intensity`; images of 8 bits are sRGB, as Hubs writes them
`XR3_lightmap`
`FB_materials_lightmap`     0                        `lightmapFactor`, sRGB
`WEBGI_materials_lightmap`  0                        `lightMapIntensity`, sRGB
`MX_lightmap`, of nodes     1                        `scale`, `offset`, `intensity`; RGBM if the image has alpha
`EPIC_lightmap_textures`    0                        `coordinateScaleBias`; Unreal's encoded pairs of halves are refused
`NEEDLE_lightmaps`          1                        `lightmapScaleOffset` of the node's renderer, v up; float images
a slot that the caller      0                        the factor of `emissive`; sRGB
chooses
==========================  =======================  ================================================================

A set 1 that the mesh lacks is 0. `KHR_texture_transform` of the slot applies before the rectangle. Slots that read one
image read one lightmap, whatever their textures and samplers.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from wlm.atlas.listing import Listing, SheetFiles, numbers
from wlm.errors import WlmError, one_line
from wlm.formats.gltf import (
    GltfDocument,
    GltfPrimitive,
    held_image,
    image_file,
    parse_gltf,
    reported,
    texture_image,
    texture_transform,
)
from wlm.formats.gltf_slots import IDENTITY, SLOTS, lightmap_transform
from wlm.formats.gltf_writer import Replacement, encode_glb
from wlm.formats.levels import HEAD, level_kind
from wlm.formats.reading import open_file
from wlm.formats.unity_asset import has_lightmap

_MX, _EPIC, _NEEDLE = "MX_lightmap", "EPIC_lightmap_textures", "NEEDLE_lightmaps"
# Extensions of materials, and MX of nodes: the field of the texture ("": the extension itself), the field of the
# factor, the UV set without texCoord.
_FIELDS = {
    "MOZ_lightmap": ("", "intensity", 1),
    "XR3_lightmap": ("", "intensity", 1),
    "FB_materials_lightmap": ("lightmapTexture", "lightmapFactor", 0),
    "WEBGI_materials_lightmap": ("lightMapTexture", "lightMapIntensity", 0),
    _MX: ("lightMapTexture", "intensity", 1),
}
EXTENSIONS = (*_FIELDS, _EPIC, _NEEDLE)
"""Extensions whose lightmaps are read."""


Rectangle = tuple[float, float, float, float]
"""Scale and offset of UVs, v down."""


@dataclass(frozen=True)
class Reading:
    """How a primitive reads its lightmap: number of the sheet; n of `TEXCOORD_n`; and the rows of the matrix [2, 3]
    that moves these UVs (u, v, 1) into the sheet, v down."""

    sheet: int
    uv_set: int
    transform: tuple[float, ...] = IDENTITY

    @property
    def rectangle(self) -> Rectangle | None:
        """The transform as a rectangle: scale and offset; None if it turns or shears."""
        a, b, x, c, d, y = self.transform
        return None if b or c else (a, d, x, y)


Readings = dict[tuple[int, int], Reading]
"""The readings by node and number of the primitive in its mesh."""


class _Slot(NamedTuple):
    """A texture slot that holds a lightmap; `rectangle` is scale and offset, v down."""

    info: dict[str, Any]
    uv_set: int
    factor: Any = 1.0
    rectangle: Sequence[float] = (1.0, 1.0, 0.0, 0.0)


def own_extension(document: GltfDocument) -> str | None:
    """Returns the first of `EXTENSIONS` that a material, a node or the file itself has; None without one."""
    content = document.content
    holders = [content, *content.get("materials", []), *content.get("nodes", [])]
    found = {name for holder in holders for name in holder.get("extensions", {})}
    return next((name for name in EXTENSIONS if name in found), None)


def filled_slots(document: GltfDocument) -> list[str]:
    """Returns the names among `SLOTS` of the slots that have a texture."""
    materials = document.content.get("materials", [])
    return [slot for slot in SLOTS if any(f"{slot}Texture" in each for each in materials)]


def own_lightmaps(
    document: GltfDocument,
    primitives: Sequence[GltfPrimitive],
    slot: str | None = None,
    encoding: str | None = None,
    uv_set: int | None = None,
) -> tuple[Listing, Readings]:
    """Lists the lightmaps that a file names, read by `read_gltf`.

    `slot`, one of `SLOTS`, is read instead of an extension, `encoding` is that of images of 8 bits (None: the table's),
    and `uv_set` replaces the stated UV set of all slots. Returns the list, without objects and with a note for each
    assumption, and the readings.
    """
    with reported(document.path):
        name = slot or own_extension(document)
        if slot is not None and slot not in SLOTS:
            raise WlmError(f"slot: expected one of {', '.join(SLOTS)}, got {slot!r}")
        if name is None:
            raise WlmError(f"{document.path}: {_none(document)}")
        return _own(document, primitives, name, encoding, uv_set)


def _parts(document: GltfDocument) -> list[dict]:
    return [each for mesh in document.content["meshes"] for each in mesh["primitives"]]


def _none(document: GltfDocument) -> str:
    """Returns an error text: that a glTF document names no lightmap, which unknown extension or slots it has."""
    used = [
        one_line(each, 60) for each in document.content.get("extensionsUsed", []) if "lightmap" in str(each).lower()
    ]
    text = f"no material has a lightmap ({', '.join(EXTENSIONS)})"
    if used:
        text += f"; its extension {', '.join(used)} is not known"
    if slots := filled_slots(document):
        return f"{text}: give a lightmap, or read that of a material slot: --slot {' or '.join(slots)}"
    return f"{text}: expected a lightmap or a list of them beside it"


def _own(
    document: GltfDocument, primitives: Sequence[GltfPrimitive], name: str, encoding: str | None, uv_set: int | None
) -> tuple[Listing, Readings]:
    sheets: dict[tuple, tuple[int, SheetFiles]] = {}
    held: dict[str, bytes | memoryview] = {}
    images: dict[int, tuple[str, str | None]] = {}
    readings: Readings = {}
    lacking, defaults = 0, set()
    nodes = document.content["nodes"]
    parents = {child: number for number, node in enumerate(nodes) for child in node.get("children", [])}
    for each in primitives:
        slot = _slot(document, each, name, parents.get(each.node, each.node))
        if slot is None:
            continue
        where = f"{document.path}: nodes[{each.node}]: {name}"
        stated, inner = texture_transform(where, slot.info)
        number = stated if uv_set is None else uv_set
        if number is None:
            number = slot.uv_set if slot.uv_set in each.uv else 0
            defaults.add(number)
        if number not in each.uv:
            lacking += 1
            continue
        image, factor = texture_image(document, slot.info["index"]), _factor(slot.factor, where)
        if image not in images:
            images[image] = _picture(document, image, name, encoding, held)
        label, stored = images[image]
        key = label, tuple(np.ravel(factor))
        if key not in sheets:
            title = document.item("images", image).get("name")
            title = title if isinstance(title, str) and title else None
            files = SheetFiles(files=[label], name=title, encoding=stored, intensity=factor)
            sheets[key] = len(sheets), files
        sx, sy, x, y = numbers(list(slot.rectangle), where, ("x", "y", "z", "w"))
        moved = np.array([[sx], [sy]]) * inner + [[0.0, 0.0, x], [0.0, 0.0, y]]
        readings[each.node, each.primitive] = Reading(sheets[key][0], number, tuple(map(float, moved.ravel())))
    if not readings:
        reason = (
            f"the UVs that it names are missing in {lacking} primitives"
            if lacking
            else "no mesh of the scene has such a lightmap"
        )
        raise WlmError(f"{document.path}: {name}: {reason}")
    files = tuple(files for _, files in sheets.values())
    many = f"{len(files)} lightmap{'s' if len(files) > 1 else ''}"
    notes = [f"{document.path}: {many} of {'the slot ' if name in SLOTS else ''}{name}"]
    for stored in sorted({each.encoding for each in files if each.encoding}):
        notes.append(f"{document.path}: {name}: images of 8 bits are read as {stored} (see --encoding)")
    if defaults:
        names = ", ".join(f"TEXCOORD_{number}" for number in sorted(defaults))
        notes.append(f"{document.path}: {name}: texCoord is not stated: {names} is read (see --uv-set)")
    if any("KHR_materials_variants" in each.get("extensions", {}) for each in _parts(document)):
        notes.append(f"{document.path}: KHR_materials_variants: the lightmaps of the default materials are read alone")
    if lacking:
        notes.append(f"{document.path}: {name}: {lacking} primitives lack the UVs that it names: left out")
    return Listing(document.path, ("light",), files, held=held, notes=tuple(notes)), readings


def _slot(document: GltfDocument, primitive: GltfPrimitive, name: str, parent: int) -> _Slot | None:
    """Returns the slot with which a primitive names its lightmap by the extension or the slot `name`; `parent` is the
    node above its own, on which Needle writes the renderer of a mesh of several materials."""
    material = {} if primitive.material is None else document.item("materials", primitive.material)
    if name in SLOTS:
        info = material.get(f"{name}Texture")
        return None if info is None else _Slot(info, 0, _emission(material) if name == "emissive" else 1.0)
    node = document.item("nodes", primitive.node).get("extensions", {})
    if name == _NEEDLE:
        return _needle(document, node) or _needle(document, document.item("nodes", parent).get("extensions", {}))
    own = (node if name in (_MX, _EPIC) else material.get("extensions", {})).get(name)
    if own is None:
        return None
    if name == _EPIC:
        own = document.content["extensions"][name]["lightmaps"][own["lightmap"]]
        if [*own.get("lightmapScale", [1] * 4), *own.get("lightmapAdd", [0] * 4)] != [1] * 4 + [0] * 4:
            raise WlmError(f"{document.path}: nodes[{primitive.node}]: {_UNREAL}")
        return _Slot(own["texture"], 0, 1.0, own.get("coordinateScaleBias", (1.0, 1.0, 0.0, 0.0)))
    field, factor, uv_set = _FIELDS[name]
    info = own.get(field) if field else own
    rectangle = (*own.get("scale", (1.0, 1.0)), *own.get("offset", (0.0, 0.0)))
    return None if info is None else _Slot(info, uv_set, own.get(factor, 1.0), rectangle)


_UNREAL = (
    f"{_EPIC} holds Unreal's encoded lightmap (the logarithm of luminance in two halves), which is not read: export "
    "the light as EXR, and list it with the rectangles"
)


def _needle(document: GltfDocument, node: dict[str, Any]) -> _Slot | None:
    """Returns the texture and rectangle of the lightmap that Needle's renderer on a node names; None without one."""
    textures = document.content.get("extensions", {}).get(_NEEDLE, {}).get("textures", [])
    for component in node.get("NEEDLE_components", {}).get("builtin_components", []):
        number = component.get("lightmapIndex")
        if not has_lightmap(number):
            continue
        found = [each for each in textures if each.get("type") == 0 and each.get("index", 0) == number]
        if not found:
            raise WlmError(
                f"{document.path}: {_NEEDLE}: expected an entry of textures with type 0 and index {number}, found none"
            )
        pointer = re.fullmatch(r"(?:#?/)?textures/(\d+)", str(found[0].get("pointer")))
        if pointer is None:
            where = one_line(found[0].get("pointer"), 60)
            raise WlmError(f"{document.path}: {_NEEDLE}.pointer: expected textures/NUMBER, found {where}")
        place = component.get("lightmapScaleOffset", {"x": 1.0, "y": 1.0, "z": 0.0, "w": 0.0})
        sx, sy, x, y = numbers(place, f"{document.path}: {_NEEDLE}", ("x", "y", "z", "w"))
        return _Slot({"index": int(pointer[1])}, 1, 1.0, (sx, sy, x, 1.0 - sy - y))
    return None


def _emission(material: dict[str, Any]) -> Any:
    factor = np.array(material.get("emissiveFactor", (0.0, 0.0, 0.0)), np.float64)
    strength = material.get("extensions", {}).get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    return (factor * strength).tolist() if factor.any() else 1.0


def _factor(value: Any, where: str) -> float | list[float]:
    """Checks a factor of the light, one number or one for each channel, and returns it; one if all are equal."""
    factor = np.array(value, np.float64)
    if factor.shape not in ((), (3,)) or not (np.isfinite(factor) & (factor >= 0)).all():
        raise WlmError(
            f"{where}: expected a factor of the light, one number or three, of 0 or more, found {one_line(value, 60)}"
        )
    return float(factor.ravel()[0]) if (factor == factor.ravel()[0]).all() else factor.tolist()


def _picture(
    document: GltfDocument, number: int, name: str, stated: str | None, held: dict[str, bytes | memoryview]
) -> tuple[str, str | None]:
    """Returns an image's name (its file, or its place in the document; its bytes are then added to `held`) and the
    encoding of its light, None for a format that defines it."""
    data = held_image(document, number)
    if data is None:
        path = image_file(document, number)
        label = path.relative_to(Path(document.path).parent).as_posix()
        with open_file(path, "the lightmap") as file:
            data = file.read(HEAD)
    else:
        image = document.item("images", number)
        label = f"bufferViews[{image['bufferView']}]" if "bufferView" in image else f"images[{number}]"
        held[label] = data
    kind = level_kind(label, bytes(data[:HEAD]))
    if kind is None or kind == "TIFF":
        return label, None
    if stated is not None:
        return label, stated
    if name == _NEEDLE:
        raise WlmError(
            f"{document.path}: {_NEEDLE}: an image of 8 bits in Needle's RGBM, whose range differs between versions: "
            "say its encoding (--encoding), or export the lightmap as EXR"
        )
    alpha = kind == "PNG" and len(data) > 25 and data[25] in (4, 6)  # colour types with alpha
    if name == _EPIC and alpha:
        raise WlmError(f"{document.path}: {_UNREAL}")
    return label, "rgbm" if name == _MX and alpha else "srgb"


def slot_readings(
    document: GltfDocument, primitives: Sequence[GltfPrimitive], uv_set: int, lightmap: str
) -> tuple[Readings, tuple[str, ...]]:
    """Finds the texture transforms that apply to lightmap UVs which no extension describes, see
    `wlm.formats.gltf_slots`.

    `uv_set` is n of the lightmap's `TEXCOORD_n`, `lightmap` its name without suffix. Returns the readings of all
    primitives that have these UVs, all of sheet 0, empty if no transform applies; and one line about the transforms.
    """
    readings: Readings = {}
    used: dict[str, None] = {}
    with reported(document.path):
        for each in primitives:
            if uv_set not in each.uv:
                continue
            slot, transform = lightmap_transform(document, each, uv_set, lightmap)
            readings[each.node, each.primitive] = Reading(0, uv_set, transform)
            if transform != IDENTITY:
                used[slot] = None
    if not used:
        return {}, ()
    line = f"{document.path}: TEXCOORD_{uv_set} is moved by KHR_texture_transform of {', '.join(used)}"
    return readings, (line,)


def settle(
    document: GltfDocument, primitives: Sequence[GltfPrimitive], readings: Readings
) -> tuple[GltfDocument, list[GltfPrimitive], int, dict[int, tuple[int, Rectangle]]]:
    """Makes all readings of a node one rectangle of one UV set; returns the document, its primitives, n of the UV set,
    and by node the number of its sheet and its rectangle.

    Where they are not, because a transform turns, a node's materials have different transforms, or slots read different
    sets, the moved UVs are added to a copy of the document as a new UV set.
    """
    by_node: dict[int, set[Reading | None]] = {}
    for each in primitives:
        by_node.setdefault(each.node, set()).add(readings.get((each.node, each.primitive)))
    for node, its in by_node.items():
        if len({each.sheet for each in its if each is not None}) > 1:
            raise WlmError(
                f"{document.path}: nodes[{node}]: expected one lightmap for all of its materials, found several: split "
                "the mesh by material"
            )
    sets = {each.uv_set for each in readings.values()}
    if len(sets) == 1 and all(len(its) == 1 for its in by_node.values()):
        found = {node: reading for node, (reading,) in by_node.items() if reading is not None}
        if all(reading.rectangle for reading in found.values()):
            places = {node: (reading.sheet, reading.rectangle) for node, reading in found.items()}
            return document, list(primitives), sets.pop(), places
    number, places, replacements = 1 + max(number for each in primitives for number in each.uv), {}, []
    for each in primitives:
        reading = readings.get((each.node, each.primitive))
        if reading is not None:
            rows = np.array(reading.transform).reshape(2, 3)
            uv = (each.uv[reading.uv_set] @ rows[:, :2].T + rows[:, 2]).astype(np.float32)
            replacements.append(Replacement(each, np.arange(len(uv)), each.triangle, uv))
            places[each.node] = reading.sheet, (1.0, 1.0, 0.0, 0.0)
    document, primitives = parse_gltf(
        document.path, b"".join(encode_glb(document, replacements, number)), document.trust
    )
    return document, primitives, number, places
