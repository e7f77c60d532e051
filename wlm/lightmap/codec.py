"""Converts a lightmap model to the named parts of its file, and back.

Parts of sheet k (up to three channels of a layer of an atlas) are called `k.NAME`. All sheets share the part `times`;
the mask of an atlas is stored with the atlas's first sheet. Each tile (its maps and network, or its BC7 frames) is one
zstd frame in the part `k.tiles`; `k.tile_sizes` has the size of each zstd frame, so that a tile can be read alone.
"""

import math
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.errors import WlmError, one_line
from wlm.formats import zstd
from wlm.formats.artifact import Artifact
from wlm.formats.limits import check_growth
from wlm.formats.parts import Part, check_part, check_parts
from wlm.lightmap.encodings import encoding_of
from wlm.lightmap.model import LightmapModel, SheetModel, part_table
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import MOST_NAME, MOST_SHEETS, WIDTH, Sheet, check_sheets
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.system import Header, Name
from wlm.workers import each

PACKED = ("uv", "uvt", "ut", "vt", "net", "net_static", "frames")
"""The arrays of a sheet that are packed by tile."""

_ROUNDING = 2e-7  # relative, of stored times
_TIMES = Part((np.float32, np.float64), (None,))
_BYTES = Part(np.uint8, (None,))
_SIZES = Part(np.uint32, (None,))
_Word = Annotated[Name, Field(min_length=1, max_length=MOST_NAME)]


class _SheetHeader(Header):
    """Settings of a sheet in a file; `size` is width and height in texels."""

    name: Name
    atlas: _Word
    layer: _Word
    channels: Annotated[list[_Word], Field(min_length=1, max_length=WIDTH)]
    encoding: Literal["radiance", "unit", "signed"]
    size: Annotated[list[int], Field(min_length=2, max_length=2)]


class _Header(Header):
    name: Name
    period: float | None = Field(gt=0)
    profile: Profile
    sheets: Annotated[list[_SheetHeader], Field(min_length=1, max_length=MOST_SHEETS)]


