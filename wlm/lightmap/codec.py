"""A lightmap model as the parts of its file, and back: quantised maps, networks and scales."""

from typing import Any

import numpy as np

from wlm.config import check_settings
from wlm.formats.artifact import Artifact
from wlm.lightmap.model import LightmapModel, Profile, part_table
from wlm.lightmap.tiles import TileGrid, TileKind
from wlm.system import Part, check_parts


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
    """Times as float32 where that keeps them distinct and within 2e-7 of their value."""
    short = times.astype(np.float32)
    distinct = len(times) < 2 or np.all(np.diff(short) > 0)
    return short if distinct and np.allclose(short, times, rtol=2e-7, atol=0) else times


def decode(artifact: Artifact) -> LightmapModel:
    """Makes a model of the parts of its file.

    Raises:
        WlmError, ValueError, TypeError, LookupError: The parts don't fit the settings; see `wlm.system.decode`.
    """
    settings, tensors = artifact.settings, artifact.tensors
    profile = check_settings(Profile, settings["profile"], "profile.")
    width, height = (int(size) for size in settings["size"])
    tiles = Part(np.uint8, (TileGrid.of(height, width).count,))
    kind, times = check_parts(tensors, {"kind": tiles, "times": Part((np.float32, np.float64), (None,))}).values()
    if kind.max() > max(TileKind):
        raise ValueError(f"part kind: expected 0 to {max(TileKind)}, found {kind.max()}")
    if len(times) < 1 or (np.diff(times) <= 0).any():
        raise ValueError("part times: expected times that increase")
    return LightmapModel(
        name=str(settings["name"]),
        width=width,
        height=height,
        times=times.astype(np.float64),
        period=None if settings["period"] is None else float(settings["period"]),
        source=artifact.source,
        profile=profile,
        kind=kind,
        **check_parts(tensors, part_table(profile, kind, len(times))),
    )
