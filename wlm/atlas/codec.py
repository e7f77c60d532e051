"""The artifact of an atlas model: both textures in one file.

Parts: `colour` (half [Hp, Wp, 3], or uint8 [B, 16] where T_p is stored as blocks) and, where the model has them,
`lut` (uint16 [Hc, Wc, 2]) and `uv` (float32 [F, 3, 2]).
"""

import math
import os
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, JsonValue

from wlm import system
from wlm.atlas import colour
from wlm.atlas.model import (
    MOST_SIZE,
    AtlasModel,
    Profile,
    check_area,
    compression_ratio,
    disk_ratio,
    tile_counts,
    unpack_entries,
)
from wlm.config import check_settings
from wlm.formats.artifact import Artifact, read_artifact
from wlm.formats.parts import Part, check_parts
from wlm.system import Header, Name
from wlm.texels import MOST_SIDE

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
    parts = {"colour": model.texels if model.colour == "half" else model.blocks, "lut": model.lut, "uv": model.uv}
    return settings, {name: part for name, part in parts.items() if part.size}, model.source


def decode(artifact: Artifact) -> AtlasModel:
    """Makes the model of an artifact, to the bit that was written.

    Raises:
        WlmError: A setting is wrong, a block isn't one of its format, or a package that decodes blocks is missing.
        ValueError: The parts don't fit the settings; so with LookupError, TypeError and AttributeError.
    """
    fields, size, parts = _checked(artifact)
    textures = {"texels": parts.pop("colour")}
    if fields["colour"] != "half":
        blocks = textures["texels"]
        textures = {"texels": colour.decode(blocks, *size, fields["colour"]).astype(np.float16), "blocks": blocks}
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
    fields, texels, parts = system.decode(path, artifact, _checked)
    size, lut = (fields["height"], fields["width"]), parts["lut"].shape[:2]
    return {
        "name": fields["name"],
        "method": fields["method"],
        "colour": fields["colour"],
        "bytes": artifact.file_bytes,
        "size": list(size[::-1]),
        "colour_size": list(texels[::-1]),
        "lut_size": list(lut[::-1]),
        "new_uvs": len(parts["uv"]),
        "cr": compression_ratio(texels, lut, size, fields["colour"]),
        "cr_disk": disk_ratio(artifact.file_bytes, size),
        "source": artifact.source,
        "parts": {"header": artifact.header_bytes} | artifact.parts,
        "found": fields["report"],
        "profile": fields["profile"].model_dump(mode="json"),
    }


class _Header(Header):
    """The settings of a file; `size` and `texels` are rows and columns of the lightmap and of T_p."""

    name: Name
    method: Literal["tiles", "cascade", "plain"]
    colour: Literal["half", "bc6h", "astc"]
    size: _Size
    texels: _Size
    profile: Profile
    report: dict[str, JsonValue]


def _checked(artifact: Artifact) -> tuple[dict[str, Any], tuple[int, int], dict[str, np.ndarray]]:
    """Checks the settings and the parts, but not what blocks decode to.

    Returns:
        The fields of `AtlasModel` but for its arrays; rows and columns of T_p; and the parts.
    """
    header = check_settings(_Header, artifact.settings, "setting ")
    (height, width), texels = header.size, tuple(header.texels)
    blocks = math.prod(colour.block_grid(*texels))
    half = header.colour == "half"
    table = {
        "colour": Part(np.float16, (*texels, 3), least=0.0) if half else Part(np.uint8, (blocks, 16)),
        "lut": {
            "tiles": Part(np.uint16, (*tile_counts(height, width, header.profile.tile), 2)),
            "cascade": Part(np.uint16, (None, None, 2)),
            "plain": Part(np.uint16, (0, 0, 2)),
        }[header.method],
        "uv": Part(np.float32, (None, 3, 2), optional=True, least=0.0, most=1.0),
    }
    parts = check_parts(artifact.tensors, table)
    lut = parts["lut"]
    if header.method == "cascade" and not lut.size:
        raise ValueError("part lut is empty")
    if header.method == "tiles":
        first, size = unpack_entries(lut)
        if max(texels) > MOST_SIZE or ((first + size) > texels[::-1]).any():
            raise ValueError("part lut: a tile reaches beyond the colour texture")
    check_area((height, width), texels, lut.shape[:2])
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
    return fields, texels, parts