def encode(model: LightmapModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Converts a model to the content of its file.

    Returns:
        The settings, the parts by name, and the hash of the input that the model was made from.
    """
    headers, parts, masks = [], {"times": _shortened(model.times)}, set()
    for number, (sheet, own) in enumerate(model.sheets.items()):
        headers.append(
            {
                "name": own.name,
                "atlas": sheet.atlas,
                "layer": sheet.layer,
                "channels": list(sheet.channels),
                "encoding": sheet.encoding,
                "size": [own.width, own.height],
            }
        )
        stored = {name: value for name, value in own.parts.items() if name not in PACKED and value.size}
        stored |= _pack_tiles(own)
        key = sheet.atlas, own.mask.shape
        if key not in masks and not own.mask.all():
            stored["mask"] = np.frombuffer(zstd.compress(np.packbits(own.mask).tobytes()), np.uint8)
        masks.add(key)
        parts |= {f"{number}.{name}": value for name, value in stored.items()}
    settings = {"name": model.name, "period": model.period, "profile": model.profile.changes(), "sheets": headers}
    return settings, parts, model.source


def decode(artifact: Artifact) -> LightmapModel:
    """Makes a model from the parts of its file.

    Raises:
        WlmError, ValueError: A setting or a part is missing or wrong, or they do not fit each other.
    """
    header = check_settings(_Header, artifact.settings, "setting ")
    sheets = [Sheet(item.atlas, item.layer, tuple(item.channels), item.encoding) for item in header.sheets]
    if len(set(sheets)) < len(sheets):
        raise ValueError("setting sheets: expected different sheets, found one twice")
    sizes = [(item.size[1], item.size[0]) for item in header.sheets]
    if min(map(min, sizes)) < 1:
        raise ValueError("setting size: expected a width and a height of at least 1 texel for each sheet")
    check_sheets("setting sheets", dict(zip(sheets, sizes, strict=True)))
    times = check_part(artifact.tensors, "times", _TIMES).astype(np.float64)
    _check_times(times.tolist(), header.period)
    parts = _by_sheet(artifact.tensors, len(sheets))
    tables, unpacked = [], 0
    for number, (sheet, size) in enumerate(zip(sheets, sizes, strict=True)):
        with _named(number):
            count = TileGrid.of(*size).count
            kind = check_part(parts[number], "kind", Part(np.uint8, (count,), most=max(TileKind)))
            tables.append(part_table(header.profile.for_sheet(sheet), kind, len(times)))
        unpacked += sum(math.prod(tables[-1][name].shape) for name in PACKED)
    # Before memory is allocated for any sheet.
    check_growth("the file", sum(value.nbytes for value in artifact.tensors.values()), unpacked)
    masks: dict[tuple[str, tuple[int, int]], np.ndarray] = {}
    models: dict[Sheet, SheetModel] = {}
    for number, (sheet, item, table) in enumerate(zip(sheets, header.sheets, tables, strict=True)):
        own, key = parts[number], (sheet.atlas, sizes[number])
        if key in masks and "mask" in own:
            raise ValueError(f"part {number}.mask: expected a mask only with the first sheet of its atlas and size")
        with _named(number):
            if key not in masks:
                masks[key] = _mask(own, *sizes[number])
            plain = {name: part for name, part in table.items() if name not in PACKED}
            packed = {name: own[name] for name in ("tiles", "tile_sizes") if name in own}
            rest = {name: value for name, value in own.items() if name not in ("kind", "mask", *packed)}
            arrays = check_parts(rest, plain)
            arrays |= {name: np.zeros(table[name].shape, table[name].dtype) for name in PACKED}
            models[sheet] = SheetModel(
                name=item.name,
                width=item.size[0],
                height=item.size[1],
                times=times,
                period=header.period,
                profile=header.profile.for_sheet(sheet),
                mask=masks[key],
                kind=own["kind"],
                **arrays,
            )
            _unpack_tiles(models[sheet], packed)
            check_parts({name: getattr(models[sheet], name) for name in PACKED}, {name: table[name] for name in PACKED})
            if (arrays["ranges"][:, :, 0] > arrays["ranges"][:, :, 1]).any():
                raise ValueError("part ranges: expected the least colour of a frame not to exceed its greatest colour")
    return LightmapModel(name=header.name, source=artifact.source, profile=header.profile, sheets=models)


def part_bytes(model: LightmapModel, file_bytes: int) -> dict[str, int]:
    """Returns the size in bytes of each part of a model's file, summed over all sheets, largest part first.

    `tiles` is the size of the packed tiles, and `header` the size of the file's header and of the table of tile sizes.

    Raises:
        ValueError: `file_bytes` is less than the sum of the parts.
    """
    parts: dict[str, int] = {}
    for name, value in encode(model)[1].items():
        name = name.rpartition(".")[2]
        if name != "tile_sizes":
            parts[name] = parts.get(name, 0) + value.nbytes
    parts["header"] = file_bytes - sum(parts.values())
    if parts["header"] < 0:
        raise ValueError(f"file_bytes: expected at least {file_bytes - parts['header']} bytes, got {file_bytes}")
    return dict(sorted(((name, size) for name, size in parts.items() if size), key=lambda part: -part[1]))


def sheet_bytes(model: LightmapModel) -> dict[Sheet, int]:
    """Returns each sheet's bytes in the file; the mask that an atlas's sheets share counts for the first of them."""
    sizes = [0] * len(model.sheets)
    for name, value in encode(model)[1].items():
        number, _, own = name.partition(".")
        if own:
            sizes[int(number)] += value.nbytes
    return dict(zip(model.sheets, sizes, strict=True))


def tile_sizes(sheet: SheetModel) -> np.ndarray:
    """Returns the size in bytes of each tile's zstd frame, int [tiles]; 0 for tiles without a zstd frame."""
    sizes = np.zeros(len(sheet.kind), int)
    sizes[_packed_tiles(sheet)] = _pack_tiles(sheet).get("tile_sizes", ())
    return sizes


def _packed_tiles(sheet: SheetModel) -> list[int]:
    kinds = {int(kind): encoding_of(kind) for kind in np.unique(sheet.kind)}
    numbers = np.flatnonzero(sheet.kind).tolist()
    return [number for number in numbers if kinds[int(sheet.kind[number])].packed_size(sheet, number)]


def _pack_tiles(sheet: SheetModel) -> dict[str, np.ndarray]:
    """Packs each tile as one zstd frame. Returns the parts `tiles`, uint8, and `tile_sizes`, uint32 [n]."""

    def pack(number: int) -> bytes:
        return zstd.compress(*encoding_of(sheet.kind[number]).pack(sheet, number))

    frames = list(each(pack, _packed_tiles(sheet)))
    if not frames:
        return {}
    sizes = np.array([len(frame) for frame in frames], np.uint32)
    return {"tiles": np.frombuffer(b"".join(frames), np.uint8), "tile_sizes": sizes}


def _unpack_tiles(sheet: SheetModel, packed: Mapping[str, np.ndarray]) -> None:
    numbers = _packed_tiles(sheet)
    for number in set(np.flatnonzero(sheet.kind).tolist()).difference(numbers):
        encoding_of(sheet.kind[number]).unpack(sheet, number, np.empty(0, np.uint8))
    if not numbers and not packed:
        return
    tiles, sizes = (check_part(packed, name, part) for name, part in (("tiles", _BYTES), ("tile_sizes", _SIZES)))
    if len(sizes) != len(numbers) or int(sizes.sum(dtype=np.uint64)) != len(tiles):
        raise ValueError(
            f"part tile_sizes: expected the sizes of {len(numbers)} tiles, {len(tiles)} bytes in all, found other sizes"
        )
    ends = np.cumsum(sizes.astype(np.int64)).tolist()

    def unpack(job: tuple[int, int, int]) -> None:
        number, end, size = job
        encoding = encoding_of(sheet.kind[number])
        frame, name = tiles[end - size : end].tobytes(), f"part tiles: tile {number}"
        data = zstd.decompress(frame, encoding.packed_size(sheet, number), name)
        try:
            encoding.unpack(sheet, number, np.frombuffer(data, np.uint8))
        except ValueError as error:
            raise ValueError(f"{name}: {error}") from error

    for _ in each(unpack, zip(numbers, ends, sizes.tolist(), strict=True)):
        continue


@contextmanager
def _named(number: int) -> Iterator[None]:
    try:
        yield
    except (WlmError, ValueError) as error:
        raise ValueError(f"sheet {number}: {error}") from error


def _by_sheet(tensors: Mapping[str, np.ndarray], count: int) -> list[dict[str, np.ndarray]]:
    """Sorts the parts by sheet, with names without the sheet's number; the shared part `times` is left out."""
    parts: list[dict[str, np.ndarray]] = [{} for _ in range(count)]
    for name, value in tensors.items():
        number, _, own = name.partition(".")
        if re.fullmatch("0|[1-9][0-9]{0,3}", number) and int(number) < count and own:
            parts[int(number)][own] = value
        elif name != "times":
            raise ValueError(f"part {one_line(name, 60)}: a lightmap file has no part of this name")
    return parts


def _shortened(times: np.ndarray) -> np.ndarray:
    """Returns the times as float32 if they stay distinct and change by at most `_ROUNDING`, else unchanged."""
    short = times.astype(np.float32)
    distinct = len(times) < 2 or np.all(np.diff(short) > 0)
    return short if distinct and np.allclose(short, times, rtol=_ROUNDING, atol=0) else times


def _mask(tensors: Mapping[str, np.ndarray], height: int, width: int) -> np.ndarray:
    """Reads the mask from the parts, bool [H, W]; if the file has no mask, all texels are valid."""
    if "mask" not in tensors:
        return np.ones((height, width), bool)
    bits = zstd.decompress(check_part(tensors, "mask", _BYTES).tobytes(), -(-height * width // 8), "part mask")
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=height * width).reshape(height, width).astype(bool)


def _check_times(times: list[float], period: float | None) -> None:
    if len(times) < 1 or not math.isfinite(times[-1] - times[0]) or not all(a < b for a, b in pairwise(times)):
        raise ValueError("part times: expected finite times that increase")
    # A file may hold a time that was rounded up to the period.
    if period is not None and not (times[0] >= 0 and times[-1] <= period * (1 + _ROUNDING)):
        raise ValueError(f"part times: expected 0 to the period {period:g}, found {times[0]:g} to {times[-1]:g}")
