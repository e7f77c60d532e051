"""The artifact of a lightmap model: quantised maps, networks and scales in one file, and reading it back."""

import math
import os
from typing import Any

import numpy as np
from pydantic import ValidationError

from wlm.errors import WlmError
from wlm.formats.artifact import Artifact, read_artifact, write_artifact
from wlm.lightmap.model import TILE, LightmapModel, Profile
from wlm.lightmap.tiles import TileKind
from wlm_kernels import mlp

__all__ = ["SYSTEM", "read", "write"]

SYSTEM = "lightmap"

# Parts are left out of the file where they are empty; these are their types.
_PARTS = {
    "uv": np.uint8,
    "uvt": np.uint8,
    "ut": np.uint8,
    "vt": np.uint8,
    "net": np.float16,
    "net_static": np.float16,
    "scale": np.uint8,
    "scale_static": np.float16,
    "peak": np.uint8,
    "affine": np.float16,
    "constant": np.float16,
}


def write(path: str | os.PathLike[str], model: LightmapModel) -> int:
    """Writes a model to one file, atomically.

    Returns:
        The file's size in bytes.

    Raises:
        WlmError: The file can't be written; what was there before is untouched.
    """
    profile = model.profile.model_dump()
    defaults = Profile(name="").model_dump()
    settings: dict[str, Any] = {
        "name": model.name,
        "size": [model.width, model.height],
        "period": model.period,
        "profile": {key: value for key, value in profile.items() if value != defaults[key]},
    }
    tensors = {key: np.ascontiguousarray(getattr(model, key)) for key in _PARTS}
    tensors = {key: value for key, value in tensors.items() if value.size}
    tensors["kind"] = model.kind
    tensors["times"] = _exact_times(model.times)
    write_artifact(path, SYSTEM, settings, tensors, model.source)
    return os.path.getsize(path)


def _exact_times(times: np.ndarray) -> np.ndarray:
    """As float32 where that keeps them distinct and within a thousandth of a second of an hour's unit."""
    short = times.astype(np.float32)
    distinct = len(times) < 2 or np.all(np.diff(short) > 0)
    return short if distinct and np.allclose(short, times, rtol=2e-7, atol=0) else times


def read(path: str | os.PathLike[str]) -> LightmapModel:
    """Reads a model.

    Raises:
        WlmError: One line: not such a file, truncated, tampered with, of another system or version, or with parts
            that don't fit each other.
    """
    artifact = read_artifact(path, SYSTEM)
    try:
        return _model(path, artifact)
    except (LookupError, TypeError, ValueError, ValidationError) as error:
        raise WlmError(f"{path}: the file's parts do not fit its settings: {error}") from error


def _model(path, artifact: Artifact) -> LightmapModel:
    settings, tensors = artifact.settings, artifact.tensors
    profile = Profile(**settings["profile"])
    width, height = (int(v) for v in settings["size"])
    kind = tensors["kind"]
    times = tensors["times"].astype(np.float64)
    n = kind.size
    dynamic = int((kind == TileKind.DYNAMIC).sum())
    static = int((kind == TileKind.STATIC).sum())
    constant = int((kind == TileKind.CONSTANT).sum())
    mapped, t, r = dynamic + static, len(times), profile.uvt_resolution // 4
    plane = (dynamic, profile.plane_rows, profile.plane_columns, 2)
    shapes = {
        "uv": (mapped, TILE // 4, TILE // 4, 16),
        "uvt": (dynamic, profile.uvt_slices, r, r, 16),
        "ut": plane,
        "vt": plane,
        "net": (dynamic, mlp.parameter_count(profile.inputs(True), profile.hidden)),
        "net_static": (static, mlp.parameter_count(profile.inputs(False), profile.hidden)),
        "scale": (dynamic, t, 3),
        "scale_static": (static, t, 3),
        "peak": (mapped, t),
        "affine": (mapped, 2, 3),
        "constant": (constant, t, 3),
    }
    if n != math.ceil(width / TILE) * math.ceil(height / TILE) or kind.max(initial=0) > max(TileKind):
        raise ValueError(f"{n} tile kinds for a map of {width}x{height}")
    if t < 1 or not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise ValueError("times do not increase")
    parts = {}
    for key, shape in shapes.items():
        value = tensors.get(key, np.zeros(shape, _PARTS[key])) if 0 in shape else tensors[key]
        if value.shape != shape or value.dtype != _PARTS[key]:
            raise ValueError(f"part {key} is {value.dtype} {value.shape}, expected {np.dtype(_PARTS[key])} {shape}")
        parts[key] = value
    return LightmapModel(
        name=str(settings["name"]),
        width=width,
        height=height,
        times=times,
        period=None if settings["period"] is None else float(settings["period"]),
        source=artifact.source,
        profile=profile,
        kind=kind,
        **parts,
    )
