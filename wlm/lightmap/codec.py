"""A lightmap model as the parts of its file, and back: quantised maps, networks and scales."""

import math
import zlib
from collections.abc import Mapping
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.deflate import inflate
from wlm.formats.parts import Part, check_part, check_parts
from wlm.lightmap.deflated import SIZES, TILES, inflate_tiles
from wlm.lightmap.frame_packing import FRAME_SIZES, FRAMES, pack_frames, unpack_frames
from wlm.lightmap.model import LightmapModel, Profile, TimeAxis, part_table
from wlm.lightmap.packing import PACKED, STREAM_SIZES, TILE_STREAMS, pack_tiles, unpack_tiles
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.system import Header, Name

_ROUNDING = 2e-7  # relative, of stored times
_TIMES = Part((np.float32, np.float64), (None,))
_MASK = Part(np.uint8, (None,))
# What files that don't state it were made with, and a setting of the fit that is no more.
_OLD_PROFILE = {"interpolation": "network", "frames": "never"}
_OLD_SETTINGS = ("between",)


class _Header(Header):
    """The settings of a file; `size` is width and height in texels."""

    name: Name
    size: Annotated[list[int], Field(min_length=2, max_length=2)]
    period: float | None = Field(gt=0)
    profile: Profile


def encode(model: LightmapModel) -> tuple[dict[str, Any], dict[str, np.ndarray], str]:
    """Lays a model out for its file: the settings, the parts and the hash of its source."""
    settings = {
        "name": model.name,
        "size": [model.width, model.height],
        "period": model.period,
        "profile": _dated(model.profile),
    }
    plain = {name: value for name, value in model.parts.items() if name not in (*PACKED, "frames")}
    parts = {name: value for name, value in plain.items() if value.size}
    if len(model.mapped):
        parts |= pack_tiles(model.parts, model.profile, model.kind, model.mask, model.axis)
    if len(model.frames):
        parts |= pack_frames(model.frames, model.kind, model.mask)
    if not model.mask.all():
        parts["mask"] = np.frombuffer(zlib.compress(np.packbits(model.mask).tobytes(), 9), np.uint8)
    return settings, parts | {"times": _shortened(model.times)}, model.source


def _shortened(times: np.ndarray) -> np.ndarray:
    """Times as float32 where that keeps them distinct and within `_ROUNDING` of their value."""
    short = times.astype(np.float32)
    distinct = len(times) < 2 or np.all(np.diff(short) > 0)
    return short if distinct and np.allclose(short, times, rtol=_ROUNDING, atol=0) else times


def decode(artifact: Artifact) -> LightmapModel:
    """Makes a model of the parts of its file.

    Raises:
        WlmError, ValueError: A setting or a part is missing or wrong, or they don't fit each other.
    """
    tensors = artifact.tensors
    header = check_settings(_Header, _renewed(artifact.settings), "setting ")
    width, height = header.size
    tiles = Part(np.uint8, (TileGrid.of(height, width).count,), most=max(TileKind))
    kind = check_part(tensors, "kind", tiles)
    times = check_part(tensors, "times", _TIMES).astype(np.float64)
    _check_times(times.tolist(), header.period)
    mask = _mask(tensors, height, width)
    others = {name: part for name, part in tensors.items() if name not in ("kind", "times", "mask")}
    table = part_table(header.profile, kind, len(times))
    if "tiles" in others or "sizes" in others:
        packed = check_part(others, "tiles", TILES), check_part(others, "sizes", SIZES)
        others = {name: part for name, part in others.items() if name not in ("tiles", "sizes")}
        others |= inflate_tiles(*packed, table, header.profile, kind, mask)
    if "streams" in others or "stream_sizes" in others:
        packed = check_part(others, "streams", TILE_STREAMS), check_part(others, "stream_sizes", STREAM_SIZES)
        others = {name: part for name, part in others.items() if name not in ("streams", "stream_sizes")}
        axis = TimeAxis(times, header.period, header.profile.time_axis, header.profile.interpolation)
        others |= unpack_tiles(*packed, table, header.profile, kind, mask, axis)
    if "frames" in others or "frame_sizes" in others:
        packed = check_part(others, "frames", FRAMES), check_part(others, "frame_sizes", FRAME_SIZES)
        others = {name: part for name, part in others.items() if name != "frame_sizes"}
        others["frames"] = unpack_frames(*packed, table, kind, mask)
    parts = check_parts(others, table)
    for name in ("ranges", "video_ranges", "level_ranges"):
        if (parts[name][:, :, 0] > parts[name][:, :, 1]).any():
            raise ValueError(f"part {name}: expected no least above its greatest")
    model = LightmapModel(
        name=header.name,
        width=width,
        height=height,
        period=header.period,
        source=artifact.source,
        profile=header.profile,
        mask=mask,
        kind=kind,
        times=times,
        **parts,
    )
    if len(model.unpacked):
        _ = model.words  # whatever is wrong with a stream is wrong with the file
    return model


def _dated(profile: Profile) -> dict[str, Any]:
    """Settings for a file: those that differ from the defaults, and those whose default was another."""
    return profile.changes() | {name: getattr(profile, name) for name in _OLD_PROFILE}


def _renewed(settings: dict[str, Any]) -> dict[str, Any]:
    """Settings of a file as today's names have them."""
    profile = settings.get("profile")
    if not isinstance(profile, dict) or profile.keys() >= _OLD_PROFILE.keys():
        return settings
    # A file with either of them has none of the settings that are no more.
    dropped = () if profile.keys() & _OLD_PROFILE.keys() else _OLD_SETTINGS
    kept = {name: value for name, value in profile.items() if name not in dropped}
    return settings | {"profile": _OLD_PROFILE | kept}


def _mask(tensors: Mapping[str, np.ndarray], height: int, width: int) -> np.ndarray:
    """The mask, bool [H, W]; a file without one has no gaps."""
    if "mask" not in tensors:
        return np.ones((height, width), bool)
    size = -(-height * width // 8)
    stored = check_part(tensors, "mask", _MASK).tobytes()
    bits = inflate(stored, size, "part mask", f"{size} bytes, compressed, found others")
    return np.unpackbits(np.frombuffer(bits, np.uint8), count=height * width).reshape(height, width).astype(bool)


def _check_times(times: list[float], period: float | None) -> None:
    if len(times) < 1 or not math.isfinite(times[-1] - times[0]) or not all(a < b for a, b in pairwise(times)):
        raise ValueError("part times: expected times that increase")
    # Files may hold a time that was rounded up to the period.
    if period is not None and not (times[0] >= 0 and times[-1] <= period * (1 + _ROUNDING)):
        raise ValueError(f"part times: expected 0 to {period:g}, the period, found {times[0]:g} to {times[-1]:g}")
