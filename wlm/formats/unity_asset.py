"""Unity's `LightingData.asset` and `LightProbes.asset`: light probes, and where renderers are in lightmaps.

UnityPy (extra `unity`) reads the file, which says itself how its objects are laid out. Only binary assets: Unity writes
lighting data so whatever a project's serialization mode is.
"""

import os
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.errors import WlmError, one_line
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import PROBES
from wlm.formats.reading import read_file

_EXTRA = "unity"
_BYTES = 1 << 28
_COEFFICIENTS, _CHANNELS = 9, 3
_NO_LIGHTMAP = 65534  # from this number on the renderer has none
# What UnityPy and Python raise on files that are damaged or of a later version.
_FAULTS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    NotImplementedError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    struct.error,
)
_TEXT = b"%YAML"
_BUNDLE = b"Unity"


@dataclass(frozen=True)
class Rectangle:
    """Where a renderer is in its lightmap.

    Attributes:
        lightmap: The number of the lightmap.
        scale_offset: `lightmapScaleOffset`: UV times the first two, plus the last two, v up.
    """

    lightmap: int
    scale_offset: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class LightingData:
    """What an asset holds.

    Attributes:
        position: float64 [N, 3], of the light probes, in Unity's axes.
        values: float64 [N, 9, 3], numbers of `SphericalHarmonicsL2`.
        rectangles: Of the renderers with a lightmap, in the file's order; it has no names of them.
    """

    position: np.ndarray
    values: np.ndarray
    rectangles: tuple[Rectangle, ...]


def read_lighting_data(path: str | os.PathLike[str]) -> LightingData:
    """Reads an asset.

    Raises:
        WlmError: UnityPy is missing; or the file is, or is damaged, text, a bundle or of something else.
    """
    unity = need("UnityPy", _EXTRA)
    data = read_file(path, _BYTES, "the asset")
    if data.startswith((_TEXT, _BUNDLE)):
        found = "YAML" if data.startswith(_TEXT) else "an asset bundle"
        raise WlmError(f"{path}: expected a binary asset of Unity's editor, found {found}")
    probes: list[dict[str, Any]] = []
    rectangles: list[Rectangle] = []
    known = False
    try:
        for item in unity.load(data).objects:
            kind = item.type.name
            if kind == "LightProbes":
                probes.append(item.read_typetree())
            elif kind == "LightingDataAsset":
                for renderer in item.read_typetree().get("m_LightmappedRendererData", ()):
                    if renderer["lightmapIndex"] < _NO_LIGHTMAP:
                        place = tuple(float(renderer["lightmapST"][key]) for key in "xyzw")
                        rectangles.append(Rectangle(int(renderer["lightmapIndex"]), place))
            else:
                continue
            known = True
        positions = [_vectors(each["m_Data"]["m_Positions"]) for each in probes]
        values = [_harmonics(each["m_BakedCoefficients"]) for each in probes]
    except _FAULTS as error:
        reason = one_line(f"{type(error).__name__}: {error}", 120)
        raise WlmError(f"{path}: the asset is damaged, or of a version that UnityPy can't read: {reason}") from error
    if not known:
        raise WlmError(f"{path}: expected Unity's lighting data or light probes, found neither")
    for place, value in zip(positions, values, strict=True):
        if len(place) != len(value):
            raise WlmError(f"{path}: expected light for each of {len(place)} light probes, found that of {len(value)}")
    position = np.concatenate([np.empty((0, 3)), *positions])
    if len(position) > PROBES:
        raise WlmError(f"{path}: expected at most {PROBES:,} light probes, found {len(position):,}")
    light = np.concatenate([np.empty((0, _COEFFICIENTS, _CHANNELS)), *values])
    return LightingData(position, light, tuple(rectangles))


def _vectors(rows: list[dict[str, float]]) -> np.ndarray:
    return np.array([[row["x"], row["y"], row["z"]] for row in rows], np.float64).reshape(-1, 3)


def _harmonics(rows: list[dict[str, float]]) -> np.ndarray:
    """Nine numbers of red, nine of green, nine of blue."""
    numbers = [[row[f"sh[{i:2d}]"] for i in range(_COEFFICIENTS * _CHANNELS)] for row in rows]
    return np.array(numbers, np.float64).reshape(-1, _CHANNELS, _COEFFICIENTS).transpose(0, 2, 1)
