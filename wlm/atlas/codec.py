"""The artifact of an atlas model: both textures in one file.

Parts: `colour` (half [Hp, Wp, 3], uint32 [Hp, Wp] of RGB9E5, or uint8 [B, 16] where T_p is stored as blocks) and, where
the model has them, `blocks` (uint8 [B, 16], the second texture of "mixed"), `tail` (uint8 [B, 16], the mips), `lut`
(uint16 [Hc, Wc, 2]) and those of `corners`, or in earlier files `uv` (float32 [F, 3, 2]). Each is a zlib stream where
that is smaller, `streams`.
"""

import math
import os
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, JsonValue

from wlm import system
from wlm.atlas import colour
from wlm.atlas.corners import PARTS, decode_corners, encode_corners
from wlm.atlas.model import (
    BLOCK_SIDE,
    BLOCKS,
    MOST_SIZE,
    TAIL_OCTAVES,
    AtlasModel,
    Profile,
    check_area,
    compression_ratio,
    disk_ratio,
    first_block_code,
    tail_blocks,
    tail_shapes,
    tile_counts,
    unpack_entries,
)
from wlm.atlas.streams import deflated, inflated
from wlm.config import check_settings
from wlm.formats.artifact import Artifact, read_artifact
from wlm.formats.parts import Part, check_parts
from wlm.formats.shared_exponent import pack_rgb9e5, unpack_rgb9e5
from wlm.system import Header, Name
from wlm.texels import MOST_SIDE

_MOST_NUMBERS = 1 << 31  # along an axis of a part

_Size = Annotated[list[Annotated[int, Field(ge=1, le=MOST_SIDE)]], Field(min_length=2, max_length=2)]


