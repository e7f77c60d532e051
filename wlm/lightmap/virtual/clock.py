"""The times of a virtual texture's frames: which stored times are decoded, and which switch of a lamp is coming.

A switch is an interval between stored times that is at most a quarter as long as half of the intervals: the light just
before and just after a lamp is switched. Within it, the light before is shown; at its end, the light after. Pages of
the light after are decoded ahead, within the last 24th of the period before that time.
"""

from __future__ import annotations

import numpy as np

from wlm.lightmap.profile import TimeAxis
from wlm_kernels.lightmap import pages

_SWITCH = 0.25  # length of a switch in medians of all intervals
_LEAD = 1 / 24  # of the period, or of the time between the first and the last stored time


class Clock:
    """Converts times to rows of `wlm_kernels.lightmap.virtual.Work.clock`, and follows the clock through switches.
    `axis` is the time axis of the model; `switches` are the indices of the stored times before each switch."""

    def __init__(self, axis: TimeAxis) -> None:
        """Finds the switches among the stored times."""
        self.axis = axis
        times, period = axis.times, axis.period
        ends = times[1:] if period is None else np.append(times[1:], times[0] + period)
        gaps = ends - times[: len(ends)]
        short = gaps <= _SWITCH * np.median(gaps) if len(gaps) > 1 else np.zeros(len(gaps), bool)
        self.switches = np.flatnonzero(short).tolist()
        self._lead = _LEAD * (float(times[-1] - times[0]) if period is None else period)
        self._coming: int | None = None
        self._last = float(times[0])
        self._stored = [self._read(float(time)) for time in times]

    def row(self, time: float) -> np.ndarray:
        """Returns the row of a clock for a time, float32 [CLOCK], see `wlm_kernels.lightmap.pages`."""
        row = np.zeros(pages.CLOCK, np.float32)
        before, after, share = self.axis.neighbours(time)
        row[pages.BEFORE], row[pages.AFTER], row[pages.SHARE] = before, after, share
        if self.axis.interpolation == "network":
            reads = [(self._read(time), 1.0)]
        else:
            reads = [(self._stored[before], 1.0 - share), (self._stored[after], share)]
        for r, ((numbers, encoding), weight) in enumerate(reads):
            row[pages.WEIGHT + r] = weight
            row[[pages.TAU + r, pages.FIRST + r, pages.SECOND + r, pages.MIX + r]] = numbers
            row[pages.ENCODING + 4 * r : pages.ENCODING + 4 * r + 4] = encoding
        return row

    def _read(self, time: float) -> tuple[list[float], np.ndarray]:
        return [self.axis.place(time), *self.axis.neighbours(time)], self.axis.encode(time)

    def frame(self, time: float) -> tuple[np.ndarray, tuple[int, int, int, int]]:
        """Moves the clock to a time.

        Returns:
            The rows of the frame's time and of the time after the coming switch, float32 [2, CLOCK]; and whether pages
            for a switch are now shown, are not needed any more, and are to be decoded, and whether light may be decoded
            for a later time, since the clock runs forward and light is interpolated (0 or 1 each).

        Raises:
            WlmError: The time is not finite.
        """
        time = self.axis.wrap(time)
        adopt = self._coming is not None and self._passed(self._coming, time)
        coming = self._next(time)
        drop = self._coming is not None and not adopt and coming != self._coming
        moved = self._forward(self._last, time)
        self._coming, self._last = coming, time
        before, _, share = self.axis.neighbours(time)
        held = before in self.switches
        forward = 0.0 < moved <= self._lead and not held and self.axis.interpolation == "radiance"
        now = self.row(float(self.axis.times[before]) if share > 0.0 and held else time)
        after = now if coming is None else self.row(self._end(coming))
        return np.stack([now, after]), (int(adopt), int(drop), int(coming is not None), int(forward))

    def _end(self, switch: int) -> float:
        return float(self.axis.times[(switch + 1) % len(self.axis.times)])

    def _forward(self, start: float, end: float) -> float:
        """Returns the time from `start` to `end`; with a period at least 0."""
        return end - start if self.axis.period is None else (end - start) % self.axis.period

    def _passed(self, switch: int, time: float) -> bool:
        """Whether the clock has moved forward over the end of a switch."""
        moved = self._forward(self._last, time)
        backward = self.axis.period is not None and moved > self.axis.period / 2
        return not backward and 0.0 < self._forward(self._last, self._end(switch)) <= moved

    def _next(self, time: float) -> int | None:
        """Returns the next switch that ends within the lead, or None."""
        coming = [(self._forward(time, self._end(switch)), switch) for switch in self.switches]
        return min(((d, switch) for d, switch in coming if 0.0 < d <= self._lead), default=(0.0, None))[1]
