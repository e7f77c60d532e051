"""Timing of calls on the CPU or on a CUDA device.

A measured time is that of one call among many calls back to back, after a warm-up that compiles kernels and fills
caches. On CUDA it includes the time to launch kernels if launching takes longer than the kernels run; a call that is
captured in a CUDA graph avoids that.
"""

import contextlib
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError

# One sample lasts at least this long: CUDA events resolve half a microsecond, and an event pair around one
# short kernel measures mostly the pair.
_MIN_SAMPLE_MS = 1.0
_MAX_CALLS_PER_SAMPLE = 1000


@dataclass(frozen=True)
class Timing:
    """Distribution of the time of one call, in milliseconds.

    Attributes:
        median_ms: Median over the samples.
        p10_ms: 10th percentile.
        p90_ms: 90th percentile.
        n: Number of samples; each is the mean of as many calls as fill a millisecond.
    """

    median_ms: float
    p10_ms: float
    p90_ms: float
    n: int


def time_together(
    calls: Mapping[str, Callable[[], object]], device: str = "cpu", warmup: int = 5, repeats: int = 30
) -> dict[str, Timing]:
    """Times several functions in turns, so that a drifting clock or other programs slow all of them alike.

    Each round takes one sample of every function, and each round starts with another function. On CUDA all functions
    run on the stream of `wlm.interop.stream`, on which the timing events are recorded; a function that launches on
    another stream must make the two streams wait for each other.

    Args:
        calls: Functions without arguments, by name; their results are dropped.
        device: "cpu" or "cuda:0".
        warmup: Number of calls of each function before its first timed call, at least 1.
        repeats: Number of samples of each function, at least 1.

    Returns:
        The distribution of the time of one call, by name.

    Raises:
        WlmError: The device is unknown or absent, or a number is below 1.
    """
    if warmup < 1 or repeats < 1:
        raise WlmError(f"timing: expected warmup and repeats of at least 1, got {warmup} and {repeats}")
    with _clock(device) as sample:
        batch = {}
        for name, fn in calls.items():
            sample(fn, warmup)
            batch[name] = _calls_per_sample(sample(fn, 1))
        times: dict[str, list[float]] = {name: [] for name in calls}
        names = list(calls)
        for turn in range(repeats):
            first = turn % max(len(names), 1)
            for name in names[first:] + names[:first]:
                times[name].append(sample(calls[name], batch[name]))
    return {name: _timing(samples) for name, samples in times.items()}


_Sampler = Callable[[Callable[[], object], int], float]


@contextlib.contextmanager
def _clock(device: str) -> Iterator[_Sampler]:
    """Yields a timer: it makes a given number of calls of a function and returns the milliseconds per call."""
    # Imported here so that reading results needs neither torch nor Warp.
    from wlm import interop

    device = interop.check_device(device)
    if device == "cpu":
        yield _sample_cpu
        return
    import torch

    with torch.cuda.device(device), interop.stream(device) as stream:
        start = torch.cuda.Event(enable_timing=True)
        end = torch.cuda.Event(enable_timing=True)

        def sample(fn: Callable[[], object], calls: int) -> float:
            start.record(stream)
            for _ in range(calls):
                fn()
            end.record(stream)
            end.synchronize()
            return start.elapsed_time(end) / calls

        yield sample


def _sample_cpu(fn: Callable[[], object], calls: int) -> float:
    start = time.perf_counter()
    for _ in range(calls):
        fn()
    return (time.perf_counter() - start) * 1e3 / calls


def _calls_per_sample(call_ms: float) -> int:
    if call_ms * _MAX_CALLS_PER_SAMPLE <= _MIN_SAMPLE_MS:
        return _MAX_CALLS_PER_SAMPLE
    return max(1, math.ceil(_MIN_SAMPLE_MS / call_ms))


def _timing(samples: list[float]) -> Timing:
    p10, median, p90 = np.percentile(samples, [10, 50, 90])
    return Timing(float(median), float(p10), float(p90), len(samples))
