"""Texture transforms of lightmap UVs in glTF files.

A writer that quantises UVs, such as gltfpack, stores their range in `KHR_texture_transform` of the slots that read
them; others store tiling and offset there. Integer UVs take the transform of any slot that reads them, float UVs that
of a slot for light if it keeps them in [0, 1]. A slot whose image has the name of the lightmap comes first.
"""

import io
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from wlm.errors import WlmError, one_line
from wlm.formats.gltf import (
    GltfDocument,
    GltfPrimitive,
    held_image,
    image_file,
    reported,
    texture_image,
    texture_transform,
)
from wlm.formats.limits import MESH_BYTES
from wlm.formats.reading import read_file

SLOTS = ("occlusion", "emissive")
"""Material slots that may hold a lightmap."""

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)
"""Rows of the transform that leaves UVs as they are."""

_FLOAT = 5126
_MOST_SLOTS = 64  # texture slots of a material that are examined
_MOST_IMAGE = 1 << 26  # pixels
_NEAR = 0.01  # a transform for lightmaps leaves UVs this near to [0, 1]


def usual_set(primitives: Sequence[GltfPrimitive]) -> int:
    """Returns n of the `TEXCOORD_n` that is read without a stated set: 1, where engines look for lightmap UVs, if any
    primitive has it; else 0."""
    return int(any(1 in each.uv for each in primitives))


def lightmap_transform(
    document: GltfDocument, primitive: GltfPrimitive, uv_set: int, lightmap: str = ""
) -> tuple[str, tuple[float, ...]]:
    """Finds the texture transform that applies to lightmap UVs, those of `TEXCOORD_n` with n = `uv_set`.

    `lightmap` is the name of the lightmap without its suffix, "" if it is not known. Returns the name of the slot, ""
    for none, and the rows of the matrix [2, 3] that moves (u, v, 1).
    """
    attributes = document.item("meshes", primitive.mesh)["primitives"][primitive.primitive]["attributes"]
    quantised = document.item("accessors", attributes[f"TEXCOORD_{uv_set}"])["componentType"] != _FLOAT
    found = []
    material = {} if primitive.material is None else document.item("materials", primitive.material)
    for slot, info in islice(_slots(material), _MOST_SLOTS):
        stated, rows = texture_transform(f"{document.path}: materials[{primitive.material}]", info)
        if (stated or 0) != uv_set:
            continue
        named = _stem(document, info) == lightmap
        lit = slot.startswith(SLOTS) or "lightmap" in slot.lower()
        if not quantised:
            moved = primitive.uv[uv_set] @ rows[:, :2].T + rows[:, 2]
            if not (named or lit) or moved.min() < -_NEAR or moved.max() > 1.0 + _NEAR:
                continue
        found.append((not named, not lit, slot, tuple(map(float, rows.ravel()))))
    return min(found)[2:] if found else ("", IDENTITY)


def lightmap_uv(document: GltfDocument, primitive: GltfPrimitive, uv_set: int) -> np.ndarray:
    """Returns the lightmap UVs of a primitive, float32 [V, 2], with the transform that applies to them."""
    with reported(document.path):
        transform = lightmap_transform(document, primitive, uv_set)[1]
    if transform == IDENTITY:
        return primitive.uv[uv_set]
    rows = np.array(transform).reshape(2, 3)
    return (primitive.uv[uv_set] @ rows[:, :2].T + rows[:, 2]).astype(np.float32)


def texture_picture(document: GltfDocument, number: int) -> Image.Image:
    """Returns the picture of a texture, in RGB of 8 bits."""
    where = f"{document.path}: textures[{number}]"
    source = texture_image(document, number)
    data = held_image(document, source)
    if data is None:
        data = read_file(image_file(document, source), MESH_BYTES, f"the image of {where}")
    try:
        with Image.open(io.BytesIO(data), formats=["PNG", "JPEG", "WEBP"]) as picture:
            if picture.width * picture.height > _MOST_IMAGE:
                raise WlmError(f"{where}: expected an image of at most {_MOST_IMAGE:,} pixels, found more")
            return picture.convert("RGB")
    except UnidentifiedImageError as error:
        raise WlmError(f"{where}: expected a PNG, JPEG or WebP image") from error
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise WlmError(f"{where}: expected a PNG, JPEG or WebP image: {one_line(error)}") from error


def _slots(holder: Any, name: str = "") -> Iterator[tuple[str, dict[str, Any]]]:
    for key, value in holder.items() if isinstance(holder, dict) else ():
        if isinstance(value, dict) and key not in ("extras", "KHR_texture_transform"):
            if isinstance(value.get("index"), int):
                yield key, value
            else:
                yield from _slots(value, key)


def _stem(document: GltfDocument, info: dict[str, Any]) -> str:
    try:
        number = texture_image(document, info["index"])
        image = document.item("images", number)
        return image_file(document, number).stem if "uri" in image else Path(str(image.get("name", ""))).stem
    except WlmError:
        return ""
