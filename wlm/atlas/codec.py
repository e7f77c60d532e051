"""The file of an atlas model: its textures, triangles and masks.

Parts: `colour` (half [pages, Hp, Wp, 3], uint32 [pages, Hp, Wp] for RGB9E5, or uint8 [1, B, 16] where T_p is stored as
blocks), `mesh` (uint8, a `.glb` file), `mask` (uint8, the bits of all masks) and, where the model has them, `lut`
(uint16 [Hc, Wc, 2 or 4]), `blocks` (uint8 [pages, B, 16], the second colour texture of the format "mixed"), `factor`
(float32 [M, C, 3], factors of tiles that M lightmaps share), `sheets` (int32 [rows, 7], the places of lightmaps in
`lut`, from `AtlasModel.table`) and `uv` (uint16 [F, 3, 2], new UVs times 65,535). A part is compressed with zstd if
that saves bytes.
"""

import math
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, JsonValue

from wlm.atlas import colour
from wlm.atlas.data import Placed
from wlm.atlas.model import (
    BLOCK_SIDE,
    BLOCKS,
    ENTRY,
    LUT_STEPS,
    MOST_SIZE,
    SHORT_ENTRY,
    AtlasModel,
    Profile,
    SheetPlace,
    check_area,
    extent,
    snapped,
    tile_counts,
    unpack_entries,
    unpack_tiles,
)
from wlm.atlas.stored import StoredScene
from wlm.config import check_settings
from wlm.formats.artifact import Artifact, encode_artifact
from wlm.formats.limits import PICTURE_SIDE, check_sides
from wlm.formats.parts import Part, check_parts
from wlm.formats.shared_exponent import pack_rgb9e5, unpack_rgb9e5
from wlm.formats.zstd import pack_parts, unpack_parts
from wlm.system import Header, Name

_MOST_FACTOR = 1e30  # sums of 255 texels times a factor are finite
_MOST_NUMBERS = 1 << 31  # limit on the length of an axis of a part
_MOST_UV_SET = 9999  # as in the names that `wlm.formats.gltf` reads
_GEOMETRY = ("mesh", "mask")

_Size = Annotated[list[Annotated[int, Field(ge=1, le=PICTURE_SIDE)]], Field(min_length=2, max_length=2)]
_Four = Annotated[list[float], Field(min_length=4, max_length=4)]


class _Object(Header):
    node: int = Field(ge=0)
    label: Name
    sheet: int = Field(ge=0)
    scale_offset: _Four = [1.0, 1.0, 0.0, 0.0]


class _Header(Header):
    """The settings of a file. All sizes are rows and columns in texels; `sizes` has one for each sheet (UV layout)."""

    name: Name
    method: Literal["tiles", "cascade", "plain", "shared"]
    colour: Literal["half", "rgb9e5", "bc6h", "astc", "mixed"]
    states: Annotated[list[Name], Field(min_length=1)]
    sheets: Annotated[list[Name], Field(min_length=1)]
    sizes: list[_Size]
    texels: _Size
    block_texels: _Size | None = None
    separate: Literal[True] | None = None
    profile: Profile
    objects: list[_Object]
    uv_set: int = Field(ge=0, le=_MOST_UV_SET)
    metres: bool
    hides: bool
    report: dict[str, JsonValue]
    parts: dict[str, list[Annotated[int, Field(ge=0, le=_MOST_NUMBERS)]]] = {}