def encode(model: AtlasModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Gives the settings, parts and source of a model's file. One seed gives one file: times are left out."""
    settings = {
        "name": model.name,
        "method": model.method,
        "colour": model.colour,
        "size": [model.height, model.width],
        "texels": list(model.texels.shape[:2]),
        "profile": model.profile.changes(),
        "report": {name: value for name, value in model.report.items() if name != "seconds"},
    }
    parts = {"colour": model.texels, "lut": model.lut, "tail": model.tail} | encode_corners(model.uv)
    if model.colour in colour.BLOCK_CODECS:
        parts["colour"] = model.blocks
    elif model.colour != "half":
        parts["colour"] = pack_rgb9e5(model.texels)
    if len(model.tail):
        settings["tail"] = list(tail_shapes(model.height, model.width)[0])
    if model.colour == "mixed":
        settings["block_texels"] = list(model.block_texels.shape[:2])
        parts["blocks"] = model.blocks
    streams, settings["parts"] = deflated({name: part for name, part in parts.items() if part.size})
    return settings, streams, model.source


def decode(artifact: Artifact) -> AtlasModel:
    """Makes the model of an artifact, to the bit that was written.

    Raises:
        WlmError: A setting is wrong, a block isn't one of its format, or a package that decodes blocks is missing.
        ValueError: The parts don't fit the settings; so with LookupError, TypeError and AttributeError.
    """
    fields, size, second, parts = _checked(artifact)
    stored, blocks = parts.pop("colour"), parts.pop("blocks")
    textures = {"texels": stored}
    if fields["colour"] in colour.BLOCK_CODECS:
        textures = {"texels": colour.decode(stored, *size, fields["colour"]).astype(np.float16), "blocks": stored}
    elif fields["colour"] != "half":
        textures = {"texels": unpack_rgb9e5(stored).astype(np.float16)}
    if fields["colour"] == "mixed":
        decoded = colour.decode(blocks, *second, BLOCKS).astype(np.float16)
        textures |= {"blocks": blocks, "block_texels": decoded}
    return AtlasModel(**fields, **textures, **parts)


def describe(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Says what a file holds. It is checked as when it is loaded, but for its blocks, which no package has to decode.

    Returns:
        JSON's own types: name, method, colour, bytes, sizes as width and height, number of triangles with new UVs,
        compression ratios by eq. 9 and on disk, source, bytes by part, the model's report and the profile.

    Raises:
        WlmError: As `wlm.load`, but for the blocks.
    """
    artifact = read_artifact(path, AtlasModel.SYSTEM)
    fields, texels, second, parts = system.decode(path, artifact, _checked)
    size, lut = (fields["height"], fields["width"]), parts["lut"].shape[:2]
    return {
        "name": fields["name"],
        "method": fields["method"],
        "colour": fields["colour"],
        "bytes": artifact.file_bytes,
        "size": list(size[::-1]),
        "colour_size": list(texels[::-1]),
        "block_size": list(second[::-1]),
        "lut_size": list(lut[::-1]),
        "new_uvs": len(parts["uv"]),
        "cr": compression_ratio(texels, lut, size, fields["colour"], second, len(parts["tail"])),
        "cr_disk": disk_ratio(artifact.file_bytes, size),
        "source": artifact.source,
        "parts": {"header": artifact.header_bytes} | artifact.parts,
        "found": fields["report"],
        "profile": fields["profile"].model_dump(mode="json"),
    }


class _Header(Header):
    """The settings of a file.

    `size`, `texels`, `block_texels` and `tail` are rows and columns of the lightmap, of T_p, of its second texture and
    of the first level of the mips.
    """

    name: Name
    method: Literal["tiles", "cascade", "plain"]
    colour: Literal["half", "rgb9e5", "bc6h", "astc", "mixed"]
    size: _Size
    texels: _Size
    block_texels: _Size | None = None
    tail: _Size | None = None
    profile: Profile
    report: dict[str, JsonValue]
    parts: dict[str, list[Annotated[int, Field(ge=0, le=_MOST_NUMBERS)]]] = {}


def _checked(
    artifact: Artifact,
) -> tuple[dict[str, Any], tuple[int, int], tuple[int, int], dict[str, np.ndarray]]:
    """Checks the settings and the parts, but not what blocks decode to.

    Returns:
        The fields of `AtlasModel` but for its arrays; rows and columns of T_p and of the second texture of "mixed",
        else (0, 0); and the parts.
    """
    header = check_settings(_Header, artifact.settings, "setting ")
    (height, width), texels = header.size, tuple(header.texels)
    blocks = math.prod(colour.block_grid(*texels))
    mixed, second = header.colour == "mixed", tuple(header.block_texels or (0, 0))
    if mixed != (header.block_texels is not None) or any(side % BLOCK_SIDE for side in second):
        raise ValueError("setting block_texels: expected multiples of 4 of colour mixed alone")
    if mixed and header.method != "tiles":
        raise ValueError(f"setting colour: expected one texture for method {header.method}, found mixed")
    colours = {
        "half": Part(np.float16, (*texels, 3), least=0.0),
        "bc6h": Part(np.uint8, (blocks, 16)),
        "astc": Part(np.uint8, (blocks, 16)),
    }
    table = {
        "colour": colours.get(header.colour, Part(np.uint32, texels)),
        "blocks": Part(np.uint8, (math.prod(second) // BLOCK_SIDE**2, 16), optional=not mixed),
        "lut": {
            "tiles": Part(np.uint16, (*tile_counts(height, width, header.profile.tile), 2)),
            "cascade": Part(np.uint16, (None, None, 2)),
            "plain": Part(np.uint16, (0, 0, 2)),
        }[header.method],
        "tail": Part(np.uint8, (sum(tail_blocks(*shape) for shape in tail_shapes(height, width)), 16), optional=True),
        "uv": Part(np.float32, (None, 3, 2), optional=True, least=0.0, most=1.0),
        **PARTS,
    }
    parts = check_parts(inflated(artifact.tensors, header.parts, table), table)
    # The first files with mips had levels of any sides.
    first_level = header.tail or [-(-side >> TAIL_OCTAVES) for side in (height, width)]
    if len(parts["tail"]) and tuple(first_level) != tail_shapes(height, width)[0]:
        raise ValueError("setting tail: expected mips of whole blocks; compress again")
    lut, corners = parts["lut"], decode_corners({name: parts.pop(name) for name in PARTS})
    if len(corners):
        if len(parts["uv"]):
            raise ValueError("part uv: expected corners in one way, found two")
        parts["uv"] = corners
    if header.method == "cascade" and not lut.size:
        raise ValueError("part lut is empty")
    if header.method == "tiles":
        code = first_block_code(header.colour, texels)
        first, size, of_blocks = unpack_entries(lut, code)
        if (of_blocks[..., 0] != of_blocks[..., 1]).any():
            raise ValueError("part lut: a tile is of both textures")
        most = MOST_SIZE if code else MOST_SIZE * BLOCK_SIDE
        in_second = of_blocks & (header.colour == "mixed")
        if max(texels) > most or ((first + size) > np.where(in_second, second[::-1], texels[::-1])).any():
            raise ValueError("part lut: a tile reaches beyond the colour texture")
    check_area((height, width), (1, math.prod(texels) + math.prod(second)), lut.shape[:2])
    fields = {
        "name": header.name,
        "source": artifact.source,
        "profile": header.profile,
        "method": header.method,
        "colour": header.colour,
        "height": height,
        "width": width,
        "report": header.report,
    }
    return fields, texels, second, parts
