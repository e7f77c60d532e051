"""How near kernels come to what the device can do (`python -m benchmarks kernels`).

The rows of the method "ceiling" are rates of the device, measured in the same run (`benchmarks.ceilings`). Every other
row is one case of `benchmarks.kernel_cases` at one size. "floor" is the time in which the device could do the work that
the case cannot avoid, by the ceiling that takes longest, which the notes name; "of the floor" is floor over time.
"launches" counts the kernels of a call, as a profiler sees them on CUDA. "slope" is the exponent of the time over the
size between this size and the next smaller one: 1 where the time is proportional, near 0 where latency or launches
decide.

`--baseline OLD.json` ends with an error if a case's share of its floor fell by more than a twentieth and by more than
the scatter of the samples of both runs. Shares and not times are compared, since a ceiling of the same run also follows
the clock and the load of the machine. `--plot PICTURE.png` draws time against size with the floors.
"""

import math
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import torch

from benchmarks.ceilings import Ceiling, measure_ceilings
from benchmarks.kernel_cases import CASES, Case, Work
from benchmarks.rows import Row, read_runs
from benchmarks.runner import Bench, Note, check_only
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path

_LEAST = 0.05  # loss of a share of the floor that counts as slower, of the share
_MOST = 0.5  # a larger loss is never taken for scatter


def run(
    *,
    quick: bool = False,
    device: str,
    only: Sequence[str] | None = None,
    baseline_path: str | os.PathLike[str] | None = None,
    plot_path: str | os.PathLike[str] | None = None,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Measures the cases; see the module.

    Args:
        quick: Whether to measure two small sizes of each case.
        device: "cpu" or "cuda:0".
        only: Names of cases; None: all.
        baseline_path: Result file of an older run on such a device.
        plot_path: Picture to write.
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each row.

    Raises:
        WlmError: A case or the device does not exist, or a case is slower than in the older run.
    """
    check_only(only or (), list(CASES))
    bench = Bench("kernels", device, progress, scene="cuda" if device != "cpu" else "cpu", clock="time_ms")
    older = None if baseline_path is None else _shares(baseline_path, bench.scene)
    ceilings = measure_ceilings(bench)
    rows = [_ceiling_row(bench, ceiling) for ceiling in ceilings.values()]
    for name in only or CASES:
        case = CASES[name]
        previous: Row | None = None
        for size in case.quick if quick else case.sizes:
            previous = _case_row(bench, name, case, size, ceilings, previous)
            rows.append(previous)
            if done is not None:
                done(rows)
    if plot_path is not None:
        draw(rows, Path(plot_path))
    if older is not None:
        _expect_no_slower(rows, older)
    return rows


def _ceiling_row(bench: Bench, ceiling: Ceiling) -> Row:
    return bench.row("ceiling", ceiling.kind, time_ms=ceiling.ms, rate=1e-9 * ceiling.rate)


def _case_row(
    bench: Bench, name: str, case: Case, size: int, ceilings: dict[str, Ceiling], previous: Row | None
) -> Row:
    bench.note(f"{name}, {size:,} {case.unit}")
    call, work = case.make(bench.device, size)
    calls = case.calls
    replayed = bench.replay(call) if case.replayed else call
    timing = bench.time({name: replayed})[name]
    ms = timing.median_ms / calls
    floors = {kind: 1e3 * amount / ceilings[kind].rate for kind, amount in work.amounts().items() if amount}
    bound = max(floors, key=lambda kind: floors[kind])
    slope = None
    if previous is not None:
        slope = math.log(ms / previous["time_ms"]) / math.log(size / previous["size"])
    return bench.row(
        name,
        f"{size:,} {case.unit}",
        f"floor by {bound}",
        timing=timing,
        calls=calls,
        size=size,
        moved_bytes=work.bytes,
        operations=work.fma + work.tensor,
        launches=_launches(replayed, calls) if bench.device != "cpu" else None,
        floor_ms=floors[bound],
        of_floor=floors[bound] / ms,
        slope=slope,
    )


def _launches(call: Callable[[], object], calls: int) -> float:
    """Counts the kernels and copies that a call runs on the device, per repetition."""
    from torch.profiler import ProfilerActivity, profile

    torch.cuda.synchronize()
    with profile(activities=[ProfilerActivity.CUDA]) as found:
        call()
        torch.cuda.synchronize()
    return sum(1 for event in found.events() if event.device_type == torch.autograd.DeviceType.CUDA) / calls


def _shares(path: str | os.PathLike[str], scene: str) -> dict[tuple[str, str], Row]:
    rows = [row for run in read_runs(path) for row in run.rows if row.system == "kernels" and row.scene == scene]
    if not rows:
        raise WlmError(f"{path}: expected rows of the system kernels on {scene}, found none")
    return {(row.method, row.option): row for row in rows if row.get("of_floor") is not None}


def _expect_no_slower(rows: Sequence[Row], older: dict[tuple[str, str], Row]) -> None:
    slower = []
    for row in rows:
        old = older.get((row.method, row.option))
        if old is None or row.get("of_floor") is None:
            continue
        noise = sum((each.get("time_ms_spread") or 0.0) / each["time_ms"] for each in (row, old)) / 2
        if row["of_floor"] < old["of_floor"] * (1.0 - min(max(_LEAST, noise), _MOST)):
            slower.append(f"{row.method}, {row.option} ({old['of_floor']:.1%} to {row['of_floor']:.1%})")
    if slower:
        raise WlmError(f"slower than the baseline, by the share of the floor: {'; '.join(slower)}")


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draws time over size of each case, with its floor, and writes the picture."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, NullFormatter

    cases = list(dict.fromkeys(row.method for row in rows if row.get("of_floor") is not None))
    columns = min(4, max(len(cases), 1))
    figure = Figure(figsize=(3.4 * columns, 2.7 * -(-len(cases) // columns)), dpi=130, layout="constrained")
    FigureCanvasAgg(figure)
    for number, name in enumerate(cases):
        axes = figure.add_subplot(-(-len(cases) // columns), columns, number + 1)
        found = [row for row in rows if row.method == name]
        sizes = [row["size"] for row in found]
        axes.loglog(sizes, [row["time_ms"] for row in found], "o-", color="#0072B2", label="time")
        axes.loglog(sizes, [row["floor_ms"] for row in found], "--", color="#D55E00", label="floor")
        axes.set_title(name, fontsize=10)
        axes.set_xlabel(CASES[name].unit if name in CASES else "size", fontsize=9)
        axes.set_ylabel("ms", fontsize=9)
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0) if _narrow(axis.get_view_interval()) else (1.0,)))
            axis.set_major_formatter(lambda value, _: f"{value:g}" if value < 1e4 else f"{value:.0e}".replace("+0", ""))
            axis.set_minor_formatter(NullFormatter())
        axes.tick_params(labelsize=9)
        axes.grid(True, color="#e4e4e4", linewidth=0.7)
        if number == 0:
            axes.legend(fontsize=9)
    with atomic_path(path) as part:
        figure.savefig(part, format="png")


def _narrow(limits: Sequence[float]) -> bool:
    """Says whether an axis has too few powers of ten for its labels."""
    return limits[1] < 100.0 * limits[0]


__all__ = ["CASES", "Work", "draw", "run"]
