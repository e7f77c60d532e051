"""Reads probes from tables of numbers (`.csv`, `.tsv`): a probe a line, with or without a line of names."""

import re
import warnings
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import JSON_BYTES, NUMBERS, PROBES
from wlm.formats.reading import damaged, open_file

_AXIS = re.compile(r"(?:p|pos|position|world|worldposition)?([xyz])")
_NUMBERED = re.compile(r"[a-z]*?(red|green|blue|[rgb])?(\d{1,4})(red|green|blue|[rgb])?")
_LONGEST_LINE = 1 << 20  # characters


def plain(name: str) -> str:
    """Returns a name in lower case without the prefix m_ and without any signs."""
    return re.sub(r"[^0-9a-z]", "", name.lower().removeprefix("m_"))


def axes_of(names: list[str]) -> list[str]:
    """Returns the names that are coordinates, x, y and z; none if one is missing."""
    found = {match[1]: name for name in reversed(names) if (match := _AXIS.fullmatch(plain(name)))}
    return [found[axis] for axis in "xyz"] if len(found) == 3 else []


def light_columns(names: list[str]) -> tuple[list[str], bool]:
    """Finds names with consecutive numbers (`sh0`, `sh[ 1]`), or with these for each colour channel (`shr0`, `c0_g`).

    Returns:
        The names in order, and whether they go channel by channel; no names if they do not form a full set.
    """
    found = {}
    for name in names:
        if match := _NUMBERED.fullmatch(plain(name)):
            found[(match[1] or match[3] or "")[:1], int(match[2])] = name
    numbers = {channel: sorted(number for each, number in found if each == channel) for channel, _ in found}
    count = range(min(each[0] for each in numbers.values()), 1 + max(map(max, numbers.values()))) if numbers else []
    if set(numbers) not in ({""}, set("rgb")) or any(each != list(count) for each in numbers.values()):
        return [], False
    return [found[channel, number] for channel in sorted(numbers, reverse=True) for number in count], "r" in numbers


def read_table(path: Path) -> tuple[np.ndarray, np.ndarray, str]:
    """Reads a table. Without a line of names, a line has the position, then the numbers.

    Returns:
        Positions, float64 [N, 3]; values, float64 [N, D], or [N, 3, C] if the names state the channels; and a remark
        on columns that are ignored, "" for none.

    Raises:
        WlmError: The file is missing, too large, not a table of numbers, or its columns are unknown.
    """
    with damaged(f"{path}: not a table of numbers", ValueError, MemoryError), open_file(path, "the probes") as file:
        if (size := file.seek(0, 2)) > JSON_BYTES:
            raise WlmError(f"{path}: expected at most {JSON_BYTES} bytes")
        file.seek(0)
        first, skipped = b"", 0
        while not first and (line := file.readline(_LONGEST_LINE)):
            first, skipped = line.partition(b"#")[0].strip(b" \t\r\n\xef\xbb\xbf"), skipped + 1
        text = first.decode("utf-8", "replace")
        mark = next((mark for mark in ";\t," if mark in text), None)
        cells = [cell.strip().strip('"') for cell in text.split(mark)]
        names = [] if all(map(_is_number, cells)) else cells
        if len(cells) > NUMBERS + 3:
            raise WlmError(f"{path}: expected at most {NUMBERS + 3} columns, found {len(cells)}")
        place = axes_of(names)
        light, by_channel = light_columns([name for name in names if name not in place])
        if names and (not (place and light) or len(set(names)) < len(names)):
            listed = ", ".join(names[:12])
            raise WlmError(f"{path}: expected columns x, y, z and sh0, sh1 ... or r0, g0, b0 ..., found {listed}")
        if not names and len(cells) < 4:
            raise WlmError(f"{path}: expected columns of a position and of light, found {len(cells)} columns")
        file.seek(0)
        # NumPy allocates as many rows as are allowed; a number and a mark take two bytes.
        most, skip = min(PROBES, size // (2 * len(cells))) + 1, skipped * bool(names)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of a table without lines
            rows = np.loadtxt(file, delimiter=mark, skiprows=skip, ndmin=2, max_rows=most, encoding="utf-8-sig")
    if names and rows.size and rows.shape[1] != len(names):
        raise WlmError(f"{path}: expected {len(names)} columns, as many as names, found {rows.shape[1]}")
    if not names:
        return rows[:, :3], rows[:, 3:], ""
    if not rows.size:
        raise WlmError(f"{path}: expected at least one probe, found none")
    column = {name: i for i, name in enumerate(names)}
    values = rows[:, [column[name] for name in light]]
    others = ", ".join(name for name in names if name not in place and name not in light)
    values = values.reshape(len(rows), 3, -1) if by_channel else values
    return rows[:, [column[name] for name in place]], values, f"without the columns {others}" if others else ""


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True
