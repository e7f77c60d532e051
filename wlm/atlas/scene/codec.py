"""The artifact of a scene's model: one file.

Parts: `colour` (uint32 [pages K, Hp, Wp], RGB9E5), `lut` (uint16 [Hc, Wc, 2]), `factor` (float32 [M, K, 3]) and
`sheets` (int32 [S, 7], `SceneModel.table`); each a zlib stream where that is smaller, `wlm.atlas.streams`.
"""

from typing import Annotated, Any

import numpy as np
from pydantic import Field, JsonValue

from wlm.atlas.model import MOST_SIZE, TEXELS, check_area, tile_counts, unpack_entries
from wlm.atlas.scene.model import SceneModel, SceneProfile, SheetPlace
from wlm.atlas.streams import deflated, inflated
from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.parts import Part, check_parts
from wlm.system import Header, Name

_MOST_COMPONENTS = 64
_MOST_NUMBERS = 1 << 31  # along an axis of a part


def encode(model: SceneModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Gives the settings, parts and source of a model's file. One seed gives one file: times are left out."""
    settings = {
        "name": model.name,
        "states": list(model.states),
        "sheets": [sheet.name for sheet in model.sheets],
        "profile": model.profile.changes(),
        "report": {name: value for name, value in model.report.items() if name != "seconds"},
    }
    parts = {"colour": model.texels, "lut": model.lut, "factor": model.factor, "sheets": model.table()}
    streams, settings["parts"] = deflated(parts)
    return settings, streams, model.source


class _Header(Header):
    name: Name
    states: list[Name]
    sheets: list[Name]
    profile: SceneProfile
    report: dict[str, JsonValue]
    parts: dict[str, list[Annotated[int, Field(ge=0, le=_MOST_NUMBERS)]]] = {}


def decode(artifact: Artifact) -> SceneModel:
    """Makes the model of an artifact, to the bit that was written.

    Raises:
        WlmError: A setting is wrong.
        ValueError: The parts don't fit the settings; so with LookupError, TypeError and AttributeError.
    """
    header = check_settings(_Header, artifact.settings, "setting ")
    table = {
        "colour": Part(np.uint32, (None, None, None)),
        "lut": Part(np.uint16, (None, None, 2)),
        "factor": Part(np.float32, (len(header.states), None, 3), least=0.0),
        "sheets": Part(np.int32, (len(header.sheets), 7), least=0),
    }
    parts = check_parts(inflated(artifact.tensors, header.parts, table), table)
    texels, lut, factor, sheets = (parts[name] for name in table)
    if not (texels.size and lut.size and factor.size and len(sheets)):
        raise ValueError("a part is empty")
    count = factor.shape[1]
    pages, rest = divmod(len(texels), count)
    if count > _MOST_COMPONENTS or rest or max(texels.shape[1:]) > MOST_SIZE:
        raise ValueError(f"part colour: expected pages of {count} layers, found {texels.shape}")
    first, size, _ = unpack_entries(lut, TEXELS)
    if ((first + size) > texels.shape[:0:-1]).any():
        raise ValueError("part lut: a tile reaches beyond the colour texture")
    places = []
    for name, row in zip(header.sheets, sheets.tolist(), strict=True):
        place = SheetPlace(name, *row)
        if min(place.height, place.width) < 1 or place.page >= pages:
            raise ValueError(f"part sheets: {row}: expected a size and a page below {pages}")
        if (place.rows, place.columns) != tile_counts(place.height, place.width, header.profile.tile):
            raise ValueError(f"part sheets: {row}: expected the tiles of its size")
        if place.row + place.rows > lut.shape[0] or place.column + place.columns > lut.shape[1]:
            raise ValueError(f"part sheets: {row}: reaches beyond the table")
        check_area((place.height, place.width), texels.shape[1:], lut.shape[:2])
        places.append(place)
    return SceneModel(
        header.name,
        artifact.source,
        header.profile,
        tuple(header.states),
        tuple(places),
        factor,
        texels,
        lut,
        header.report,
    )
