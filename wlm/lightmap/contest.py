"""Sets of Tencent's High Performance Rendering Competition (HPRC): a `config.json` and raw files of several lightmaps.

The format is that of the repository TencentGemes/HRPC_Data. A lightmap at one hour is float32 RGB, row by row, in one
file or in `parts` of equally many rows, `NAME.bin_0`, `NAME.bin_1`; its coverage is int8, 127 where a texel is valid
and -1 elsewhere. Files are found in one of two ways:

- by their names, `Original/lightmapRawData_..._ID_HQ_WIDTH_HEIGHT_HOUR.bin_PART` and
  `Mask/lightmapCoverage_..._ID_HQ_WIDTH_HEIGHT_HOUR.bin_PART`, with hours such as 18.00; a single
  mask is that of all hours;
- by `lightmaps` and `masks` of the config, which map 100 times the hour to a name in the folder, or in its `Data`.

A day has 24 hours, and hour 24 is hour 0.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from wlm.config import check_settings
from wlm.errors import WlmError
from wlm.formats.light import SUFFIXES
from wlm.formats.limits import PICTURE_SIDE, PICTURE_TEXELS, TIMES
from wlm.formats.reading import named_file, read_file, read_json_file
from wlm.lightmap.listing import SET_FILE, Listing

CONFIG_FILE = "config.json"

_VALID = 127
_DAY = 24.0
_NAMED = 8  # maps that an error lists
_FOLDERS = {"lightmapRawData": "Original", "lightmapCoverage": "Mask"}

_Files = dict[Annotated[str, Field(pattern="^[0-9]{1,6}$")], Annotated[str, Field(min_length=1)]]


class _Resolution(BaseModel):
    model_config = ConfigDict(strict=True)
    width: int = Field(ge=1, le=PICTURE_SIDE)
    height: int = Field(ge=1, le=PICTURE_SIDE)


class _Map(BaseModel):
    """One lightmap of the config: level and id tell it from the others."""

    model_config = ConfigDict(strict=True)
    id: int | str
    level: str = ""
    resolution: _Resolution
    parts: int = Field(1, ge=1)
    lightmaps: _Files | None = Field(None, min_length=1, max_length=TIMES)
    masks: _Files | None = Field(None, min_length=1, max_length=TIMES)

    @property
    def label(self) -> str:
        return f"{self.level}/{self.id}" if self.level else str(self.id)

    @property
    def size(self) -> str:
        return f"{self.resolution.width}x{self.resolution.height}"


def is_contest(folder: Path) -> bool:
    """Whether a folder has the contest's config, and no `set.json` and no lightmap beside it.

    Raises:
        WlmError: It can't be listed.
    """
    if not (folder / CONFIG_FILE).is_file() or (folder / SET_FILE).is_file():
        return False
    try:
        return not any(file.suffix.lower() in SUFFIXES for file in folder.iterdir())
    except OSError as error:
        raise WlmError(f"{folder}: cannot read: {error.strerror or error}") from error


def list_contest(folder: Path, which: str | None, times: Sequence[float] | None, trust: bool = False) -> Listing:
    """Lists the files of one lightmap of a contest's folder.

    Args:
        folder: The folder with the config.
        which: The lightmap, `ID` or `LEVEL/ID`; None where there is but one.
        times: One for each file in order of the hours, in place of these.
        trust: Whether files may lie outside the folder.

    Returns:
        The listing, with the day's period and the coverage files.

    Raises:
        WlmError: The config can't be read or a field of it is wrong; no map, or not one alone, is meant; a lightmap's
            coverage is missing; files lie outside.
    """
    config = folder / CONFIG_FILE
    chosen = _choose(config, which)
    height, width = chosen.resolution.height, chosen.resolution.width
    if height * width > PICTURE_TEXELS:
        raise WlmError(f"{config}: map {chosen.label}: expected at most {PICTURE_TEXELS:,} texels, got {chosen.size}")
    if height % chosen.parts:
        raise WlmError(f"{config}: map {chosen.label}: expected parts of equal height, got {chosen.parts} of {height}")
    light = _files(config, chosen, "lightmapRawData", chosen.lightmaps)
    masks = _files(config, chosen, "lightmapCoverage", chosen.masks)
    if len(masks) > 1 and (lacking := [hour for hour in light if hour not in masks]):
        raise WlmError(f"{config}: map {chosen.label}: no coverage (lightmapCoverage) of hour {lacking[0]:g}")
    hours = sorted(light)
    if times is not None and len(times) != len(hours):
        raise WlmError(f"{folder}: {len(times)} times for {len(hours)} lightmaps; expected one each")

    def parts(name: str) -> list[Path]:
        names = [f"{name.removesuffix('0')}{part}" for part in range(chosen.parts)] if chosen.parts > 1 else [name]
        return [named_file(config, part, f"{config}: map {chosen.label}", trust) for part in names]

    names = [light[hour] for hour in hours]
    covers = [next(iter(masks.values()))] if len(masks) == 1 else [masks[hour] for hour in hours]
    files = [parts(name) for name in names]
    return Listing(
        name=f"{folder.resolve().name}-{chosen.label.replace('/', '-')}",
        files=[first for first, *_ in files],
        times=[0.0 if hour == _DAY else hour for hour in hours] if times is None else times,
        mask="coverage",
        period=_DAY,
        size=(height, width),
        stated_by=config,
        warn_order=times is not None,
        raw=files,
        coverage=[parts(name) for name in covers],
    )


def _choose(config: Path, which: str | None) -> _Map:
    content = read_json_file(config, "the contest's set")
    entries = content.get("lightmap_list") if isinstance(content, dict) else None
    if not isinstance(entries, list) or not entries:
        raise WlmError(f"{config}: expected an object with a lightmap_list of at least one lightmap")
    maps = []
    for i, entry in enumerate(entries):
        # Other keys than these are none of ours.
        known = {key: entry[key] for key in _Map.model_fields if key in entry} if isinstance(entry, dict) else entry
        maps.append(check_settings(_Map, known, f"{config}: lightmap_list[{i}]."))
    found = [entry for entry in maps if which is None or which in (entry.label, str(entry.id))]
    if len(found) != 1:
        listed = ", ".join(f"{entry.label} ({entry.size})" for entry in maps[:_NAMED])
        more = f" and {len(maps) - _NAMED} more" if len(maps) > _NAMED else ""
        problem = "choose one with --map (map_id)" if which is None else f"{len(found)} are called {which!r}"
        raise WlmError(f"{config}: holds {len(maps)} lightmaps, {problem}: {listed}{more}")
    return found[0]


def _files(config: Path, chosen: _Map, kind: str, stated: dict[str, str] | None) -> dict[float, str]:
    """The first file of each hour, relative to the config."""
    if stated is not None:
        folder = "Data/" if (config.parent / "Data").is_dir() else ""
        return {int(key) / 100: f"{folder}{name}" for key, name in stated.items()}
    folder = config.parent / _FOLDERS[kind]
    size = f"{chosen.resolution.width}_{chosen.resolution.height}"
    pattern = re.compile(rf"{kind}_.*_{re.escape(str(chosen.id))}_HQ_{size}_([0-9]{{1,4}}(?:\.[0-9]{{1,4}})?)\.bin_0")
    try:
        names = sorted(file.name for file in folder.iterdir())
    except OSError as error:
        raise WlmError(f"{folder}: cannot read: {error.strerror or error}") from error
    found = {float(match[1]): f"{folder.name}/{name}" for name in names if (match := pattern.fullmatch(name))}
    if not found:
        raise WlmError(f"{folder}: no {kind} file of map {chosen.label} with {chosen.size} texels")
    return found


def read_raw(parts: Sequence[Path], size: tuple[int, int]) -> np.ndarray:
    """Reads a lightmap, float32 [H, W, 3].

    Raises:
        WlmError: A file is missing or has another length.
    """
    return _read(parts, (*size, 3), np.dtype("<f4"), "the lightmap")


def read_coverage(masks: Sequence[Sequence[Path]], size: tuple[int, int]) -> np.ndarray:
    """Reads the valid texels, bool [H, W] of one mask, [T, H, W] of several.

    Raises:
        WlmError: As `read_raw`.
    """
    valid = [_read(parts, size, np.dtype("i1"), "the coverage") >= _VALID for parts in masks]
    return valid[0] if len(valid) == 1 else np.stack(valid)


def _read(parts: Sequence[Path], shape: tuple[int, ...], kind: np.dtype, what: str) -> np.ndarray:
    shape = (shape[0] // len(parts), *shape[1:])
    expected = int(np.prod(shape)) * kind.itemsize
    blocks = []
    for path in parts:
        data = read_file(path, expected, what)
        if len(data) != expected:
            rows = f"{shape[1]}x{shape[0]} texels of {kind.itemsize * int(np.prod(shape[2:]))} bytes"
            raise WlmError(f"{path}: cannot read {what}: expected {expected} bytes ({rows}), found {len(data)}")
        blocks.append(np.frombuffer(data, kind).reshape(shape))
    return blocks[0] if len(blocks) == 1 else np.concatenate(blocks)
