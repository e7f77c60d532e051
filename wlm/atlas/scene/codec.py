"""The artifact of a scene's model: one file.

Parts: `colour` (uint32 [pages, Hp, Wp], RGB9E5), `lut` (uint16 [Hc, Wc, 2 or 4]), `factor` (float32 [M, C, 3]) and
`sheets` (int32 [S + levels, 7], `SceneModel.table`); each a zlib stream where that is smaller, `wlm.atlas.streams`.
Earlier files name no `entries`, the numbers of one, `wlm.atlas.scene.earlier`.
"""

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, JsonValue

from wlm.atlas.model import MOST_SIZE, TEXELS, check_area, tile_counts, unpack_entries
from wlm.atlas.scene.earlier import side_by_side
from wlm.atlas.scene.model import SHORT_ENTRY, SceneModel, SceneProfile, SheetPlace, unpack_tiles
from wlm.atlas.streams import deflated, inflated
from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.parts import Part, check_parts
from wlm.system import Header, Name

_MOST_EARLIER = 64  # components of earlier files
_MOST_FACTOR = 1e30  # sums of so many texels times it are finite
_MOST_NUMBERS = 1 << 31  # along an axis of a part


def encode(model: SceneModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Gives the settings, parts and source of a model's file. One seed gives one file: times are left out."""
    settings = {
        "name": model.name,
        "states": list(model.states),
        "sheets": [sheet.name for sheet in model.sheets],
        "entries": model.lut.shape[2],
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
    entries: Literal[2, 4] | None = None
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
        "lut": Part(np.uint16, (None, None, None)),
        "factor": Part(np.float32, (len(header.states), None, 3), least=-_MOST_FACTOR, most=_MOST_FACTOR),
        "sheets": Part(np.int32, (None, 7), least=0),
    }
    parts = check_parts(inflated(artifact.tensors, header.parts, table), table)
    texels, lut, factor, sheets = (parts[name] for name in table)
    if not (texels.size and lut.size and factor.size and len(sheets)):
        raise ValueError("a part is empty")
    if max(texels.shape[1:]) > MOST_SIZE or lut.shape[2] != (header.entries or SHORT_ENTRY):
        raise ValueError(f"part colour, part lut: {texels.shape}, {lut.shape}: expected pages and entries")
    names = list(header.sheets)
    if header.entries is None:
        texels, lut, sheets = _of_earlier(texels, lut, factor.shape[1], sheets)
        factor = np.pad(factor, ((0, 0), (1, 0), (0, 0)))
    first, size, component, count, page = unpack_tiles(lut)
    size[..., 0] *= np.maximum(count, 1)
    beyond = ((first + size) > texels.shape[:0:-1]).any(-1) | (page >= len(texels))
    if (beyond & (count > 0)).any() or (component + count >= factor.shape[1]).any():
        raise ValueError("part lut: a tile reaches beyond the colour texture or the factors")
    if len(sheets) < len(names):
        raise ValueError(f"part sheets: expected {len(names)}, found {len(sheets)}")
    places = []
    names += [""] * (len(sheets) - len(names))
    for number, row in enumerate(sheets.tolist()):
        smaller = row[6]
        if smaller and not max(number, len(header.sheets) - 1) < smaller < len(sheets):
            raise ValueError(f"part sheets: {row}: expected a level after it")
        if smaller:
            names[smaller] = names[number]
        place = SheetPlace(names[number], *row)
        if min(place.height, place.width) < 1:
            raise ValueError(f"part sheets: {row}: expected a size")
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
        tuple(places[: len(header.sheets)]),
        factor,
        texels,
        lut,
        tuple(places[len(header.sheets) :]),
        header.report,
    )


def _of_earlier(
    texels: np.ndarray, lut: np.ndarray, count: int, sheets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of an earlier file as they are now: a sheet had a page in place of a smaller level."""
    pages, rest = divmod(len(texels), count)
    if count > _MOST_EARLIER or rest:
        raise ValueError(f"part colour: expected pages of {count} layers, found {texels.shape}")
    first, size, _ = unpack_entries(lut, TEXELS)
    if ((first + size) > texels.shape[:0:-1]).any():
        raise ValueError("part lut: a tile reaches beyond the colour texture")
    page = np.full(lut.shape[:2], -1)
    for _, _, row, column, rows, columns, number in sheets.tolist():
        if number >= pages:
            raise ValueError(f"part sheets: page {number}: expected one below {pages}")
        page[row : row + rows, column : column + columns] = number
    if (page < 0).all():
        raise ValueError("part sheets: no sheet is in the table")
    sheets = sheets.copy()
    sheets[:, 6] = 0
    return *side_by_side(texels, lut, count, page), sheets
