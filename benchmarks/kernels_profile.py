"""Profiles of kernels and what they wait for (`python -m benchmarks kernels-profile`; needs CUDA and Nsight Compute).

Nsight Compute (`ncu`) counts for each kernel of a case of `benchmarks.kernel_cases`, at its largest size: how busy the
memory, the L2 cache and the issue of instructions are, as shares of their peaks, how many of the possible warps are
active, the registers of a thread, and what a warp waits for. A row has the means over all launches of a kernel in one
call, weighted by time; the note is the reason that follows from them. The `KERNELS` slowest kernels of a case have a
row. Times are those under the profiler, and serve only as weights. Each metric is one counter: a "throughput" of many
counters takes many replays of the kernel, and before each of them all memory that it writes is restored.
"""

import csv
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence

import torch

from benchmarks.kernel_cases import CASES
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, check_only
from wlm.errors import WlmError

KERNELS = 3  # rows of a case
_LAUNCHES = 60  # most launches of a case that are profiled
_SECONDS = 60.0  # most time of a case
_TIME = "gpu__time_duration.sum"
_STALLS = {
    "long_scoreboard": "global memory",
    "short_scoreboard": "shared memory or special functions",
    "math_pipe_throttle": "arithmetic units",
    "mio_throttle": "the queue of shared memory",
    "lg_throttle": "the queue of global memory",
    "tex_throttle": "the queue of textures",
    "barrier": "other warps at a barrier",
    "membar": "a memory barrier",
    "wait": "results of arithmetic",
    "branch_resolving": "branches",
    "no_instruction": "code",
    "imc_miss": "constants",
    "drain": "stores at its end",
}
_FIGURES = {
    "memory_busy": "dram__bytes.sum.pct_of_peak_sustained_elapsed",
    "l2_busy": "lts__t_sectors.sum.pct_of_peak_sustained_elapsed",
    "l1_busy": "l1tex__data_pipe_lsu_wavefronts.sum.pct_of_peak_sustained_elapsed",
    "issue_busy": "smsp__issue_active.avg.pct_of_peak_sustained_active",
    "warps_active": "sm__warps_active.avg.pct_of_peak_sustained_active",
}
_REGISTERS = "launch__registers_per_thread"
_BUSY = 0.6  # a unit that is busier than this decides the time


