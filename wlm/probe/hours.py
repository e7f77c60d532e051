"""Several hours of one set of probes: read from one file or from a file each, and checked against each other."""

import hashlib
import math
import os
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from wlm.errors import WlmError
from wlm.probe.data import ProbeSet, load

PERIOD = 24.0
"""Hours of a day."""

TIMES = 255
"""Hours that a file holds, at most."""


def load_hours(
    paths: Sequence[str | os.PathLike[str]],
    times: Sequence[float],
    *,
    key: str | None = None,
    convention: str | None = None,
) -> list[ProbeSet]:
    """Reads several hours of probes.

    Args:
        paths: A file for each hour, or one with all of them: its array of 9.5 h is `sh_09.50`.
        times: The hours, in [0, 24), in any order.
        key: Name of the array in a file for each hour, as for `wlm.probe.load`.
        convention: As for `wlm.probe.load`.

    Returns:
        A set for each time, of the same positions.

    Raises:
        WlmError: A file as for `wlm.probe.load`, or times or sets that don't fit each other.
    """
    _check_times(times)
    if len(paths) == 1 and len(times) > 1:
        if key is not None:
            raise WlmError(f"key: expected none with one file of {len(times)} hours, got {key}")
        return check_hours([load(paths[0], key=f"{time:05.2f}", convention=convention) for time in times], times)
    if len(paths) != len(times):
        raise WlmError(f"times: expected one for each of {len(paths)} files, got {len(times)}")
    return check_hours([load(path, key=key, convention=convention) for path in paths], times)


def check_hours(sets: Sequence[ProbeSet], times: Sequence[float]) -> list[ProbeSet]:
    """Checks that sets are hours of one set of probes.

    Returns:
        The sets.

    Raises:
        WlmError: They aren't.
    """
    _check_times(times)
    if len(sets) != len(times):
        raise WlmError(f"times: expected one for each of {len(sets)} sets, got {len(times)}")
    first = sets[0]
    for other, time in zip(sets, times, strict=True):
        if other.outputs != first.outputs:
            raise WlmError(f"{other.name}, {time:g} h: expected {first.outputs} numbers a probe, found {other.outputs}")
        if not np.array_equal(other.position, first.position):
            raise WlmError(f"{other.name}, {time:g} h: expected the positions of {first.name}, in their order")
    return list(sets)


def joint_source(sets: Sequence[ProbeSet], times: Sequence[float]) -> str:
    """Names several hours of one set of probes, in whatever order, as `ProbeSet.source` names one."""
    digest = hashlib.blake2b(digest_size=8)
    for time, source in sorted((float(time), probes.source) for probes, time in zip(sets, times, strict=True)):
        digest.update(f"{time!r} {source}\n".encode())
    return digest.hexdigest()


def _check_times(times: Sequence[float]) -> None:
    if not 1 <= len(times) <= TIMES:
        raise WlmError(f"times: expected 1 to {TIMES} hours, got {len(times)}")
    for time in times:
        if not (math.isfinite(time) and 0.0 <= time < PERIOD):
            raise WlmError(f"times: expected hours of the day, from 0 to below {PERIOD:g}, got {time:g}")
    for a, b in pairwise(sorted(times)):
        if a == b:
            raise WlmError(f"times: expected each hour once, got {a:g} twice")
