"""Walking through a scene with a cascaded lighting volume: cost, coverage and error of each frame."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.volume.cascade import FrameStats, Volume
from wlm.probe.volume.light import Light, at_probes
from wlm.system import Meter, OnProgress

EYE_SHARE = 1.6 / 128
"""Default eye height over the longest side of the probes' box: 1.6 m in a village of 128 m."""

STEP = 0.1
"""Default step of a viewer per frame, in sides of the finest block: with blocks of 2 m at 60 Hz, 43 km/h."""

_LOOP = 0.35  # half axes of the loop over the sides of the box: the loop stays inside, near the border
_GROUND = 16  # probes whose median height is that of the ground
_TURNS = 1024  # frames without a free row after which waiting blocks are abandoned
_MOST_FRAMES = 100_000


@dataclass(frozen=True)
class FrameFigures:
    """One frame of a walk.

    Attributes:
        viewpoint: x, y, z.
        stats: Statistics of the update.
        read_seconds: Duration of reading the samples, including the copies to the device and back.
        samples: Number of live probes near the viewer at which the volume was read.
        coverage: Share of the samples that some level answers. This and the next five are NaN without samples.
        by_level: Share of the samples by the level that contributes most, from the finest.
        rmse: RMS over samples and channels of the difference between the reading and the light that fills the volume;
            uncovered points count as 0, since they would be drawn black.
        rms: RMS of that light, for comparison.
        original_rmse: RMS difference between the reading and the original light.
        light_rmse: RMS difference between the light that fills the volume and the original, at the same samples.
        far: Number of live probes farther away at which the volume was read.
        far_rmse: RMS difference between that reading and the original; NaN without such probes.
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
    """Moves a volume along a path, one update per frame, and reads it at probes near the viewer and far away.

    The samples are at the probes, which are on surfaces in most sets, as a renderer's are. They have the probes'
    normals if the volume has them.

    Args:
        volume: A volume in any state; the walk continues from there.
        path: [F, 3], viewpoints, in the unit of the probes' positions.
        samples: Most probes to read per frame near the viewer, and farther away, drawn at random.
        radius: Half the side of the cube around the viewer that is near; None: that of the finest window.
        original: [N, D], original light of all probes; None: the light that fills the volume.
        seed: Seed of the draw, which is the same in every frame at one viewpoint.
        progress: Called about twice a second, with the number of finished frames.

    Returns:
        One entry per frame.

    Raises:
        WlmError: A viewpoint is not finite, or too far away.
        ValueError: A shape is different, or there is no sample or no radius.
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
    """Updates a volume at one viewpoint until no block waits, or waiting blocks find no free row.

    Args:
        volume: A volume in any state.
        viewpoint: [3].

    Returns:
        The number of frames that it took.
    """
    frames, idle = 1, 0
    left = volume.update(viewpoint).left
    # Groups of the pool's rows take turns: the next frame may have a free row even if this one has none.
    while left and idle < _TURNS:
        stats = volume.update(viewpoint)
        left, frames = stats.left, frames + 1
        idle = 0 if stats.updated else idle + 1
    return frames


def score_volume(
    probes: ProbeSet, light: Light, *, frames: int | None = None, up: int = 1, progress: OnProgress | None = None
) -> dict[str, object]:
    """Walks around a scene with a volume that starts empty, and scores the readings against the original probes.

    Args:
        probes: The original probes.
        light: Light of all of them, original or decoded.
        frames: Frames of the loop; None: each frame moves the viewer by a tenth of a block.
        up: Index of the axis that points up.
        progress: As for `walk`.

    Returns:
        The `summary`, with `block`, the side of the finest blocks; `first_ms`, the duration of the first frame;
        `first_frames`, the frames until no block waits; and `memory_bytes`.
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
    """Computes statistics of a walk as JSON values.

    Args:
        figures: Result of `walk`, at least one frame.
        peak: Range of the original's coefficients, as in `wlm.probe.evaluation.score`; None: no PSNR is computed.

    Returns:
        - `frames`, their number; `settled`, share of the frames after which no block waited; `from_cache`, share of the
          new blocks that came from the cache, None if there was no new block.
        - `mean`, `p95` and `max` over the frames of each count of `FrameStats`, of `update_ms` and of `read_ms`.
        - Over the frames that have samples, None if no frame has: the same of `rmse` and `rms`; `mean`, `p5` and `min`
          of `coverage`; mean shares `by_level`.
        - With a peak, in dB over all frames' samples: `psnr` of the readings near the viewer against the original,
          `light_psnr` of the light that fills the volume at the same samples, and `far_psnr` of the readings farther
          away; None without samples.

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
    """Returns the PSNR over the samples of all frames, from each frame's RMS error and number of samples."""
    counts = np.array([getattr(figure, count) for figure in figures])
    if not counts.any():
        return None
    squares = np.array([getattr(figure, error) for figure in figures])[counts > 0] ** 2
    return psnr_from_mse(float(np.average(squares, weights=counts[counts > 0])), peak)


def _statistics(values: Sequence[float] | np.ndarray, more_is_worse: bool = True) -> dict[str, float] | None:
    """Returns the mean, the percentile beyond which the worst 5% of the values are, and the worst value."""
    if len(values) == 0:
        return None
    mean = {"mean": float(np.mean(values))}
    if more_is_worse:
        return mean | {"p95": float(np.percentile(values, 95)), "max": float(np.max(values))}
    return mean | {"p5": float(np.percentile(values, 5)), "min": float(np.min(values))}


def loop_frames(position: np.ndarray, step: float, up: int = 1) -> int:
    """Returns the number of frames in which `camera_path` closes with a given step, at most 100,000.

    Args:
        position: [N, 3], of the live probes.
        step: Distance per frame, in the unit of the positions.
        up: As for `camera_path`.
    """
    sides = np.delete(np.ptp(np.asarray(position, np.float64), axis=0), up)
    # Ramanujan's circumference of an ellipse, within 0.1% up to an aspect ratio of 3.
    a, b = _LOOP * sides
    around = math.pi * (3 * (a + b) - math.sqrt((3 * a + b) * (a + 3 * b)))
    return int(np.clip(math.ceil(around / step), 1, _MOST_FRAMES))


def camera_path(position: np.ndarray, frames: int, eye_height: float | None = None, up: int = 1) -> np.ndarray:
    """Returns a closed loop through a scene: an ellipse in the probes' box that follows the ground at eye height.

    The ground at a point is the median height of the 16 probes nearest to it in plan, averaged over an eighth of the
    loop, so that the viewer does not jump onto a roof.

    Args:
        position: [N, 3], of the live probes.
        frames: F.
        eye_height: Height above the ground, in the unit of the positions; None: an 80th of the longest side of the box.
        up: Index of the axis that points up, 0 to 2.

    Returns:
        float64 [F, 3], viewpoints; the loop continues from the last to the first.

    Raises:
        WlmError: There is no probe, or no frame.
        ValueError: The shape is different, or the axis does not exist.
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
    # The end of the loop is also before its start.
    summed = np.cumsum(np.concatenate([[0.0], ground, ground[: width - 1]]))
    smooth = np.roll((summed[width:] - summed[:-width]) / width, (width - 1) // 2)
    path = np.empty((frames, 3))
    path[:, plan] = around
    path[:, up] = smooth + eye_height
    return path