def encode(model: AtlasModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Returns the settings, the arrays (parts) and the source hash for a model's file. Times are left out, so that
    compressing twice with one seed gives equal files. Raises a ValueError if the model stores no triangles, or its UVs
    are not rounded to 16 bits."""
    stored = model.stored
    if stored is None:
        raise ValueError(f"{model.name}: the model has no triangles: expected one that compress or load made")
    settings = {
        "name": model.name,
        "method": model.method,
        "colour": model.colour,
        "states": list(model.states),
        "sheets": [each.name for each in model.sheets],
        "sizes": [list(each.size) for each in model.sheets],
        "texels": list(model.texels.shape[1:3]),
        "profile": model.profile.changes(),
        "objects": [
            {"node": each.node, "label": each.label, "sheet": each.sheet, "scale_offset": list(each.scale_offset)}
            for each in stored.objects
        ],
        "uv_set": stored.uv_set,
        "metres": stored.metres,
        "hides": stored.hides,
        "report": {name: value for name, value in model.report.items() if name != "seconds"},
    }
    parts = {"colour": model.texels, "lut": model.lut, "factor": model.factor}
    if not np.array_equal(snapped(model.uv), model.uv):
        raise ValueError(f"{model.name}: expected new UVs that are multiples of 1/65535, found other values")
    parts["uv"] = np.rint(model.uv * LUT_STEPS).astype(np.uint16)
    if model.colour in colour.BLOCK_CODECS:
        parts["colour"] = model.blocks
    elif model.colour != "half":
        parts["colour"] = pack_rgb9e5(model.texels)
    if model.colour == "mixed":
        settings["block_texels"] = list(model.block_texels.shape[1:3])
        parts["blocks"] = model.blocks
    if model.method == "shared":
        parts["sheets"] = model.table()
        settings |= {"separate": True} if model.later else {}
    parts["mask"] = np.packbits(np.concatenate([mask.ravel() for mask in stored.masks]))
    parts["mesh"] = np.frombuffer(stored.glb, np.uint8)
    frames, settings["parts"] = pack_parts({name: part for name, part in parts.items() if part.size})
    return settings, frames, model.source


def sizes(model: AtlasModel) -> tuple[int, int]:
    """Returns the bytes of a model's whole file, and the bytes of the triangles and masks in it."""
    settings, parts, source = encode(model)
    whole = sum(memoryview(part).nbytes for part in encode_artifact(model.SYSTEM, settings, parts, source))
    return whole, sum(parts[name].nbytes for name in _GEOMETRY)


def decode(artifact: Artifact) -> AtlasModel:
    """Reconstructs an atlas model from a file's content, exactly as it was written. Raises a WlmError if a setting is
    wrong, a block's bits are invalid in its format, the triangles are damaged, or the package that decodes blocks isn't
    installed. Raises a ValueError, LookupError, TypeError or AttributeError if the parts don't match the settings."""
    header = check_settings(_Header, artifact.settings, "setting ")
    for size in header.sizes:
        check_sides("size", *size[::-1])
    parts = _checked_parts(header, artifact)
    texels, second = tuple(header.texels), tuple(header.block_texels or (0, 0))
    stored, blocks = parts["colour"], parts["blocks"]
    textures = {"texels": stored}
    if header.colour in colour.BLOCK_CODECS:
        decoded = colour.decode(stored[0], *texels, header.colour).astype(np.float16)
        textures = {"texels": decoded[None], "blocks": stored}
    elif header.colour != "half":
        textures = {"texels": unpack_rgb9e5(stored).astype(np.float16)}
    if len(blocks):
        pages = [colour.decode(page, *second, BLOCKS).astype(np.float16) for page in blocks]
        textures |= {"blocks": blocks, "block_texels": np.stack(pages)}
    places = _places(header, parts["sheets"])
    held = sum(math.prod(each.shape[:3]) for name, each in textures.items() if name.endswith("texels"))
    for place in places:
        check_area(place.size, held, math.prod(parts["lut"].shape[:2]))
    stride = len(places) // (len(header.states) if header.separate else 1)
    count = len(header.sheets)
    objects = tuple(Placed(each.node, each.label, each.sheet, tuple(each.scale_offset)) for each in header.objects)
    kept = StoredScene(
        parts["mesh"].tobytes(), objects, header.uv_set, header.metres, header.hides, _masks(header, parts["mask"])
    )
    settings = (header.name, artifact.source, header.profile, header.method, header.colour, tuple(header.states))
    textures |= {name: parts[name] for name in ("lut", "factor")} | {"uv": (parts["uv"] / LUT_STEPS).astype(np.float32)}
    rows = {"sheets": tuple(places[:count]), "levels": tuple(places[count:stride]), "later": tuple(places[stride:])}
    model = AtlasModel(*settings, **rows, **textures, stored=kept, report=header.report)
    _check_tiles(model)
    return model


def _checked_parts(header: _Header, artifact: Artifact) -> dict[str, np.ndarray]:
    shared, method = header.method == "shared", header.method
    texels, second = tuple(header.texels), header.block_texels
    if len(header.sizes) != len(header.sheets):
        raise ValueError(
            f"setting sizes: expected one for each of {len(header.sheets)} sheets, found {len(header.sizes)}"
        )
    height, width = header.sizes[0]
    if not (shared or len(header.sheets) == len(header.states) == 1):
        raise ValueError(f"settings sheets, states: expected one of each for method {method}, found more")
    if {each.sheet for each in header.objects} != set(range(len(header.sheets))):
        raise ValueError(f"setting objects: expected an object or more for each of the {len(header.sheets)} sheets")
    if header.separate and not shared:
        raise ValueError(f"setting separate: only method shared has separate tiles for each state, found {method}")
    if (second is None) == (header.colour == "mixed") or any(side % BLOCK_SIDE for side in second or ()):
        raise ValueError("setting block_texels: expected multiples of 4 where setting colour is mixed, none elsewhere")
    if header.colour == "mixed" and method in ("cascade", "plain"):
        raise ValueError(f"setting colour: method {method} has one colour texture, found mixed, which has two")
    if shared and header.colour not in ("rgb9e5", "mixed"):
        raise ValueError(f"setting colour: expected rgb9e5 or mixed for method shared, found {header.colour}")
    pages = None if shared else 1
    grid = math.prod(colour.block_grid(*texels))
    colours = {
        "half": Part(np.float16, (1, *texels, 3), least=0.0),
        "bc6h": Part(np.uint8, (1, grid, 16)),
        "astc": Part(np.uint8, (1, grid, 16)),
    }
    luts = {
        "tiles": (*tile_counts(height, width, header.profile.tile), SHORT_ENTRY),
        "cascade": (None, None, 2),
        "plain": (0, 0, 2),
        "shared": (None, None, None),
    }
    factors = (len(header.states), None, 3) if shared else (0, 0, 3)
    rows = (None, 7) if shared else (0, 7)
    bits = sum(math.prod(size) for size in header.sizes)
    table = {
        "colour": colours.get(header.colour, Part(np.uint32, (pages, *texels))),
        "lut": Part(np.uint16, luts[method]),
        "factor": Part(np.float32, factors, least=-_MOST_FACTOR, most=_MOST_FACTOR, optional=not shared),
        "sheets": Part(np.int32, rows, least=0, optional=not shared),
        "blocks": Part(np.uint8, (pages, math.prod(second or (0,)) // BLOCK_SIDE**2, 16), optional=second is None),
        "mesh": Part(np.uint8, (None,)),
        "mask": Part(np.uint8, (-(-bits // 8),)),
        "uv": Part(np.uint16, (None, 3, 2), optional=method != "cascade"),
    }
    parts = check_parts(unpack_parts(artifact.tensors, header.parts, table), table)
    if not parts["colour"].size or (method == "cascade" and not parts["lut"].size):
        raise ValueError("parts colour, lut: expected at least one texel in each of these textures, found none in one")
    if shared and not all(parts[name].size for name in ("lut", "factor", "sheets")):
        raise ValueError("expected parts lut, factor and sheets for method shared, found one missing or empty")
    if shared and parts["lut"].shape[2] not in (SHORT_ENTRY, ENTRY):
        raise ValueError(f"part lut: expected entries of 2 or 4 numbers, found {parts['lut'].shape[2]}")
    return parts


def _masks(header: _Header, bits: np.ndarray) -> tuple[np.ndarray, ...]:
    whole = np.unpackbits(bits).astype(bool)
    ends = np.cumsum([0, *(math.prod(size) for size in header.sizes)])
    masks = tuple(whole[a:b].reshape(size) for a, b, size in zip(ends, ends[1:], header.sizes, strict=False))
    if not all(mask.any() for mask in masks):
        raise ValueError("part mask: expected at least one texel of a chart in each sheet, found none")
    return masks


def _places(header: _Header, table: np.ndarray) -> list[SheetPlace]:
    """Returns the place of each sheet and mip level in the lookup texture, from the part `sheets`, whose columns are
    those of `AtlasModel.table`. That the places lie inside the lookup texture is not checked here."""
    if header.method != "shared":
        (size,), (name,) = header.sizes, header.sheets
        grid = tile_counts(*size, header.profile.tile) if header.method == "tiles" else (0, 0)
        return [SheetPlace(name, *size, 0, 0, *grid)]
    count, states = len(header.sheets), len(header.states) if header.separate else 1
    stride, rest = divmod(len(table), states)
    if rest or stride < count:
        raise ValueError(
            f"part sheets: expected {count} or more rows per state, for {states} states, found {len(table)}"
        )
    names, places = (list(header.sheets) + [""] * (stride - count)) * states, []
    for number, row in enumerate(table.tolist()):
        smaller, first = row[6], number // stride * stride
        where = f"part sheets: row {number}: expected"
        if smaller and not max(number, first + count - 1) < smaller < first + stride:
            raise ValueError(f"{where} its next mip level in a later row of its state, found row {smaller}")
        if smaller:
            names[smaller] = names[number]
        place = SheetPlace(names[number], *row)
        if min(place.size) < 1 or (number - first < count and list(place.size) != header.sizes[number - first]):
            raise ValueError(f"{where} the height and width in setting sizes, found {place.size}")
        if (place.rows, place.columns) != tile_counts(*place.size, header.profile.tile):
            raise ValueError(f"{where} as many tiles as {place.size} texels have, found {place.rows, place.columns}")
        places.append(place)
    return places


def _check_tiles(model: AtlasModel) -> None:
    """Raises ValueError if an entry of the lookup texture names texels or factors that the model doesn't have, or if
    the tiles of a sheet or mip level lie outside of the lookup texture."""
    pages, texels, second = len(model.texels), model.texels.shape[1:3], model.block_texels.shape[1:3]
    if model.method in ("tiles", "shared"):
        code = model.first_block_code
        most = MOST_SIZE if code else MOST_SIZE * BLOCK_SIDE
        if max(texels) > most or max(second) > MOST_SIZE * BLOCK_SIDE:
            raise ValueError(f"part colour: expected at most {most} texels along a side, found {max(*texels, *second)}")
        first, size, of_blocks = unpack_entries(model.lut[..., :2], code)
        if (of_blocks[..., 0] != of_blocks[..., 1]).any():
            raise ValueError("part lut: a tile's entry counts blocks along one axis and texels along the other")
        in_second = of_blocks[..., 0] & (model.colour == "mixed")
        count, page = np.ones(in_second.shape, np.int64), np.zeros(in_second.shape, np.int64)
        if model.method == "shared":
            _, _, component, count, page, _, coarse = unpack_tiles(model.lut, code)
            if (coarse > np.where(in_second, count, 0)).any():
                raise ValueError("part lut: a tile has more coarse components, of one block each, than components")
            if (component + count >= model.factor.shape[1]).any():
                raise ValueError("part lut: a tile's entry names a factor beyond the last one in part factor")
            size = np.where(count[..., None] > 0, extent(size, count, coarse), size)
        beyond = ((first + size) > np.where(in_second[..., None], second[::-1], texels[::-1])).any(-1)
        beyond |= page >= np.where(in_second, len(model.block_texels), pages)
        if (beyond & (count > 0)).any():
            raise ValueError("part lut: the rectangle of a tile reaches beyond the colour texture")
    for place in model.rows:
        if place.row + place.rows > model.lut.shape[0] or place.column + place.columns > model.lut.shape[1]:
            raise ValueError(f"part sheets: the tiles of {place.name} reach beyond the lookup texture, part lut")