def run(
    *,
    device: str,
    only: Sequence[str] | None = None,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Profiles the cases; see the module.

    Args:
        device: "cuda:0".
        only: Names of cases; None: all.
        progress: Called with a line before each case.
        done: Called with all rows so far after each case.

    Raises:
        WlmError: A case does not exist, the device is a CPU, or `ncu` is missing.
    """
    check_only(only or (), list(CASES))
    if device == "cpu":
        raise WlmError("--device: expected cuda, since Nsight Compute profiles GPUs, got cpu")
    ncu = shutil.which("ncu", path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/local/cuda/bin"]))
    if ncu is None:
        raise WlmError("ncu: not found; install Nsight Compute, and put it on the PATH")
    bench = Bench("kernels-profile", device, progress, scene="cuda, profile", clock="time_ms")
    rows: list[Row] = []
    for name in only or CASES:
        bench.note(name)
        try:
            rows += summarise(bench.row, name, _profiled(ncu, name, device))
        except WlmError as error:
            rows.append(bench.missing_row(name, "", error))
        if done is not None:
            done(rows)
    return rows


def summarise(make: Callable[..., Row], case: str, launches: Iterable[Mapping[str, str]]) -> list[Row]:
    """Makes the rows of a case from the launches that `ncu` lists, by the names of its columns."""
    kernels = defaultdict(list)
    for launch in launches:
        kernels[_short(launch["Kernel Name"])].append(launch)
    times = {kernel: sum(_number(each[_TIME]) for each in found) for kernel, found in kernels.items()}
    rows = []
    for kernel in sorted(times, key=lambda each: -times[each])[:KERNELS]:
        found, time = kernels[kernel], times[kernel]

        def mean(column: str, found: list = found, time: float = time) -> float:
            return sum(_number(each.get(column, "")) * _number(each[_TIME]) for each in found) / max(time, 1e-9)

        figures = {name: mean(column) / 100.0 for name, column in _FIGURES.items()}
        stalls = {words: mean(_column(name)) for name, words in _STALLS.items()}
        share = time / max(sum(times.values()), 1e-9)
        registers = max(_number(each[_REGISTERS]) for each in found)
        counts = {"launches": len(found), "registers": registers, "share_of_time": share}
        rows.append(make(case, kernel, _reason(figures, stalls, registers), **figures, **counts))
    return rows


def _reason(figures: Mapping[str, float], stalls: Mapping[str, float], registers: float) -> str:
    """Says what decides the time of a kernel."""
    units = {
        "memory_busy": "memory",
        "l2_busy": "the L2 cache",
        "l1_busy": "the L1 cache, shared memory and textures",
        "issue_busy": "the issue of instructions",
    }
    busiest = max(units, key=lambda name: figures[name])
    first, second = sorted(stalls, key=lambda words: -stalls[words])[:2]
    waits = f"warps wait for {first}, then for {second}"
    if figures[busiest] >= _BUSY:
        return f"bound by {units[busiest]}; {waits}"
    if figures["warps_active"] < 0.3:
        return f"bound by latency with few warps active ({registers:.0f} registers, or too little work); {waits}"
    return f"bound by latency; {waits}"


def _profiled(ncu: str, name: str, device: str) -> list[dict[str, str]]:
    """Runs a case in a process of its own under the profiler, and returns its launches."""
    metrics = [_TIME, _REGISTERS, *_FIGURES.values(), *map(_column, _STALLS)]
    command = [ncu, "--clock-control", "none", "--cache-control", "none", "--profile-from-start", "off"]
    command += ["--launch-count", str(_LAUNCHES)]
    command += ["--metrics", ",".join(metrics), "--csv", "--page", "raw", "--print-units", "base"]
    command += [sys.executable, "-m", "benchmarks.kernels_profile", name, device]
    try:
        ended = subprocess.run(command, check=False, capture_output=True, text=True, timeout=_SECONDS)
    except subprocess.TimeoutExpired as error:
        raise WlmError(f"ncu: {name}: did not end within {_SECONDS:.0f} s") from error
    lines = [line for line in ended.stdout.splitlines() if line.startswith('"')]
    if ended.returncode or len(lines) < 3:
        last = (ended.stderr or ended.stdout).strip().splitlines()[-1:]
        raise WlmError(f"ncu: {name}: no profile: {' '.join(last)}")
    # The line after the names has the units.
    return list(csv.DictReader([lines[0], *lines[2:]]))


def _column(stall: str) -> str:
    return f"smsp__average_warps_issue_stalled_{stall}_per_issue_active.ratio"


def _number(text: str) -> float:
    """Returns a number of `ncu`, which writes commas between thousands and nothing where it has no value."""
    try:
        return float(text.replace(",", ""))
    except ValueError:
        return 0.0


def _short(kernel: str) -> str:
    """Returns a kernel's name without the hash that Warp adds, and without arguments and templates."""
    name = kernel.partition("(")[0].partition("<")[0].split("::")[-1].removeprefix("void ")
    if "_cuda_kernel" not in name:
        return name
    return name.partition("_cuda_kernel")[0].rpartition("_")[0].split("__locals__")[-1].strip("_")


def _main(name: str, device: str) -> None:
    case = CASES[name]
    call, _ = case.make(device, case.sizes[-1])
    call()
    torch.cuda.synchronize()
    torch.cuda.cudart().cudaProfilerStart()
    call()
    torch.cuda.synchronize()
    torch.cuda.cudart().cudaProfilerStop()


if __name__ == "__main__":
    _main(*sys.argv[1:])
