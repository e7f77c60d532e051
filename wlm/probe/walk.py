"""A walk through a scene with a cascaded lighting volume: cost, coverage and error of each frame."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.light import Light, at_probes
from wlm.probe.volume import FrameStats, Volume
from wlm.system import Meter, OnProgress

EYE_SHARE = 1.6 / 128  # height of the eyes over the longest side of the probes' box: 1.6 m in a village of 128 m
STEP = 0.1  # sides of the finest block that a viewer goes in a frame: with blocks of 2 m at 60 Hz, 43 km/h

_LOOP = 0.35  # half axes of the loop over the box's sides: it stays inside, and passes near the rim
_GROUND = 16  # probes that tell the height of the ground
_TURNS = 1024  # frames without room after which what waits is given up
_MOST_FRAMES = 100_000


@dataclass(frozen=True)
class FrameFigures:
    """One frame of a walk.

    Attributes:
        viewpoint: x, y, z.
        stats: Of the update.
        read_seconds: Reading the samples, with the copies to the device and back.
        samples: Live probes near the viewer at which the volume was read.
        coverage: Share of them that some level answers; NaN where there are none, as the next five.
        by_level: Share of them by the level that answers most of it, from the finest.
        rmse: Root mean square over samples and channels of what was read minus the light that the volume was made
            from; what nothing covers counts as 0, since it would be drawn black.
        rms: Root mean square of that light, to compare with.
        original_rmse: Of what was read minus the original.
        light_rmse: Of the light that the volume was made from minus the original, at the same samples.
        far: Live probes farther away at which it was read.
        far_rmse: Of what was read there minus the original; NaN where there are none.
    """

    viewpoint: tuple[float, float, float]
    stats: FrameStats
    read_seconds: float
    samples: int
    coverage: float
    by_level: tuple[float, ...]
    rmse: float
    rms: float
    original_rmse: float
    light_rmse: float
    far: int
    far_rmse: float


def walk(
    volume: Volume,
    path: np.ndarray,
    samples: int = 256,
    radius: float | None = None,
    original: np.ndarray | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> list[FrameFigures]:
    """Moves a volume along a path, one update a frame, and reads it at probes near the viewer and far away.

    The samples lie where the probes do, on surfaces for most sets, where a renderer reads; with their normals, where
    the volume has these.

    Args:
        volume: In any state; it goes on from there.
        path: [F, 3], viewpoints, in the unit of the probes' positions.
        samples: Most probes to read in a frame near the viewer, and as many farther away, drawn at random.
        radius: Half the side of the cube round the viewer that is near; None: that of the finest window.
        original: [N, D], what the light of all probes should be; None: the light that the volume is made from.
        seed: Of the draw, which is the same in every frame at one place.
        progress: Called about twice a second, with the frames done.

    Returns:
        One entry a frame.

    Raises:
        WlmError: A viewpoint isn't finite, or too far out.
        ValueError: A wrong shape, no sample or no radius.
    """
    path = np.asarray(path, np.float64)
    if path.ndim != 2 or path.shape[1] != 3:
        raise ValueError(f"path: expected [F, 3], got {path.shape}")
    if radius is None:
        radius = volume.sizes[0] * volume.side / 2
    if samples < 1 or not radius > 0.0:
        raise ValueError(f"samples, radius: expected at least 1 and above 0, got {samples} and {radius}")
    position = volume.position[volume.numbers]
    normal = None if volume.normal is None else volume.normal[volume.numbers]
    light = at_probes(volume.light, volume.numbers).astype(np.float64)
    if original is None:
        truth = light
    else:
        original = np.asarray(original)
        if original.shape != (len(volume.position), volume.channels):
            expected = [len(volume.position), volume.channels]
            raise ValueError(f"original: expected {expected}, got {list(original.shape)}")
        truth = original[volume.numbers].astype(np.float64)
    figures = []
    meter = Meter(progress, "walk", len(path))
    for frame, viewpoint in enumerate(path):
        stats = volume.update(viewpoint)
        inside = (np.abs(position - viewpoint) < radius).all(1)
        random = np.random.default_rng(seed)
        near, far = (_draw(np.flatnonzero(part), samples, random) for part in (inside, ~inside))
        start = time.perf_counter()
        reading = volume.read(position[near], None if normal is None else normal[near])
        seconds = time.perf_counter() - start
        levels = range(len(volume.sizes))
        figures.append(
            FrameFigures(
                viewpoint=tuple(viewpoint.tolist()),
                stats=stats,
                read_seconds=seconds,
                samples=len(near),
                coverage=_mean(reading.level >= 0),
                by_level=tuple(_mean(reading.level == level) for level in levels),
                rmse=_rms(reading.values - light[near]),
                rms=_rms(light[near]),
                original_rmse=_rms(reading.values - truth[near]),
                light_rmse=_rms(light[near] - truth[near]),
                far=len(far),
                far_rmse=_rms(volume.read(position[far], None if normal is None else normal[far]).values - truth[far]),
            )
        )
        if meter.due(frame + 1):
            meter.report(frame + 1)
    return figures


def settle(volume: Volume, viewpoint: np.ndarray) -> int:
    """Updates a volume at one place until nothing waits, or what waits finds no room.

    Args:
        volume: In any state.
        viewpoint: [3].

    Returns:
        The frames that it took.
    """
    frames, idle = 1, 0
    left = volume.update(viewpoint).left
    # Groups of the pool's rows take turns: one frame without room says nothing of the next.
    while left and idle < _TURNS:
        stats = volume.update(viewpoint)
        left, frames = stats.left, frames + 1
        idle = 0 if stats.updated else idle + 1
    return frames


def score_volume(
    probes: ProbeSet, light: Light, *, frames: int | None = None, up: int = 1, progress: OnProgress | None = None
) -> dict[str, object]:
    """Walks round a scene with a volume that starts empty, and scores what is read against the probes as they were.

    Args:
        probes: As they were.
        light: Of all of them: theirs, or as a model has them.
        frames: Of the loop; None: a tenth of a block each.
        up: The axis that points up.
        progress: As for `walk`.

    Returns:
        The `summary`, and `block`, the side of the finest blocks; `first_ms` and `first_frames`, what the first frame
        takes and how many pass until nothing waits; `memory_bytes`.
    """
    volume = Volume(probes.position, light, live=probes.live, normal=probes.normal)
    lit = probes.position[probes.live]
    path = camera_path(lit, frames or loop_frames(lit, STEP * volume.sizes[0], up), up=up)
    first = volume.update(path[0])
    count = 1 + (settle(volume, path[0]) if first.left else 0)
    peak = float(probes.values.max()) - float(probes.values.min())
    figures = summary(walk(volume, path, original=probes.values, progress=progress), peak)
    return figures | {
        "block": volume.sizes[0],
        "first_ms": 1e3 * first.seconds,
        "first_frames": count,
        "memory_bytes": volume.memory_bytes,
    }


def _draw(numbers: np.ndarray, most: int, random: np.random.Generator) -> np.ndarray:
    return random.choice(numbers, most, replace=False) if len(numbers) > most else numbers


def _mean(flags: np.ndarray) -> float:
    return float(flags.mean()) if len(flags) else math.nan


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).mean())) if values.size else math.nan


def summary(figures: Sequence[FrameFigures], peak: float | None = None) -> dict[str, object]:
    """Statistics of a walk, in numbers, lists and None alone.

    Args:
        figures: From `walk`, at least one frame.
        peak: Range of the original's coefficients, as `wlm.probe.evaluation.score` takes it; None: no PSNR.

    Returns:
        - `frames`, their number; `settled`, share of the frames that left nothing waiting; `from_cache`, share
          of the blocks written that came from the cache, None if none was written.
        - `mean`, `p95` and `max` over the frames of the counts of `FrameStats` by their names, of `update_ms` and of
          `read_ms`.
        - Over the frames that have samples, None where no frame has: the same of `rmse` and `rms`; `mean`,
          `p5` and `min` of `coverage`; mean shares `by_level`.
        - Where a peak is given, in dB over all frames' samples alike: `psnr` of what was read near the viewer against
          the original, `light_psnr` of the light that the volume was made from, at the same samples, and `far_psnr`
          of what was read farther away; None where there are no samples.

    Raises:
        ValueError: There is no frame.
    """
    if not figures:
        raise ValueError("summary: expected at least one frame")
    stats = [figure.stats for figure in figures]
    counts = ("entered", "queued", "dropped", "updated", "cached", "left", "probes")
    result: dict[str, object] = {"frames": len(figures)}
    result["settled"] = float(np.mean([s.left == 0 for s in stats]))
    cached, updated = sum(s.cached for s in stats), sum(s.updated for s in stats)
    result["from_cache"] = cached / (cached + updated) if cached + updated else None
    for name in counts:
        result[name] = _statistics([getattr(s, name) for s in stats])
    result["update_ms"] = _statistics([1e3 * s.seconds for s in stats])
    result["read_ms"] = _statistics([1e3 * figure.read_seconds for figure in figures])
    sampled = [figure for figure in figures if figure.samples]
    result["coverage"] = _statistics([figure.coverage for figure in sampled], more_is_worse=False)
    result["by_level"] = np.mean([figure.by_level for figure in sampled], 0).tolist() if sampled else None
    result["rmse"] = _statistics([figure.rmse for figure in sampled])
    result["rms"] = _statistics([figure.rms for figure in sampled])
    if peak is not None:
        for name, error, count in (
            ("psnr", "original_rmse", "samples"),
            ("light_psnr", "light_rmse", "samples"),
            ("far_psnr", "far_rmse", "far"),
        ):
            result[name] = _pooled(figures, error, count, peak)
    return result


def _pooled(figures: Sequence[FrameFigures], error: str, count: str, peak: float) -> float | None:
    """PSNR over the samples of all frames, of which each has its root mean square error and their number."""
    counts = np.array([getattr(figure, count) for figure in figures])
    if not counts.any():
        return None
    squares = np.array([getattr(figure, error) for figure in figures])[counts > 0] ** 2
    return psnr_from_mse(float(np.average(squares, weights=counts[counts > 0])), peak)


def _statistics(values: Sequence[float] | np.ndarray, more_is_worse: bool = True) -> dict[str, float] | None:
    """Mean, the percentile that only 5% of the values exceed in the bad direction, and the worst value."""
    if len(values) == 0:
        return None
    mean = {"mean": float(np.mean(values))}
    if more_is_worse:
        return mean | {"p95": float(np.percentile(values, 95)), "max": float(np.max(values))}
    return mean | {"p5": float(np.percentile(values, 5)), "min": float(np.min(values))}


def loop_frames(position: np.ndarray, step: float, up: int = 1) -> int:
    """Frames in which `camera_path` goes round at so much a frame, at most 100,000.

    Args:
        position: [N, 3], of the live probes.
        step: In the unit of the positions.
        up: As for `camera_path`.
    """
    sides = np.delete(np.ptp(np.asarray(position, np.float64), axis=0), up)
    # An ellipse's, to a thousandth where it is no longer than thrice its width.
    a, b = _LOOP * sides
    around = math.pi * (3 * (a + b) - math.sqrt((3 * a + b) * (a + 3 * b)))
    return int(np.clip(math.ceil(around / step), 1, _MOST_FRAMES))


def camera_path(position: np.ndarray, frames: int, eye_height: float | None = None, up: int = 1) -> np.ndarray:
    """A closed loop through a scene: an ellipse in the probes' box that follows the ground at eye height.

    The ground at a point is the median height of the 16 probes nearest to it in plan, averaged over an eighth of the
    loop, since a viewer doesn't jump on to a roof.

    Args:
        position: [N, 3], of the live probes.
        frames: F.
        eye_height: Above the ground, in the unit of the positions; None: an 80th of the longest side of their box.
        up: The axis that points up, 0 to 2.

    Returns:
        float64 [F, 3]; after the last frame comes the first.

    Raises:
        WlmError: There is no probe, or no frame.
        ValueError: Another shape, or another axis.
    """
    position = np.asarray(position, np.float64)
    if position.ndim != 2 or position.shape[1] != 3 or up not in (0, 1, 2):
        raise ValueError(f"camera path: expected positions [N, 3] and an axis of 0 to 2, got {position.shape} and {up}")
    if len(position) == 0:
        raise WlmError("camera path: expected at least one live probe, got none")
    if frames < 1:
        raise WlmError(f"camera path: expected at least 1 frame, got {frames}")
    if eye_height is None:
        eye_height = EYE_SHARE * float(np.ptp(position, axis=0).max())
    plan = [axis for axis in range(3) if axis != up]
    low, high = position.min(0)[plan], position.max(0)[plan]
    angle = 2.0 * np.pi * np.arange(frames) / frames
    around = (low + high) / 2 + _LOOP * (high - low) * np.stack([np.cos(angle), np.sin(angle)], 1)
    nearest = cKDTree(position[:, plan]).query(around, np.arange(1, min(_GROUND, len(position)) + 1))[1]
    ground = np.median(position[nearest, up], 1)
    width = max(frames // 8, 1)
    # The loop's own end stands before its start.
    summed = np.cumsum(np.concatenate([[0.0], ground, ground[: width - 1]]))
    smooth = np.roll((summed[width:] - summed[:-width]) / width, (width - 1) // 2)
    path = np.empty((frames, 3))
    path[:, plan] = around
    path[:, up] = smooth + eye_height
    return path
