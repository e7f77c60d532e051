"""The artifact of a scene's model: one file.

Parts: `colour` (uint32 [pages, Hp, Wp], RGB9E5), `lut` (uint16 [Hc, Wc, 2 or 4]), `factor` (float32 [M, C, 3]) and
`sheets` (int32 [rows, 7], `SceneModel.table`); each a zlib stream where that is smaller, `wlm.atlas.streams`.
Earlier files name no `entries`, the numbers of one, or no `coarse`, `wlm.atlas.scene.earlier`.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, JsonValue

from wlm.atlas.colour import decode as decode_blocks
from wlm.atlas.model import (
    BLOCK_SIDE,
    BLOCKS,
    FIRST_BLOCK_CODE,
    MOST_SIZE,
    NO_BLOCKS,
    TEXELS,
    check_area,
    tile_counts,
    unpack_entries,
)
from wlm.atlas.scene.earlier import side_by_side, without_coarse
from wlm.atlas.scene.model import ENTRY, SHORT_ENTRY, SceneModel, SceneProfile, SheetPlace, extent, unpack_tiles
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
        "coarse": True,
        **({"apart": True} if model.later else {}),
        "profile": model.profile.changes(),
        "report": {name: value for name, value in model.report.items() if name != "seconds"},
    }
    parts = {"colour": model.texels, "lut": model.lut, "factor": model.factor, "sheets": model.table()}
    if model.colour == "mixed":
        settings["block_texels"] = list(model.block_texels.shape[1:3])
        parts["blocks"] = model.blocks
    streams, settings["parts"] = deflated(parts)
    return settings, streams, model.source


class _Header(Header):
    name: Name
    states: list[Name]
    sheets: list[Name]
    block_texels: Annotated[list[int], Field(min_length=2, max_length=2)] | None = None
    entries: Literal[2, 4] | None = None
    coarse: Literal[True] | None = None
    apart: Literal[True] | None = None
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
        "blocks": Part(np.uint8, (None, None, 16), optional=True),
    }
    parts = check_parts(inflated(artifact.tensors, header.parts, table), table)
    texels, lut, factor, sheets, blocks = (parts[name] for name in table)
    second = tuple(header.block_texels or (0, 0))
    most = MOST_SIZE * BLOCK_SIDE
    if any(side % BLOCK_SIDE or not 0 <= side <= most for side in second) or bool(len(blocks)) != all(second):
        raise ValueError(f"setting block_texels: {second}: expected multiples of 4 beside blocks alone")
    if len(blocks) and (header.entries is None or blocks.shape[1] != math.prod(second) // BLOCK_SIDE**2):
        raise ValueError(f"part blocks: {blocks.shape}: expected those of {second} texels")
    if not (texels.size and lut.size and factor.size and len(sheets)):
        raise ValueError("a part is empty")
    if max(texels.shape[1:]) > MOST_SIZE or lut.shape[2] != (header.entries or SHORT_ENTRY):
        raise ValueError(f"part colour, part lut: {texels.shape}, {lut.shape}: expected pages and entries")
    names = list(header.sheets)
    if header.entries is None:
        texels, lut, sheets = _of_earlier(texels, lut, factor.shape[1], sheets)
        factor = np.pad(factor, ((0, 0), (1, 0), (0, 0)))
    elif header.coarse is None and lut.shape[2] == ENTRY:
        lut = without_coarse(lut)
    colour = "mixed" if len(blocks) else TEXELS
    first, size, component, count, page, of_blocks, coarse = unpack_tiles(lut, colour)
    if colour == "mixed" and (unpack_entries(lut[..., :2], FIRST_BLOCK_CODE)[2][..., 1] != of_blocks).any():
        raise ValueError("part lut: a tile is of both textures")
    if (coarse > np.where(of_blocks, count, 0)).any():
        raise ValueError("part lut: expected coarse components of tiles of blocks alone, at most all of them")
    size = np.where(count[..., None] > 0, extent(size, count, coarse), size)
    beyond = ((first + size) > np.where(of_blocks[..., None], second[::-1], texels.shape[:0:-1])).any(-1)
    beyond |= page >= np.where(of_blocks, len(blocks), len(texels))
    if (beyond & (count > 0)).any() or (component + count >= factor.shape[1]).any():
        raise ValueError("part lut: a tile reaches beyond the colour texture or the factors")
    stride, rest = divmod(len(sheets), len(header.states) if header.apart else 1)
    if rest or stride < len(names):
        raise ValueError(f"part sheets: expected {len(names)} and levels for each state, found {len(sheets)}")
    places = []
    names = (names + [""] * (stride - len(names))) * (len(sheets) // stride)
    for number, row in enumerate(sheets.tolist()):
        smaller, first = row[6], number // stride * stride
        if smaller and not max(number, first + len(header.sheets) - 1) < smaller < first + stride:
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
        tuple(places[len(header.sheets) : stride]),
        header.report,
        blocks if len(blocks) else np.empty((0, 0, 16), np.uint8),
        _decoded(blocks, second),
        tuple(places[stride:]),
    )


def _decoded(blocks: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """`SceneModel.block_texels`."""
    pages = [decode_blocks(page, *size, BLOCKS).astype(np.float16) for page in blocks]
    return np.stack(pages) if pages else np.empty((0, 0, 0, 3), np.float16)


def _of_earlier(
    texels: np.ndarray, lut: np.ndarray, count: int, sheets: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The parts of an earlier file as they are now: a sheet had a page in place of a smaller level."""
    pages, rest = divmod(len(texels), count)
    if count > _MOST_EARLIER or rest:
        raise ValueError(f"part colour: expected pages of {count} layers, found {texels.shape}")
    first, size, _ = unpack_entries(lut, NO_BLOCKS)
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
