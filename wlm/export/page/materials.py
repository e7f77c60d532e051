"""Base colours of a glTF file's materials, by which a page dims the light of a mesh."""

from collections.abc import Sequence

import numpy as np
from PIL import Image

from wlm.formats.gltf import GltfDocument, GltfPrimitive, reported, texture_transform, vertex_colours
from wlm.formats.gltf_slots import texture_picture

_MOST_SIDE = 1024  # pixels of a picture in a page
_MOST_PIXELS = 1 << 22  # of all pictures of a page: more would make it slow to open


def pack_materials(document: GltfDocument, primitives: Sequence[GltfPrimitive]) -> tuple[dict[str, np.ndarray], float]:
    """Returns the arrays of a page that hold base colours, none if all are white, and the mean base colour.

    These are `tint`, float32 [V, 3], linear, of each vertex of the primitives in turn; `picture`, float32 [V, 3], its
    UV and layer in `pictures`, uint8 [layers, S, S, 4] in sRGB, of which the first layer is white. Raises a WlmError if
    a picture is missing or damaged, or a primitive lacks the UVs of its texture."""
    with reported(document.path):
        tints = vertex_colours(document, primitives, textured=True)
        places, pictures = [], dict[int, Image.Image]()
        for each in primitives:
            material = {} if each.material is None else document.item("materials", each.material)
            place = np.zeros((len(each.position), 3), np.float32)
            if used := material.get("pbrMetallicRoughness", {}).get("baseColorTexture"):
                uv_set, moved = texture_transform(f"{document.path}: materials[{each.material}]", used)
                if used["index"] not in pictures:
                    pictures[used["index"]] = texture_picture(document, used["index"])
                place[:, :2] = each.uv[uv_set or 0] @ moved[:, :2].T + moved[:, 2]
                place[:, 2] = 1 + list(pictures).index(used["index"])
            places.append(place)
    tint = np.concatenate(tints)
    if not pictures and (tint == 1.0).all():
        return {}, 1.0
    longest = max((max(each.size) for each in pictures.values()), default=1)
    side = min(longest, _MOST_SIDE, max(int((_MOST_PIXELS / max(len(pictures), 1)) ** 0.5), 1))
    layers = [np.full((side, side, 4), 255, np.uint8)]
    layers += [np.asarray(each.resize((side, side)).convert("RGBA")) for each in pictures.values()]
    place, packed = np.concatenate(places), np.stack(layers)
    mean = ((packed[..., :3] / 255.0) ** 2.2).mean((1, 2))  # about linear
    arrays = {"tint": tint.astype(np.float32), "picture": place, "pictures": packed}
    return arrays, float((tint * mean[place[:, 2].astype(int)]).mean())
