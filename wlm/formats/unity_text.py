"""Reading of light probes from Unity's assets in text form, a regular kind of YAML.

Unity and other tools write `LightProbes` as text, with a value in each line. The patterns below are the lines that are
read; no YAML is parsed, so that a file costs no more than its length.
"""

import re

import numpy as np

_OBJECT = re.compile(rb"^--- !u!\d+ &-?\d+[^\n]*\r?\n(\w+):", re.MULTILINE)
_POSITIONS, _LIGHT = b"m_Positions", b"m_BakedCoefficients"
_NUMBER = rb"([-+.\w]{1,32})"
_VECTOR = re.compile(rb"\{x: " + _NUMBER + rb",\s+y: " + _NUMBER + rb",\s+z: " + _NUMBER + rb"\}")
_COEFFICIENT = re.compile(rb"^[ -]+sh\[ ?(\d{1,2})\]: " + _NUMBER + rb"\r?$", re.MULTILINE)
_NUMBERS = 27  # of a probe: nine for each colour channel


def objects(data: bytes) -> list[tuple[str, bytes]]:
    """Returns the type and the text of each object of an asset."""
    starts = list(_OBJECT.finditer(data))
    ends = [*(start.start() for start in starts), len(data)][1:]
    return [(start[1].decode(), data[start.end() : end]) for start, end in zip(starts, ends, strict=True)]


def probes(text: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Reads the positions, float64 [N, 3], and the coefficients, float64 [N, 9, 3], of a `LightProbes` object.

    Raises:
        ValueError: The lines are damaged or incomplete.
    """
    places = (float(number) for match in _VECTOR.finditer(_member(text, _POSITIONS)) for number in match.groups())
    position, light = np.fromiter(places, np.float64).reshape(-1, 3), _member(text, _LIGHT)
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
