"""Light at any time of the day, from that of several hours."""

import math

import numpy as np

from wlm.errors import WlmError
from wlm.formats.hours import DAY, neighbours


def hour_factors(name: str, times: np.ndarray, time: float | None) -> np.ndarray | None:
    """Returns the factors of the light of T hours whose sum is the light at any time, float64 [T].

    Args:
        name: Name of the probes, for messages.
        times: float64 [T], hours of the day; empty for light of one unnamed hour, for which the result is None.
        time: The time; the day begins again after 24 hours.

    Raises:
        WlmError: There are several hours and no time is given, or the time is not finite.
    """
    if time is not None:
        check_time(time)
    if not len(times):
        return None
    if time is None:
        raise WlmError(f"{name}: expected --time, one of the day, for light of the hours {listed_times(times)}")
    before, after, share = neighbours(times, DAY, time)
    factors = np.zeros(len(times))
    factors[before] += 1.0 - share
    factors[after] += share
    return factors


def check_time(time: float) -> None:
    """Raises a `WlmError` for a time that is not finite."""
    if not math.isfinite(time):
        raise WlmError(f"time: expected a finite number, got {time}")


def listed_times(times: np.ndarray) -> str:
    """Returns hours as text."""
    return ", ".join(f"{time:g}" for time in times)
