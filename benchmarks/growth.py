"""Growth by simulation: a city of lightmaps on 1, 8 and 64 GPUs (`python -m benchmarks growth`).

The costs of one lightmap are measured: reading its frames, and preparing and storing its tiles, on one core of this
machine in this run; the fit on a GPU is a row of a committed result file. A simulated scheduler then hands the
lightmaps to the GPUs one by one. A lightmap passes four stages: its frames are read from a storage that all GPUs
share, its tiles are prepared on the cores that belong to the GPU, they are fitted, and the file is written. Each stage
serves one lightmap at a time, and a GPU's cores prepare the next lightmap while it fits. A GPU fails at random; its
lightmap is then done again from the start.

Assumptions: frames are stored in half floats without compression, the storage moves `STORAGE` bytes a second, a GPU has
`CORES` cores, which share the preparation evenly, and fails once in `HOURS_TO_FAIL` hours. The row of a number of GPUs
has the hours, the share of the time in which storage, cores and GPUs are busy, and how many lightmaps were repeated.
Writes are too small to delay reads, and are only counted.
"""

import heapq
import itertools
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.rivals.lightmap_torch import dynamic_targets
from benchmarks.rows import Row, read_runs
from benchmarks.runner import Bench, Note
from wlm.errors import WlmError
from wlm.formats.exr import read_exr, write_exr
from wlm.lightmap.data import from_arrays
from wlm.lightmap.profile import Profile
from wlm.lightmap.tiles import TILE

GPUS = (1, 8, 64)
LIGHTMAPS, SIDE, TIMES = 10_000, 1024, 26
STORAGE, CORES, HOURS_TO_FAIL = 2e9, 16, 200.0
_FIT = ("livingroom", "M 20,000 steps", 64)  # scene, option and tiles of the row of a fit
_FILE = Path(__file__).with_name("nvidia-h200.json")
_RESTART = 120.0  # seconds until a failed GPU works again


@dataclass(frozen=True)
class Costs:
    """The costs of one lightmap: bytes read and written, seconds of one core, and seconds of a GPU."""

    read: float
    written: float
    core_seconds: float
    gpu_seconds: float


@dataclass(frozen=True)
class Outcome:
    """Seconds of the whole job, the shares of them in which each kind of resource is busy, and repeated lightmaps."""

    seconds: float
    storage: float
    cores: float
    gpus: float
    repeated: int


def simulate(costs: Costs, gpus: int, lightmaps: int = LIGHTMAPS, seed: int = 0) -> Outcome:
    """Simulates the job; see the module.

    Args:
        costs: The costs of a lightmap.
        gpus: Number of GPUs.
        lightmaps: Number of lightmaps.
        seed: Seed of the failures.
    """
    random = np.random.default_rng(seed)
    reading, writing = costs.read / STORAGE, costs.written / STORAGE
    preparing = costs.core_seconds / CORES
    waiting = lightmaps
    storage_free, busy_storage, busy_cores, busy_gpus, repeated, end = 0.0, 0.0, 0.0, 0.0, 0, 0.0
    cores_free, gpu_free = [0.0] * gpus, [0.0] * gpus
    fails_at = random.exponential(3600.0 * HOURS_TO_FAIL, gpus)
    number = itertools.count()
    # Times at which a GPU asks for a lightmap; the second request is that of the lightmap that is prepared meanwhile.
    requests = [(0.0, next(number), gpu) for gpu in range(gpus) for _ in range(2)]
    while requests and waiting:
        now, _, gpu = heapq.heappop(requests)
        waiting -= 1
        storage_free = max(storage_free, now) + reading
        prepared = max(storage_free, cores_free[gpu]) + preparing
        cores_free[gpu] = prepared
        begin = max(prepared, gpu_free[gpu])
        done = begin + costs.gpu_seconds
        busy_storage, busy_cores = busy_storage + reading, busy_cores + preparing
        if fails_at[gpu] < done:
            failed = max(fails_at[gpu], begin)
            busy_gpus += failed - begin
            gpu_free[gpu] = failed + _RESTART
            fails_at[gpu] = gpu_free[gpu] + random.exponential(3600.0 * HOURS_TO_FAIL)
            repeated, waiting = repeated + 1, waiting + 1
            heapq.heappush(requests, (gpu_free[gpu], next(number), gpu))
            continue
        busy_gpus += costs.gpu_seconds
        busy_storage += writing
        gpu_free[gpu] = done
        end = max(end, done + writing)
        heapq.heappush(requests, (done, next(number), gpu))
    return Outcome(end, busy_storage / end, busy_cores / (end * gpus), busy_gpus / (end * gpus), repeated)


