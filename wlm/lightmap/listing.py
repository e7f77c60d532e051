"""The files of a lightmap set and their times: from a `set.json`, or from the names in a folder.

No pixels are read here. The layout follows the scene configuration of neural-dynamic-gi, section 10.1.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from wlm.errors import WlmError
from wlm.formats.light import SUFFIXES
from wlm.formats.limits import TIMES
from wlm.formats.reading import named_file
from wlm.lightmap.fields import field, is_list, is_number, is_size, is_text, kind, name_of, period_of, read_set

SET_FILE = "set.json"

# The hour at the end of a file's name: `_18_55h` and `_18.55h` are 18.55, `_18h` is 18. A bare `_18` may as well be
# a frame's number and is not taken for an hour.
_NAME_TIME = re.compile(r"_([0-9]+)(?:[_.]([0-9]+))?h$|_([0-9]+\.[0-9]+)$", re.IGNORECASE)


@dataclass(frozen=True)
class Listing:
    """The files to read, and what the set states about itself.

    Attributes:
        name: The set's name.
        files: The lightmaps, as ordered by the list or by name; of raw lightmaps the first of each.
        times: One for each file, not yet checked.
        mask: "all", "alpha", the path of a PNG, or "coverage": that of the files of `coverage`.
        period: Length of the day in the unit of the times, or None.
        size: Height and width in texels where the set states them, else None.
        stated_by: The file that states the size, or the folder.
        warn_order: Whether times that are out of order deserve a warning.
        mesh: The mesh that the lightmaps belong to, which need not be there, or None.
        raw: For each lightmap the raw files that it is made of, see `wlm.lightmap.contest`; None for pictures.
        coverage: Likewise the raw masks: one, or one for each lightmap.
    """

    name: str
    files: list[Path]
    times: Sequence[float]
    mask: str
    period: float | None
    size: tuple[int, int] | None
    stated_by: Path
    warn_order: bool
    mesh: Path | None = None
    raw: list[list[Path]] | None = None
    coverage: list[list[Path]] | None = None


def list_folder(folder: Path, times: Sequence[float] | None) -> Listing:
    """Lists a folder of lightmaps without a `set.json`, as `wlm.lightmap.load` states.

    Args:
        folder: The folder.
        times: One for each file in natural order of the names; None reads them from the names.

    Returns:
        The listing; "mask.png" of the folder is its mask, else all texels are valid.

    Raises:
        WlmError: There is no lightmap, their number is not that of the times, a name tells no hour, or the
            folder cannot be read.
    """
    try:
        files = [f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and f.is_file()]
    except OSError as error:
        raise WlmError(f"{folder}: cannot read: {error.strerror or error}") from error
    # A hidden name is another program's: macOS writes one beside every file on a foreign disk.
    files = sorted((f for f in files if f.name[0] != "."), key=lambda f: (natural(f.name), f.name))
    if not files:
        raise WlmError(f"{folder}: expected a {SET_FILE} or lightmaps ({', '.join(SUFFIXES)}), found neither")
    # Names need not sort by their hours ("_5.5h" before "_5.45h"): only times that the caller gave have an order.
    warn_order = times is not None
    if times is None:
        times = [time_of_name(f.stem) for f in files]
        if None in times:
            raise WlmError(
                f"{folder}: {count_of(files, 'lightmap')} and no {SET_FILE}: give {count_of(files, 'time')} with "
                f"--times ({files[times.index(None)].name} does not end in an hour such as _18_55h)"
            )
    check_count(folder, files, times)
    mask = folder / "mask.png"
    return Listing(
        folder.resolve().name, files, times, str(mask) if mask.is_file() else "all", None, None, folder, warn_order
    )


def natural(name: str) -> list[str | int]:
    """Sort key with digits split from text: "2" before "10"."""
    return [int(part) if i % 2 else part.lower() for i, part in enumerate(re.split(r"([0-9]+)", name))]


def time_of_name(stem: str) -> float | None:
    """Returns the hour that a file's name ends in, or None."""
    match = _NAME_TIME.search(stem)
    if not match:
        return None
    whole, decimals, bare = match.groups()
    return float(bare or f"{whole}.{decimals or 0}")


def count_of(items: Sequence[object], noun: str) -> str:
    """Counts items in words: "1 time", "2 times"."""
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"


def check_count(where: Path, files: Sequence[object], times: Sequence[float], noun: str = "lightmap") -> None:
    """Checks that there is a time for each lightmap, or state.

    Raises:
        WlmError: There are more or fewer.
    """
    if len(times) != len(files):
        raise WlmError(f"{where}: {count_of(times, 'time')} for {count_of(files, noun)}; expected one each")


def parse_set(path: Path, times: Sequence[float] | None, trust: bool = False) -> Listing:
    """Reads and checks a `set.json`, as `wlm.lightmap.load` states.

    Args:
        path: The file.
        times: One for each lightmap, in place of those of the file; None takes those of the file.
        trust: Whether its files, its mask and its mesh may lie outside its folder.

    Returns:
        The listing, with paths relative to the file resolved.

    Raises:
        WlmError: The file cannot be read, is not JSON, a field is missing or of a wrong kind, a file lies outside the
            folder, or there are too many; the message names the file and the field.
    """
    content = read_set(path)
    if "layers" in content:
        raise WlmError(f"{path}: expected a set of one lightmap a time, found one with layers")
    width = field(path, content, "width", "", is_size, "a whole number of texels above 0")
    height = field(path, content, "height", "", is_size, "a whole number of texels above 0")
    entries = field(path, content, "lightmaps", "", is_list, "a list of lightmaps")
    name, period = name_of(path, content), period_of(path, content)
    mask = "all"
    if content.get("mask") is not None:
        mask = field(path, content, "mask", "", is_text, 'the name of a PNG, "alpha" or "all"')
        if mask not in ("all", "alpha"):
            mask = str(named_file(path, mask, f"{path}: mask", trust))

    mesh = None
    if content.get("mesh") is not None:
        mesh = named_file(path, field(path, content, "mesh", "", is_text, "the name of a mesh"), f"{path}: mesh", trust)

    if len(entries) > TIMES:
        raise WlmError(f"{path}: lightmaps: expected at most {TIMES:,}, got {len(entries):,}")
    files, stamps, found = [], [], {}
    for i, entry in enumerate(entries):
        place = f"lightmaps[{i}]"
        if not isinstance(entry, dict):
            raise WlmError(f"{path}: {place}: expected an object (time_hours, file), got {kind(entry)}")
        file = field(path, entry, "file", f"{place}.", is_text, "the name of a lightmap")
        if file not in found:  # links are followed once
            found[file] = named_file(path, file, f"{path}: {place}.file", trust)
        files.append(found[file])
        if times is None:
            stamps.append(float(field(path, entry, "time_hours", f"{place}.", is_number, "a finite number")))
    if times is not None:
        check_count(path, files, times)
        stamps = times
    return Listing(name, files, stamps, mask, period, (height, width), path, True, mesh)
