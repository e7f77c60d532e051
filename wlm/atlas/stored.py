"""The triangles and masks that a model's file stores beside its textures.

The file contains the whole glTF document of the input, as a `.glb`, so that a copy with new UVs keeps materials and
everything else. `extras.wlm` of a node has the number of its sheet, its rectangle in the sheet and the UV set.
"""

import copy
from dataclasses import dataclass, replace

import numpy as np

from wlm.atlas.data import LightmappedScene, Placed, place_objects
from wlm.atlas.model import AtlasModel
from wlm.errors import WlmError
from wlm.formats.gltf import parse_gltf
from wlm.formats.gltf_writer import Replacement, encode_glb


@dataclass(frozen=True, eq=False)
class StoredScene:
    """Triangles and masks of a scene: the bytes of a `.glb` file; the nodes that the sheets light; the number n of
    their UV set `TEXCOORD_n`; whether positions are in metres; whether other nodes hide what is behind them; and a mask
    for each sheet, bool [H, W], true where a texel belongs to a chart."""

    glb: bytes
    objects: tuple[Placed, ...]
    uv_set: int
    metres: bool
    hides: bool
    masks: tuple[np.ndarray, ...]


def store(scene: LightmappedScene) -> StoredScene:
    """Encodes the triangles and masks of a scene."""
    content = copy.deepcopy(scene.document.content)
    for each in scene.objects:
        node = content["nodes"][each.node]
        extras = node["extras"] if isinstance(node.get("extras"), dict) else {}
        place = {"sheet": each.sheet, "scale_offset": list(each.scale_offset), "uv_set": scene.uv_set}
        node["extras"] = extras | {"wlm": place}
    glb = b"".join(encode_glb(replace(scene.document, content=content)))
    masks = tuple(sheet.mask for sheet in scene.sheets)
    return StoredScene(glb, scene.objects, scene.uv_set, scene.metres, len(scene.blocker) > 0, masks)


def restore(model: AtlasModel) -> LightmappedScene:
    """Reconstructs the scene, without lightmaps, from which a model was made. Raises a WlmError if the stored glTF file
    is damaged, or has other triangles than the model. Raises a ValueError if the model stores no triangles."""
    stored = model.stored
    if stored is None:
        raise ValueError(f"{model.name}: the model has no triangles: expected one that compress or load made")
    document, primitives = parse_gltf(model.name, stored.glb)
    sheets, blocker = place_objects(model.name, primitives, stored.uv_set, stored.objects, stored.masks)
    if len(model.uv) and len(model.uv) != len(sheets[0].triangle):
        raise WlmError(
            f"{model.name}: the file's mesh has {len(sheets[0].triangle)} triangles, but its new UVs are for "
            f"{len(model.uv)}: the file is damaged"
        )
    sheets = tuple(replace(sheet, name=place.name) for sheet, place in zip(sheets, model.sheets, strict=True))
    blocker = blocker if stored.hides else blocker[:0]
    settings = stored.uv_set, stored.metres, model.source, document
    return LightmappedScene(model.name, model.states, sheets, stored.objects, blocker, *settings)


def with_uvs(scene: LightmappedScene, corner_uv: np.ndarray) -> tuple[bytes, int]:
    """Encodes a scene of one sheet with an additional UV set, the corners' new UVs [F, 3, 2], numbered after the last
    existing set. Returns the bytes of a `.glb` file, and n of the new UV set `TEXCOORD_n`. Raises a ValueError if the
    shape is wrong, or a UV isn't finite."""
    (sheet,) = scene.sheets
    corner_uv = np.asarray(corner_uv, np.float32)
    if corner_uv.shape != (len(sheet.triangle), 3, 2) or not np.isfinite(corner_uv).all():
        raise ValueError(
            f"corner_uv: expected finite numbers, shape [{len(sheet.triangle)}, 3, 2], got {corner_uv.shape}"
        )
    uv_set = 1 + max(number for part in sheet.parts for number in part.primitive.uv)
    replacements = []
    for part in sheet.parts:
        vertex = part.primitive.triangle.reshape(-1)
        uv = corner_uv[part.triangle : part.triangle + len(part.primitive.triangle)].reshape(-1, 2) + np.float32(0.0)
        # UVs are compared by their bits; adding 0 above turned -0 into 0.
        key = np.stack([vertex.astype(np.uint32), *uv.view(np.uint32).T], axis=1)
        distinct, corner = np.unique(key, axis=0, return_inverse=True)
        new_uv = np.ascontiguousarray(distinct[:, 1:]).view(np.float32)
        replacements.append(Replacement(part.primitive, distinct[:, 0].astype(np.int64), corner.reshape(-1, 3), new_uv))
    return b"".join(encode_glb(scene.document, replacements, uv_set)), uv_set
