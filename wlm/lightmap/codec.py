"""Converts a lightmap model to the named parts of its file, and back.

Parts of sheet k (up to three channels of a layer of an atlas) are called `k.NAME`. The part `times` is of the first
light group, and `k.times` of a further group, whose first sheet is k. The mask of an atlas is stored with the atlas's
first sheet, for all groups. Each tile (its maps and network, or its BC7 frames) is one zstd frame, a piece of the split
part `k.tiles`, so that it is read alone (`wlm.formats.artifact`).
"""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.errors import WlmError, one_line
from wlm.formats import zstd
from wlm.formats.artifact import Artifact, Content, Pieces
from wlm.formats.limits import check_growth
from wlm.formats.parts import Part, check_part, check_parts
from wlm.lightmap.encodings import encoding_of
from wlm.lightmap.model import PACKED, PACKED_KINDS, LightmapModel, SheetModel, part_table, tiles_of
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import BASE, MOST_NAME, MOST_SHEETS, WIDTH, Sheet, check_sheets
from wlm.lightmap.stored import PackedMask, StoredTiles
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.system import Header, Name
from wlm.workers import each

_STATIC = 2  # kind of tiles of one pattern for all times
_TIMES = Part(np.float64, (None,))
_BYTES = Part(np.uint8, (None,))
_Word = Annotated[Name, Field(min_length=1, max_length=MOST_NAME)]


class _SheetHeader(Header):
    """Settings of a sheet in a file; `size` is width and height in texels."""

    name: Name
    atlas: _Word
    layer: _Word
    channels: Annotated[list[_Word], Field(min_length=1, max_length=WIDTH)]
    encoding: Literal["radiance", "unit", "signed"]
    group: _Word = BASE
    size: Annotated[list[int], Field(min_length=2, max_length=2)]


class _Header(Header):
    tiles: Literal["plain"]  # the form of tiles
    name: Name
    period: float | None = Field(gt=0)
    profile: Profile
    sheets: Annotated[list[_SheetHeader], Field(min_length=1, max_length=MOST_SHEETS)]


def encode(model: LightmapModel) -> tuple[dict[str, Any], dict[str, Content], str]:
    """Converts a model to the content of its file. Tiles of a file that were not read stay in it, and are copied later.
    Returns the settings, the parts by name, and the hash of the input that the model was made from."""
    headers: list[dict[str, Any]] = []
    parts: dict[str, Content] = {}
    masks, groups = set(), set[str]()
    for number, (sheet, own) in enumerate(model.sheets.items()):
        if sheet.group not in groups:
            parts[f"{number}.times" if groups else "times"] = own.times
        groups.add(sheet.group)
        headers.append(
            ({} if sheet.group == BASE else {"group": sheet.group})
            | {
                "name": own.name,
                "atlas": sheet.atlas,
                "layer": sheet.layer,
                "channels": list(sheet.channels),
                "encoding": sheet.encoding,
                "size": [own.width, own.height],
            }
        )
        stored: dict[str, Content] = {name: part for name, part in own.plain.items() if part.size}
        if len(packed := _packed(own)):
            stored["tiles"] = packed
        key = sheet.atlas, own.mask.shape
        if key not in masks and not own.mask.all():
            stored["mask"] = np.frombuffer(zstd.compress(np.packbits(own.mask).tobytes()), np.uint8)
        masks.add(key)
        parts |= {f"{number}.{name}": value for name, value in stored.items()}
    settings = {"tiles": "plain", "name": model.name, "period": model.period, "sheets": headers}
    return settings | {"profile": model.profile.changes()}, parts, model.source


