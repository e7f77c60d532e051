"""Reading of light probes from Unity's `LightingData.asset` and `LightProbes.asset`.

UnityPy (extra `unity`) and all work by the layouts that a file contains run in a separate process (`unity_child`).
Unity's editor writes lighting data in binary whatever the serialization mode of the project; text assets, a regular
kind of YAML, come from scripts and from other tools.
"""

import os
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.formats import unity_child
from wlm.formats.child import run_child
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import PROBES
from wlm.formats.reading import damaged, read_file
from wlm.formats.unity_child import KINDS, LIGHT, LIGHTING, POSITIONS

_EXTRA = "unity"
_BYTES = 1 << 28
_COEFFICIENTS, _CHANNELS = 9, 3
_NO_LIGHTMAP = (-1, 65534, 65535)
_TEXT, _BUNDLE = b"%YAML", b"Unity"

# The lines of a text asset that are read, with a value each. No YAML is parsed: a file costs no more than its length.
_OBJECT = re.compile(rb"^--- !u!\d+ &-?\d+[^\n]*\r?\n(\w+):", re.MULTILINE)
_TEXT_POSITIONS, _TEXT_LIGHT = b"m_Positions", b"m_BakedCoefficients"
_NUMBER = rb"([-+.\w]{1,32})"
_VECTOR = re.compile(rb"\{x: " + _NUMBER + rb",\s+y: " + _NUMBER + rb",\s+z: " + _NUMBER + rb"\}")
_COEFFICIENT = re.compile(rb"^[ -]+sh\[ ?(\d{1,2})\]: " + _NUMBER + rb"\r?$", re.MULTILINE)
_NUMBERS = _COEFFICIENTS * _CHANNELS


def has_lightmap(number: Any) -> bool:
    """Tests whether the number of a renderer's lightmap names one; Unity writes -1, 65534 or 65535 for none."""
    return number is not None and number not in _NO_LIGHTMAP


@dataclass(frozen=True, eq=False)
class LightingData:
    """Content of an asset: the light probes' positions, float64 [N, 3], in Unity's axes, and their coefficients of
    `SphericalHarmonicsL2`, float64 [N, 9, 3]."""

    position: np.ndarray
    values: np.ndarray


def read_lighting_data(path: str | os.PathLike[str]) -> LightingData:
    """Reads the light probes of an asset."""
    data = read_file(path, _BYTES, "the asset")
    if data.startswith(_TEXT):
        return _read_text(path, data)
    if data.startswith(_BUNDLE):
        raise WlmError(f"{path}: expected an asset of Unity's editor, found an asset bundle")
    try:
        need("UnityPy", _EXTRA)
    except WlmError as error:
        raise WlmError(f"{path}: {error}") from error
    with damaged(f"{path}: the asset is damaged, or UnityPy cannot read its version", ValueError):
        tables = run_child(unity_child, data)
    position, light = tables[POSITIONS], tables[LIGHT]
    if not {unity_child.PROBES, LIGHTING} & set(tables[KINDS].tolist()):
        raise WlmError(f"{path}: expected Unity's lighting data or light probes, found neither")
    if len(position) != len(light):
        raise WlmError(f"{path}: expected light for each of {len(position)} probes, found light for {len(light)}")
    if len(position) > PROBES:
        raise WlmError(f"{path}: expected at most {PROBES:,} light probes, found {len(position):,}")
    return LightingData(position, light.reshape(-1, _CHANNELS, _COEFFICIENTS).transpose(0, 2, 1))


def _read_text(path: str | os.PathLike[str], data: bytes) -> LightingData:
    objects = _objects(data)
    texts = [text for kind, text in objects if kind == "LightProbes"]
    if not texts:
        found = ", ".join(sorted({kind for kind, _ in objects})[:4]) or "nothing"
        raise WlmError(
            f"{path}: expected LightProbes in this text asset, found {found} (the light of Adaptive Probe Volumes is "
            "in .bytes files, which wlm does not read: bake a Light Probe Group)"
        )
    with damaged(f"{path}: the asset is damaged", ValueError):
        positions, values = zip(*map(_probes, texts), strict=True)
    return LightingData(np.concatenate(positions), np.concatenate(values))


def _objects(data: bytes) -> list[tuple[str, bytes]]:
    starts = list(_OBJECT.finditer(data))
    ends = [*(start.start() for start in starts), len(data)][1:]
    return [(start[1].decode(), data[start.end() : end]) for start, end in zip(starts, ends, strict=True)]


def _probes(text: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads the positions, float64 [N, 3], and the coefficients, float64 [N, 9, 3], of a `LightProbes` object. Raises a
    ValueError if the lines are damaged or incomplete."""
    places = (float(number) for match in _VECTOR.finditer(_member(text, _TEXT_POSITIONS)) for number in match.groups())
    position, light = np.fromiter(places, np.float64).reshape(-1, 3), _member(text, _TEXT_LIGHT)
    values = np.fromiter((float(match[2]) for match in _COEFFICIENT.finditer(light)), np.float64)
    if len(values) != _NUMBERS * len(position):
        raise ValueError(f"expected {_NUMBERS} coefficients for each of {len(position)} probes, found {len(values)}")
    numbers = np.fromiter((int(match[1]) for match in _COEFFICIENT.finditer(light)), np.int64)
    if (numbers.reshape(-1, _NUMBERS) != np.arange(_NUMBERS)).any():
        raise ValueError(f"expected the coefficients sh[ 0] to sh[{_NUMBERS - 1}] of each probe in this order")
    return position, values.reshape(-1, 3, 9).transpose(0, 2, 1)


def _member(text: bytes, name: bytes) -> bytes:
    """Returns the lines of a member: those that are indented more than its name, or begin with - at its column."""
    start = re.search(rb"^( *)" + name + rb":[^\n]*\n", text, re.MULTILINE)
    if start is None:
        raise ValueError(f"{name.decode()} is missing")
    end = re.compile(rb"^ {0,%d}[^\s-]" % len(start[1]), re.MULTILINE).search(text, start.end())
    return text[start.end() : end.start() if end else len(text)]
