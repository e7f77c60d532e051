"""A layered model as the parts of its file, and back: those of `wlm.lightmap.codec` for each sheet, numbered.

Times are stored once, and the mask of an atlas with its first sheet.
"""

import dataclasses
import re
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.errors import WlmError, one_line
from wlm.formats.artifact import Artifact
from wlm.formats.limits import VIDEO_BYTES, VIDEO_GROWTH, check_growth
from wlm.lightmap import codec
from wlm.lightmap.layers.listing import MOST_NAME
from wlm.lightmap.layers.model import LayeredModel
from wlm.lightmap.layers.sheet import MOST_SHEETS, WIDTH, Sheet, check_sheets
from wlm.lightmap.model import LightmapModel
from wlm.system import Header, Name

_TIMES, _MASK = "times", "mask"
_Word = Annotated[Name, Field(min_length=1, max_length=MOST_NAME)]


class _SheetHeader(Header):
    """What a file says of a sheet; `settings` are those of its lightmap model."""

    atlas: _Word
    layer: _Word
    channels: Annotated[list[_Word], Field(min_length=1, max_length=WIDTH)]
    encoding: Literal["radiance", "unit", "signed"]
    source: _Word
    settings: dict[str, Any]


class _Header(Header):
    """The settings of a file."""

    name: Name
    sheets: Annotated[list[_SheetHeader], Field(min_length=1, max_length=MOST_SHEETS)]


def encode(model: LayeredModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Lays a model out for its file: the settings, the parts and the hash of its source."""
    headers, parts = [], {}
    for number, (sheet, own, settings, stored) in enumerate(_stored(model)):
        headers.append(
            {
                "atlas": sheet.atlas,
                "layer": sheet.layer,
                "channels": list(sheet.channels),
                "encoding": sheet.encoding,
                "source": own.source,
                "settings": settings,
            }
        )
        for name, value in stored.items():
            parts[name if name == _TIMES else f"{number}.{name}"] = value
    return {"name": model.name, "sheets": headers}, parts, model.source


def sheet_bytes(model: LayeredModel) -> dict[Sheet, int]:
    """Bytes of the parts of each sheet in the file; what sheets share counts for the first."""
    return {sheet: sum(value.nbytes for value in stored.values()) for sheet, _, _, stored in _stored(model)}


def _stored(model: LayeredModel) -> Iterator[tuple[Sheet, LightmapModel, dict[str, Any], dict[str, np.ndarray]]]:
    """Each sheet with its model, the settings and the parts that are stored of it."""
    atlases: set[str] = set()
    for sheet, own in model.sheets.items():
        settings, parts, _ = codec.encode(own)
        shared = ((_TIMES,) if atlases else ()) + ((_MASK,) if sheet.atlas in atlases else ())
        atlases.add(sheet.atlas)
        yield sheet, own, settings, {name: value for name, value in parts.items() if name not in shared}


def decode(artifact: Artifact) -> LayeredModel:
    """Makes a model of the parts of its file.

    Raises:
        WlmError, ValueError: A setting or a part is missing or wrong, or they don't fit each other.
    """
    header = check_settings(_Header, artifact.settings, "setting ")
    sheets = [Sheet(item.atlas, item.layer, tuple(item.channels), item.encoding) for item in header.sheets]
    if len(set(sheets)) < len(sheets):
        raise ValueError("setting sheets: expected each of them once")
    sizes = {sheet: _size(item.settings) for sheet, item in zip(sheets, header.sheets, strict=True)}
    check_sheets("setting sheets", sizes)
    parts = _by_sheet(artifact.tensors, len(sheets))
    stored = sum(value.nbytes for value in artifact.tensors.values())
    first: dict[str, int] = {}  # sheets of each atlas
    models: dict[Sheet, LightmapModel] = {}
    unpacked = filmed = 0
    for number, (sheet, item) in enumerate(zip(sheets, header.sheets, strict=True)):
        own = parts[number] | {name: artifact.tensors[name] for name in artifact.tensors.keys() & {_TIMES}}
        if (holder := first.setdefault(sheet.atlas, number)) != number:
            if _MASK in own:
                raise ValueError(f"part {number}.{_MASK}: expected it with sheet {holder}, the first of that atlas")
            own |= {name: parts[holder][name] for name in parts[holder].keys() & {_MASK}}
        try:
            model = codec.decode(dataclasses.replace(artifact, settings=item.settings, source=item.source, tensors=own))
        except (WlmError, ValueError) as error:
            raise ValueError(f"sheet {number}: {error}") from error
        if holder != number:
            model.mask = models[sheets[holder]].mask
        unpacked += sum(value.nbytes for value in model.parts.values())
        check_growth("the file", stored, unpacked)
        if len(model.unpacked):
            filmed += model.words.nbytes
            check_growth("the file's video and levels", stored, filmed, VIDEO_GROWTH, VIDEO_BYTES)
        models[sheet] = model
    if len({model.period for model in models.values()}) > 1:
        raise ValueError("setting sheets: expected one period")
    return LayeredModel(name=header.name, source=artifact.source, sheets=models)


def _size(settings: dict[str, Any]) -> tuple[int, int]:
    """Height and width of a sheet, before anything is made of them."""
    size = settings.get("size")
    if not isinstance(size, list) or len(size) != 2 or not all(type(side) is int and side > 0 for side in size):
        raise ValueError("setting size: expected width and height of each sheet")
    return size[1], size[0]


def _by_sheet(tensors: Mapping[str, np.ndarray], count: int) -> list[dict[str, np.ndarray]]:
    """The parts of each sheet, by their names without its number; `times` is none of them."""
    parts: list[dict[str, np.ndarray]] = [{} for _ in range(count)]
    for name, value in tensors.items():
        number, _, own = name.partition(".")
        if re.fullmatch("0|[1-9][0-9]{0,3}", number) and int(number) < count and own and own != _TIMES:
            parts[int(number)][own] = value
        elif name != _TIMES:
            raise ValueError(f"part {one_line(name, 60)} is none of the file's")
    return parts