def decode(artifact: Artifact) -> LightmapModel:
    """Makes a model from the parts of its file, without its packed tiles, which the model reads when they are used.
    Raises a WlmError or ValueError if a setting or a part is missing or wrong, or they do not fit each other."""
    if "tiles" not in artifact.settings:
        raise ValueError("setting tiles: missing, as in files of an earlier version: compress the input again")
    header = check_settings(_Header, artifact.settings, "setting ")
    sheets = [Sheet(item.atlas, item.layer, tuple(item.channels), item.encoding, item.group) for item in header.sheets]
    if len(set(sheets)) < len(sheets):
        raise ValueError("setting sheets: expected different sheets, found one twice")
    sizes = [(item.size[1], item.size[0]) for item in header.sheets]
    if min(map(min, sizes)) < 1:
        raise ValueError("setting size: expected a width and a height of at least 1 texel for each sheet")
    check_sheets("setting sheets", dict(zip(sheets, sizes, strict=True)))
    times = {sheets[0].group: _read_times(artifact.tensors, header.period)}
    parts = _by_sheet({**artifact.tensors, **artifact.pieces}, len(sheets))
    tables, profiles, unpacked = [], [], 0
    for number, (sheet, size) in enumerate(zip(sheets, sizes, strict=True)):
        with _named(number):
            count = TileGrid.of(*size).count
            arrays = {name: part for name, part in parts[number].items() if isinstance(part, np.ndarray)}
            if sheet.group not in times:
                times[sheet.group] = _read_times(arrays, header.period)
                del parts[number]["times"]
            kind = check_part(arrays, "kind", Part(np.uint8, (count,), most=max(TileKind)))
            if (kind == _STATIC).any():
                raise ValueError("part kind: found a static tile of an earlier version: compress the input again")
            stamps = times[sheet.group]
            profiles.append(header.profile.for_times(len(stamps)).for_sheet(sheet))
            tables.append(part_table(profiles[-1], kind, len(stamps)))
        unpacked += sum(math.prod(tables[-1][name].shape) for name in PACKED)
    # Before memory is allocated for any sheet.
    check_growth("the file", sum(map(_bytes_of, (*artifact.tensors.values(), *artifact.pieces.values()))), unpacked)
    masks: dict[tuple[str, tuple[int, int]], PackedMask] = {}
    models: dict[Sheet, SheetModel] = {}
    for number, (sheet, item, table) in enumerate(zip(sheets, header.sheets, tables, strict=True)):
        own, key = parts[number], (sheet.atlas, sizes[number])
        if key in masks and "mask" in own:
            raise ValueError(f"part {number}.mask: expected a mask only with the first sheet of its atlas and size")
        with _named(number):
            tiles = own.pop("tiles", [])
            arrays = {name: part for name, part in own.items() if isinstance(part, np.ndarray)}
            if isinstance(tiles, np.ndarray) or len(arrays) < len(own):
                raise ValueError("expected the tiles alone as a split part, found others")
            where = f"{tiles.path}: " if isinstance(tiles, Pieces) else ""
            if key not in masks:
                frame = check_part(arrays, "mask", _BYTES).tobytes() if "mask" in arrays else None
                masks[key] = PackedMask(f"{where}sheet {item.name}", sizes[number], frame)
                masks[key].check()
            kind = arrays.pop("kind")
            numbers = tiles_of(kind, PACKED_KINDS)
            if len(tiles) != len(numbers):
                raise ValueError(f"part tiles: expected a piece for each of {len(numbers)} tiles, found {len(tiles)}")
            arrays.pop("mask", None)
            plain = check_parts(arrays, {name: part for name, part in table.items() if name not in PACKED})
            if (plain["ranges"][:, :, 0] > plain["ranges"][:, :, 1]).any():
                raise ValueError("part ranges: expected the least colour of a frame not to exceed its greatest colour")
        models[sheet] = SheetModel.of_file(
            StoredTiles(f"{where}sheet {item.name}", numbers, tiles, masks[key]),
            name=item.name,
            width=item.size[0],
            height=item.size[1],
            times=times[sheet.group],
            period=header.period,
            profile=profiles[number],
            kind=kind,
            **plain,
        )
    return LightmapModel(name=header.name, source=artifact.source, profile=header.profile, sheets=models)


def _packed(sheet: SheetModel) -> Sequence[bytes]:
    """Returns a zstd frame for each packed tile: those of the file if they were not read, else packed now."""

    def pack(number: int) -> bytes:
        return zstd.compress(encoding_of(sheet.kind[number]).pack(sheet, number))

    return list(each(pack, sheet.numbers(*PACKED_KINDS).tolist())) if sheet.pieces is None else sheet.pieces


def _bytes_of(part: Content) -> int:
    if isinstance(part, np.ndarray):
        return part.nbytes
    return int(part.sizes.sum()) if isinstance(part, Pieces) else sum(map(len, part))


@contextmanager
def _named(number: int) -> Iterator[None]:
    try:
        yield
    except (WlmError, ValueError) as error:
        raise ValueError(f"sheet {number}: {error}") from error


def _by_sheet(tensors: Mapping[str, Content], count: int) -> list[dict[str, Content]]:
    """Sorts the parts by sheet, with names without the sheet's number; the shared part `times` is left out."""
    parts: list[dict[str, Content]] = [{} for _ in range(count)]
    for name, value in tensors.items():
        number, _, own = name.partition(".")
        if re.fullmatch("0|[1-9][0-9]{0,3}", number) and int(number) < count and own:
            parts[int(number)][own] = value
        elif name != "times":
            raise ValueError(f"part {one_line(name, 60)}: a lightmap file has no part of this name")
    return parts


def _read_times(arrays: Mapping[str, np.ndarray], period: float | None) -> np.ndarray:
    """Returns the stored times of a group from the part `times`, float64 [T]."""
    stamps = check_part(arrays, "times", _TIMES)
    times = stamps.tolist()
    if len(times) < 1 or not math.isfinite(times[-1] - times[0]) or not all(a < b for a, b in pairwise(times)):
        raise ValueError("part times: expected finite times that increase")
    if period is not None and not (times[0] >= 0 and times[-1] <= period):
        raise ValueError(f"part times: expected 0 to the period {period:g}, found {times[0]:g} to {times[-1]:g}")
    return stamps
