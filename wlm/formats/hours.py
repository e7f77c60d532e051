"""Hours of the day: in the names of files, folders and arrays, and between stored ones."""

import re
from collections.abc import Sequence

import numpy as np

DAY = 24.0
"""Hours in a day, the period of hours that names state."""

# An hour at the end of a name. A bare number such as `_18` may be that of a frame and is not read as an hour.
_HOUR = re.compile(
    r"(?:^|[_ -])(?P<twelve>[0-9]{1,2})(?:[_.-]?(?P<past>[0-9]{2}))?[_ -]?(?P<half>[ap]m)$"  # 6pm, 6_30pm
    r"|(?:^|[_ -])(?P<clock>[0-9]{1,2})h(?P<minutes>[0-5][0-9])m?$"  # 18h30
    r"|(?:^|[_ ])(?P<whole>[0-9]+)(?P<sign>[_.-])(?P<part>[0-9]+)h$"  # 18_30h, 18.5h
    r"|(?:^|[_ .-])(?P<alone>[0-9]+)h$"  # 18h, 1830h
    r"|_(?P<bare>[0-9]+\.[0-9]+)$",  # 18.5
    re.IGNORECASE,
)
_QUARTERS = {"00", "15", "30", "45"}
_MOST = 26  # times of an alternative that a line lists


def hours_of_names(stems: Sequence[str]) -> tuple[list[float | None], str]:
    """Reads the hour at the end of each name without its suffix: `_18h`, `_18h30`, `_1830h`, `_6pm`, `_18.5` or
    `_18_30h`.

    The two digits of `_18_30h` are minutes if those of all names are 00, 15, 30 or 45; otherwise, and after a point,
    they are decimals. A number before them that is the same in all names is part of the name: `_2_06h`, `_2_18h`.
    Returns the hours, None for a name without one; and a line about names that may be read differently, or "".
    """
    found = [_HOUR.search(stem) for stem in stems]
    pairs = [match for match in found if match and match["part"]]
    parts = {match["part"] for match in pairs}
    two_digits = all(len(part) == 2 and part < "60" for part in parts) and bool(parts - {"00"})
    alike = len(pairs) == len(stems) > 1 and len({match["whole"] for match in pairs}) == 1
    if alike and not parts <= _QUARTERS and max(parts) < "24" and two_digits:
        return [float(match["part"]) for match in pairs], ""
    minutes = two_digits and parts <= _QUARTERS and all(match["sign"] != "." for match in pairs)
    alone = [match["alone"] for match in found if match and match["alone"]]
    clock = all(len(each) == 4 and each < "2400" and each[2:] < "60" for each in alone)
    hours = [_hour(match, minutes, clock) for match in found]
    if not two_digits or None in hours:
        return hours, ""
    other = [f"{hour:g}" for hour in (_hour(match, not minutes, clock) for match in found) if hour is not None]
    example = next(match for match in pairs if match["part"] != "00")
    decimals, clock_time = (f"{example['whole']}{sign}{example['part']}" for sign in (".", ":"))
    read, instead = (clock_time, decimals) if minutes else (decimals, clock_time)
    times = ",".join(other) if len(other) <= _MOST else "..."
    return hours, f"{example.string} is read as {read} h; if it means {instead} h, give --times {times}"


def _hour(match: re.Match[str] | None, minutes: bool, clock: bool) -> float | None:
    """Returns the hour in a name, None if it has none; 18.5 for `18_30h` if `minutes`, for `1830h` if `clock`."""
    if match is None:
        return None
    if match["half"]:
        past = int(match["past"] or 0)
        afternoon = match["half"].lower() == "pm"
        return int(match["twelve"]) % 12 + 12 * afternoon + past / 60 if past < 60 else None
    if match["clock"]:
        return int(match["clock"]) + int(match["minutes"]) / 60
    if match["alone"]:
        text = match["alone"]
        return int(text[:2]) + int(text[2:]) / 60 if clock else float(text)
    if match["bare"]:
        return float(match["bare"])
    return int(match["whole"]) + int(match["part"]) / 60 if minutes else float(f"{match['whole']}.{match['part']}")


def neighbours(times: np.ndarray, period: float | None, t: float) -> tuple[int, int, float]:
    """Returns the indices of the stored times, float64 [T], increasing, before and after a finite time, and the weight
    of the later one, 0 to 1.

    In a day of length `period` the last and the first time are neighbours; None: `t` is within the times.
    """
    count = len(times)
    if count == 1:
        return 0, 0, 0.0
    t = t if period is None else t % period
    after = int(np.searchsorted(times, t, side="right"))
    before = after - 1
    if period is None:
        before, after = max(before, 0), min(after, count - 1)
        gap = times[after] - times[before]
        return before, after, float((t - times[before]) / gap) if gap > 0 else 0.0
    before, after = before % count, after % count
    gap = (times[after] - times[before]) % period or period
    return before, after, float(((t - times[before]) % period) / gap)
