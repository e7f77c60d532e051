"""A lightmap model as the parts of its file, and back: quantised maps, networks and scales."""

import math
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.formats.parts import Part, check_part, check_parts
from wlm.lightmap.model import LightmapModel, Profile, part_table
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.system import Header, Name

_ROUNDING = 2e-7  # relative, of stored times
_TIMES = Part((np.float32, np.float64), (None,))


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
        "profile": model.profile.changes(),
    }
    parts = {name: value for name, value in model.parts.items() if value.size}
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
    header = check_settings(_Header, artifact.settings, "setting ")
    width, height = header.size
    tiles = Part(np.uint8, (TileGrid.of(height, width).count,), most=max(TileKind))
    kind = check_part(tensors, "kind", tiles)
    times = check_part(tensors, "times", _TIMES).astype(np.float64)
    _check_times(times.tolist(), header.period)
    others = {name: part for name, part in tensors.items() if name not in ("kind", "times")}
    return LightmapModel(
        name=header.name,
        width=width,
        height=height,
        period=header.period,
        source=artifact.source,
        profile=header.profile,
        kind=kind,
        times=times,
        **check_parts(others, part_table(header.profile, kind, len(times))),
    )


def _check_times(times: list[float], period: float | None) -> None:
    if len(times) < 1 or not math.isfinite(times[-1] - times[0]) or not all(a < b for a, b in pairwise(times)):
        raise ValueError("part times: expected times that increase")
    # Files may hold a time that was rounded up to the period.
    if period is not None and not (times[0] >= 0 and times[-1] <= period * (1 + _ROUNDING)):
        raise ValueError(f"part times: expected 0 to {period:g}, the period, found {times[0]:g} to {times[-1]:g}")
