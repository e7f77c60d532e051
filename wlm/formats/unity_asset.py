"""Reading of light probes and lightmap rectangles from Unity's `LightingData.asset` and `LightProbes.asset`.

UnityPy (extra `unity`) and all work by the layouts that a file contains run in a separate process (`unity_child`).
Unity's editor writes lighting data in binary whatever the serialization mode of the project; text assets
(`unity_text`) come from scripts and from other tools.
"""

import json
import os
import struct
import subprocess
import sys
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.formats import unity_child, unity_text
from wlm.formats.hdr_blocks import need
from wlm.formats.limits import PROBES
from wlm.formats.reading import damaged, read_file
from wlm.formats.unity_child import LIGHT, POSITIONS, RENDERERS, WANTED

_EXTRA = "unity"
_BYTES = 1 << 28
_SECONDS = 60.0  # wall-clock limit of the process; its CPU time is limited further
_COEFFICIENTS, _CHANNELS = 9, 3
_NO_LIGHTMAP = 65534  # indices from here on mean that the renderer has no lightmap
_TEXT, _BUNDLE = b"%YAML", b"Unity"


@dataclass(frozen=True)
class Rectangle:
    """The rectangle of a renderer in its lightmap.

    Attributes:
        lightmap: Index of the lightmap.
        scale_offset: `lightmapScaleOffset`: UVs are scaled by the first two numbers and offset by the last two, v up.
    """

    lightmap: int
    scale_offset: tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class LightingData:
    """Content of an asset.

    Attributes:
        position: float64 [N, 3], positions of the light probes in Unity's axes.
        values: float64 [N, 9, 3], coefficients of `SphericalHarmonicsL2`.
        rectangles: One for each renderer with a lightmap, in the order of the file, which does not name renderers.
    """

    position: np.ndarray
    values: np.ndarray
    rectangles: tuple[Rectangle, ...]


def read_lighting_data(path: str | os.PathLike[str]) -> LightingData:
    """Reads the light probes and lightmap rectangles of an asset.

    Raises:
        WlmError: UnityPy is missing; or the file is missing, damaged, YAML text, an asset bundle, or has no such data.
    """
    data = read_file(path, _BYTES, "the asset")
    if data.startswith(_TEXT):
        return _read_text(path, data)
    if data.startswith(_BUNDLE):
        raise WlmError(f"{path}: expected an asset of Unity's editor, found an asset bundle")
    need("UnityPy", _EXTRA)
    with damaged(f"{path}: the asset is damaged, or UnityPy cannot read its version", *_DAMAGE):
        kinds, tables = _decoded(run_child(data))
        if not WANTED.keys() & kinds:
            raise WlmError(f"{path}: expected Unity's lighting data or light probes, found neither")
        position, light = (np.concatenate(tables[name]) for name in (POSITIONS, LIGHT))
        if len(position) != len(light):
            raise WlmError(f"{path}: expected light for each of {len(position)} probes, found light for {len(light)}")
        if len(position) > PROBES:
            raise WlmError(f"{path}: expected at most {PROBES:,} light probes, found {len(position):,}")
        rows = np.concatenate(tables[RENDERERS])
        rows = rows[rows[:, 0] < _NO_LIGHTMAP].tolist()
        rectangles = tuple(Rectangle(int(number), (x, y, z, w)) for number, x, y, z, w in rows)
        values = light.reshape(-1, _CHANNELS, _COEFFICIENTS).transpose(0, 2, 1)
    return LightingData(position, values, rectangles)


def _read_text(path: str | os.PathLike[str], data: bytes) -> LightingData:
    objects = unity_text.objects(data)
    texts = [text for kind, text in objects if kind == "LightProbes"]
    if not texts:
        found = ", ".join(sorted({kind for kind, _ in objects})[:4]) or "nothing"
        raise WlmError(
            f"{path}: expected LightProbes in this text asset, found {found} (the light of Adaptive Probe Volumes is "
            "in .bytes files, which wlm does not read: bake a Light Probe Group)"
        )
    with damaged(f"{path}: the asset is damaged", ValueError):
        positions, values = zip(*map(unity_text.probes, texts), strict=True)
    return LightingData(np.concatenate(positions), np.concatenate(values), ())


_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, RecursionError, MemoryError, struct.error)


def run_child(data: bytes) -> bytes:
    """Returns what `unity_child` prints for the content of a file.

    Raises:
        ValueError: UnityPy cannot read the file.
    """
    # With -P, a module beside the program cannot replace a package.
    command = [sys.executable, "-P", unity_child.__file__]
    try:
        run = subprocess.run(command, input=data, capture_output=True, timeout=_SECONDS, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ValueError(str(error)) from error
    if run.returncode:
        lines = run.stderr.decode(errors="replace").strip().splitlines()
        crashed = f"UnityPy crashed, or exceeded its limits of {unity_child.SECONDS} s and {unity_child.MEMORY} bytes"
        raise ValueError(lines[-1] if run.returncode > 0 and lines else crashed)
    return run.stdout


def _decoded(printed: bytes) -> tuple[set[str], dict[str, list[np.ndarray]]]:
    """Returns the types of the objects and the tables of each path, float64 [N, columns], from the child's output."""
    head, _, numbers = printed.partition(b"\n")
    kinds, heads = json.loads(head)
    tables = {POSITIONS: [np.empty((0, 3))], LIGHT: [np.empty((0, 27))], RENDERERS: [np.empty((0, 5))]}
    at = 0
    for path, count, columns in heads:
        tables[path].append(np.frombuffer(numbers, np.float64, count * columns, at).reshape(count, columns))
        at += 8 * count * columns
    return set(kinds), tables
