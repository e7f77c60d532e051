"""What the parts of the smoke benchmark share: sizes, the clock, rows with figures by name."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from wlm.bench.runner import Row
from wlm.bench.timing import Timing, time_together

__all__ = ["FULL", "QUICK", "Bench", "Sizes", "number", "percent", "row"]


@dataclass(frozen=True)
class Sizes:
    """Grids, steps and repeats.

    Attributes:
        lattice, small: Cells along an edge of the large and the small lattice.
        chunk: Steps of a lattice that are timed as one.
        compared: Steps after which 16 bits are compared with 32.
        drift: Steps after which the mass is.
        fills: Shares of the domain in which there is smoke.
        coarse: Cells of velocity along an edge, each of four of smoke.
        cloud: Voxels along an edge of what is marched through.
        resolution: Pixels along an edge of the image.
        exact: The step in voxels of the march that guiding maps are compared with.
        guide_shared, guide_alone: Steps of the guiding map, with marches to the lights shared or each pixel's own.
        six: Steps of the six-way march; the shortest is last.
        plume: Pixels along an edge of the image of the plume.
        scale: Cells of the scene, as a multiple of its own.
        frames: Of the scene before the one that is timed.
        warmup, repeats: Calls before the first that is timed, and samples.
        few: Samples of what takes long.
        every: Whether with cases that take as long to compile as they tell little.
    """

    lattice: int
    small: int
    chunk: int
    compared: tuple[int, ...]
    drift: int
    fills: tuple[float, ...]
    coarse: int
    cloud: int
    resolution: int
    exact: float
    guide_shared: tuple[float, ...]
    guide_alone: tuple[float, ...]
    six: tuple[float, ...]
    plume: int
    scale: float
    frames: int
    warmup: int
    repeats: int
    few: int
    every: bool


FULL = Sizes(
    lattice=256,
    small=100,
    chunk=48,
    compared=(500, 1000),
    drift=5000,
    fills=(0.0, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0),
    coarse=100,
    cloud=400,
    resolution=512,
    exact=0.5,
    guide_shared=(2, 3, 5, 10, 15, 20),
    guide_alone=(1, 2, 3, 5, 10, 15, 20),
    six=(20.0, 15.0, 10.0, 7.0, 5.0, 3.0, 2.0, 1.0, 0.5, 0.25),
    plume=64,
    scale=1.0,
    frames=40,
    warmup=3,
    repeats=12,
    few=3,
    every=True,
)
"""The paper's grids: for a GPU."""

QUICK = Sizes(
    lattice=48,
    small=24,
    chunk=8,
    compared=(100, 200),
    drift=300,
    fills=(0.0, 0.25, 1.0),
    coarse=12,
    cloud=48,
    resolution=48,
    exact=0.5,
    guide_shared=(2, 3, 5, 10, 15, 20),
    guide_alone=(2, 5, 10, 20),
    six=(1.0, 0.5, 0.25),
    plume=24,
    scale=0.12,
    frames=12,
    warmup=1,
    repeats=5,
    few=1,
    every=False,
)
"""For a CPU."""


class Bench:
    """A device, sizes, and where progress is said."""

    def __init__(self, device: str, sizes: Sizes, progress: Callable[[str], None] | None = None) -> None:
        self.device, self.sizes = device, sizes
        self.note = progress or (lambda line: None)
        self.bandwidth = math.nan
        """Bytes a second that a copy reads and writes, once it is measured."""

    def time(self, calls: Mapping[str, Callable[[], object]], *, few: bool = False) -> dict[str, Timing]:
        """Times peers in turns."""
        sizes = self.sizes
        warmup, repeats = (1, sizes.few) if few else (sizes.warmup, sizes.repeats)
        return time_together(calls, self.device, warmup, repeats)

    def of_copy(self, bytes_moved: float, ms: float) -> str:
        """The share of a copy's bandwidth that so many bytes in so many milliseconds are."""
        return percent(bytes_moved / (1e-3 * ms) / self.bandwidth)


def row(
    scene: str,
    method: str,
    option: str,
    figures: Mapping[str, str] | None = None,
    note: str = "",
    *,
    timing: Timing | None = None,
    calls: int = 1,
    system: str = "smoke",
    **values,
) -> Row:
    """A row of the smoke system, or of another whose methods have tables of their own.

    Args:
        scene: What was simulated or looked at.
        method: The table that it belongs to.
        option: What tells it apart there.
        figures: Columns that no other system has, by their titles: a part "title: figure" of the notes each.
        note: What else a reader must know.
        timing: Of a call.
        calls: Of what a row is about, such as steps, in what was timed.
        system: "smoke" or "smoke-network".
        values: Other fields of the row.
    """
    notes = [*(f"{title}: {figure}" for title, figure in (figures or {}).items()), *([note] if note else [])]
    made = Row(system, scene, method, option, notes="; ".join(notes), **values)
    if timing is None:
        return made
    made = made.with_timing(timing)
    # One sample has no spread.
    spread = made.decode_ms_spread / calls if timing.n > 1 else None
    return replace(made, decode_ms=made.decode_ms / calls, decode_ms_spread=spread)


def percent(share: float) -> str:
    """A share as three figures of per cent."""
    return f"{100.0 * share:.3g}%"


def number(value: float) -> str:
    """Three figures of a number, and all before its point."""
    return f"{value:,.0f}" if value >= 100.0 else f"{value:.3g}"
