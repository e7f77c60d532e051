"""Speed of light probes (`python -m benchmarks probe --speed`): a fit, a decode of all probes, and a volume's frames.

Each set has these rows of the method "speed":

- "fit": the time of `wlm.probe.fit.compress`, the median of some fits, with the error of the last one. The memory is
  the most that Warp and torch had in use on the device since the process started. Kernels are compiled beforehand.
- "decode": all live probes in one launch, replayed as a CUDA graph.
- "volume, lossless" and "volume, ours": frames of a viewer who walks on a loop through the scene and is at first where
  all blocks are filled. The light comes from the original probes or from the model, whose regions, if it has some, are
  read from its file as the viewer comes near. Nothing but the update is done in a frame.

`--many N` measures a set of N random positions in a flat box, with smooth light that varies about as much as that of
scenes: a million of them are fitted in 64 regions.
"""

import statistics
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
import warp as wp

from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.fit import compress
from wlm.probe.model import ProbeModel, Profile
from wlm.probe.morton import morton_order
from wlm.probe.relative import relative_errors
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import camera_path, loop_frames, settle
from wlm.system import load

_FITS = 3  # of a set that takes seconds
_FEW = 50_000  # most live probes of such a set
_WARM = 30  # steps of the fit that compiles kernels
_STEP = 0.1  # sides of the finest block that the viewer moves per frame
_FRAMES = 3000  # most frames of a walk
_BOX = np.array([200.0, 16.0, 200.0])  # of a million positions; a set of N has the same density
_WAVES = 6


def many_probes(count: int) -> ProbeSet:
    """Returns a set of random positions along a Z-curve with smooth light, 27 numbers each; the same one for the same
    count."""
    random = np.random.default_rng(1)
    place = random.uniform(0, 1, (count, 3))
    position = place[morton_order(place)] * _BOX * np.cbrt(count / 1e6)
    waves = np.random.default_rng(0)
    values = np.zeros((count, 27), np.float32)
    values[:, :3] = 1.0
    size = np.where(np.arange(27) < 3, 0.12, 0.1).astype(np.float32)
    for _ in range(_WAVES):
        k, phase = waves.normal(size=(3, 27)) * 0.25, waves.uniform(0, 6.28, 27)
        values += size * np.sin((position @ k + phase).astype(np.float32))
    return from_arrays(position, values, name=f"{count:,} random probes")


def speed_rows(
    sets: Sequence[ProbeSet],
    profile: Profile,
    *,
    device: str,
    frames: int | None = None,
    progress: Note | None = None,
    done: Callable[[Sequence[Row]], None] | None = None,
) -> list[Row]:
    """Measures the speed of fits, decodes and volumes; see the module.

    Args:
        sets: The sets of probes.
        profile: Settings of the fits, which are by Gaussians.
        device: "cpu" or "cuda:0".
        frames: Most frames of a walk; None: 3,000.
        progress: Called with a line before each part of the work.
        done: Called with all rows so far after each row.
    """
    rows: list[Row] = []
    for probes in sets:
        key = probes.key.removeprefix("sh").removeprefix("_")
        bench = Bench("probe", device, progress, scene=f"{probes.name} {key}".strip())
        for row in _rows(bench, probes, profile.model_copy(update={"method": "gaussians"}), frames or _FRAMES):
            rows.append(row)
            if done is not None:
                done(rows)
    return rows


def _rows(bench: Bench, probes: ProbeSet, profile: Profile, frames: int) -> Iterator[Row]:
    position, values = probes.position[probes.live], probes.values[probes.live]
    every = -(-len(position) // profile.region)
    few = from_arrays(position[::every], values[::every])
    compress(few, profile.model_copy(update={"steps": min(_WARM, profile.steps)}), device=bench.device)
    bench.note(f"fitting {len(position):,} probes, {profile.steps:,} steps")
    times = []
    for _ in range(_FITS if len(position) <= _FEW else 1):
        start = time.perf_counter()
        model = compress(probes, profile, device=bench.device)
        times.append(time.perf_counter() - start)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "probes.wlm"
        size = model.save(path)
        model = load(path, ProbeModel.SYSTEM)
        decoder = model.decoder(bench.device)
        points = decoder.points(position)
        decoder.run(points)
        decoded = points.values()
        error = relative_errors(decoded, values)
        yield bench.row(
            "speed",
            "fit",
            f"profile {profile.name}, regions: {model.content.facts().get('regions', 1)}",
            encode_seconds=statistics.median(times),
            steps=profile.steps,
            probes=len(position),
            gaussians=model.content.count,
            bytes=model.content.nbytes,
            disk_bytes=size,
            memory=_most_memory(bench.device),
            psnr=psnr_from_mse(float(np.square(decoded - values, dtype=np.float64).mean()), float(np.ptp(values))),
            relative_error=float(np.sqrt(np.square(error).mean())),
        )
        bench.note("decoding all probes")
        row = bench.row("speed", "decode", f"all live probes, {bench.mode}", probes=len(position))
        timing = bench.time({"decode": bench.replay(lambda: decoder.run(points))})["decode"]
        yield row.with_timing(timing).with_figures(point_rate=len(position) / timing.median_ms / 1e6)
        for name in ("lossless", "ours"):
            bench.note(f"walking through the volume: {name}")
            yield _volume_row(bench, probes, None if name == "lossless" else model, name, frames)


def _volume_row(bench: Bench, probes: ProbeSet, model: ProbeModel | None, name: str, frames: int) -> Row:
    if model is None:
        light = StoredLight(probes.values, bench.device)
    else:
        light = model.decoder(bench.device).light(probes.position)
    start = time.perf_counter()
    volume = Volume(probes.position, light, live=probes.live, normal=probes.normal)
    built = time.perf_counter() - start
    lit = probes.position[probes.live]
    loop = loop_frames(lit, _STEP * volume.sizes[0])
    path = camera_path(lit, loop)[:frames]
    settle(volume, path[0])
    walked = [volume.update(viewpoint) for viewpoint in path]
    took = 1e3 * np.array([each.seconds for each in walked])
    return bench.row(
        "speed",
        f"volume, {name}",
        f"{len(path):,} frames of a walk; the finest blocks are {volume.sizes[0]:.3g} units wide",
        encode_seconds=built,
        frames=len(path),
        memory=volume.memory_bytes / 2**20,
        update_ms=float(took.mean()),
        update_ms_p95=float(np.percentile(took, 95)),
        update_ms_max=float(took.max()),
        blocks=float(np.mean([each.updated for each in walked])),
        blocks_waiting=float(np.mean([each.left for each in walked])),
    )


def _most_memory(device: str) -> float | None:
    """Returns the most MiB that Warp and torch had in use on a CUDA device; None on the CPU."""
    if device == "cpu":
        return None
    return (wp.get_mempool_used_mem_high(device) + torch.cuda.max_memory_allocated(device)) / 2**20