def measure_costs(bench: Bench, side: int, times: int) -> Costs:
    """Measures the costs of a lightmap of side x side texels on this machine, and takes the fit from a result file."""
    scene, option, tiles = _FIT
    rows = [row for run in read_runs(_FILE) for row in run.rows]
    rows = [
        row for row in rows if (row.system, row.scene, row.method, row.option) == ("lightmap", scene, "fit", option)
    ]
    if not rows:
        raise WlmError(f"{_FILE}: expected a row of the fit {option} of {scene}, found none")
    model = [row for run in read_runs(_FILE) for row in run.rows if row.scene == scene and row.option == "M"]
    random = np.random.default_rng(0)
    light = random.random((times, side, side, 3), np.float32)
    bench.note("reading frames")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "frame.exr"
        write_exr(path, light[0])
        size = path.stat().st_size
        start = time.perf_counter()
        read_exr(path)
        core = times * (time.perf_counter() - start)
    bench.note("preparing tiles")
    day = from_arrays(light, np.linspace(0.0, 24.0, times, endpoint=False), period=24.0)
    profile = Profile.load("M").for_times(times)
    start = time.perf_counter()
    dynamic_targets(day.light, profile)
    core += time.perf_counter() - start
    scale = SIDE**2 / side**2 * TIMES / times
    bytes_of_tile = model[0]["bytes"] / tiles
    return Costs(
        scale * times * size,
        bytes_of_tile * (SIDE // TILE) ** 2,
        scale * core,
        rows[0]["encode_seconds"] * (SIDE // TILE) ** 2 / tiles,
    )


def run(*, quick: bool = False, device: str, progress: Note | None = None) -> list[Row]:
    """Simulates a city of 10,000 lightmaps of 1024 x 1024 texels at 26 hours, and a tenth of it with `quick`.

    Args:
        quick: Whether to measure the costs on a small lightmap, and to simulate 1,000 lightmaps.
        device: "cpu"; the fit is not measured here.
        progress: Called with a line before each part of the work.

    Raises:
        WlmError: The result file has no fit.
    """
    bench = Bench("growth", device, progress, scene="city of lightmaps")
    costs = measure_costs(bench, *((2 * TILE, 4) if quick else (SIDE, TIMES)))
    count = LIGHTMAPS // 10 if quick else LIGHTMAPS
    notes = f"of {count:,}, {SIDE} x {SIDE} texels, {TIMES} hours; its fit is that of an H200"
    rows = [
        bench.row(
            "a lightmap",
            "M",
            notes,
            read_bytes=costs.read,
            bytes=costs.written,
            core_seconds=costs.core_seconds,
            fit_seconds=costs.gpu_seconds,
        )
    ]
    for gpus in GPUS:
        outcome = simulate(costs, gpus, count)
        shares = {"storage": outcome.storage, "cores": outcome.cores, "GPUs": outcome.gpus}
        rows.append(
            bench.row(
                "simulated",
                f"{gpus} GPU{'s' * (gpus > 1)}",
                f"{max(shares, key=lambda name: shares[name])} saturate first",
                hours=outcome.seconds / 3600.0,
                storage_busy=outcome.storage,
                cores_busy=outcome.cores,
                gpus_busy=outcome.gpus,
                repeated=outcome.repeated,
            )
        )
    return rows
