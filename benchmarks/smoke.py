"""The smoke system against copies, exact solutions and finer marches: speed and error, in one run.

The methods, each a table of its own:

- "lattice": a copy of an array, and steps of the lattice Boltzmann solver of each storage, operator and kind of
  boundary; their share of the copy's bandwidth is that of the bytes which a step has to move. "moving sphere" also
  marks the sphere's cells and finds its links anew at each step.
- "lattice storage": velocities of 16 bits against 32 in a jet, over the inlet's speed, and the share by which the mass
  drifts.
- "advection": a step of smoke in eddies, dense, with and without a sphere; and the error of a smooth ball after a whole
  turn: the RMS over the ball's own, the largest difference (its peak is 1), and the smoke that was gained.
- "advection bricks": the same step where only a cube in a corner has smoke.
- "guide": guiding maps against a march in steps of half a voxel with no jitter and no cutoff. PSNR is of the light, its
  greatest value the peak.
- "six ways": the fine march, with its own estimate of its error by halving its step.
- "weights": six lightmaps weighted for twelve lights against a march to each.
- "frame": the stages of a frame of the scene `jet-sphere`, but for the network that turns the guide into lightmaps,
  which `smoke_network` measures; the march that it replaces is beside it.

A largest error has the unit of what is compared: cells a step, light, or density. Times are of the calls that a user
makes; on CUDA the lattice replays graphs by itself where it does many steps, and steps of advection are replayed as
graphs, so that gaps between launches do not count.
"""

from collections.abc import Callable, Sequence

from benchmarks.plot import Panel
from benchmarks.rows import Row
from benchmarks.runner import Note
from benchmarks.smoke_air import advection_rows, lattice_rows, smoke_brick_rows, storage_rows
from benchmarks.smoke_light import frame_rows, guide_rows, six_rows, weight_rows
from benchmarks.smoke_setup import FULL, QUICK, Sizes, SmokeBench

PANELS = (Panel("time_ms", "psnr", ("guide",)), Panel("time_ms", "max_error", ("guide", "six ways")))
"""What a plot shows: PSNR and error of guiding maps and of the fine march against their time."""

# The lattice comes first: it measures the copy that others are compared with.
_PARTS: tuple[Callable[[SmokeBench], list[Row]], ...] = (
    lattice_rows,
    storage_rows,
    advection_rows,
    smoke_brick_rows,
    guide_rows,
    six_rows,
    weight_rows,
    frame_rows,
)


def run(*, quick: bool, device: str, progress: Note | None = None) -> list[Row]:
    """Measures the smoke system.

    Args:
        quick: Small grids, for a minute on a CPU. Otherwise the paper's, for a GPU with 40 GB: hours on a CPU.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        The rows, method by method.

    Raises:
        WlmError: The device isn't there, or hasn't the memory.
    """
    return run_rows(QUICK if quick else FULL, device=device, progress=progress)


def run_rows(sizes: Sizes, *, device: str, progress: Note | None = None) -> list[Row]:
    """Measures it on grids of the given sizes; the rest as for `run`."""
    bench = SmokeBench(device, sizes, progress)
    return [row for part in _PARTS for row in part(bench)]


def plotted(rows: Sequence[Row]) -> list[Row]:
    """The rows that a plot shows."""
    methods = {method for panel in PANELS for method in panel.methods}
    return [row for row in rows if row.method in methods]
