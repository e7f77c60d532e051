"""A walk through a scene with a cascaded lighting volume: cost, coverage and error of each frame."""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.probe.volume import FrameStats, Volume
from wlm.system import Meter, OnProgress

EYE_HEIGHT = 1.6  # metres

_LOOP = 0.35  # half axes of the loop over the box's sides: it stays inside, and passes near the rim
_GROUND = 16  # probes that tell the height of the ground


@dataclass(frozen=True)
class FrameFigures:
    """One frame of a walk.

    Attributes:
        viewpoint: x, y, z.
        stats: Of the update, with its seconds by stage.
        read_seconds: Reading the samples, with the copies to the device and back.
        samples: Live probes near the viewer at which the volume was read.
        coverage: Share of them that some level answers; NaN where there are none, as the next three.
        by_level: Share of them by the level that answers most of it, from the finest.
        rmse: Root mean square over samples and channels of what was read minus the direct decode; what nothing covers
            counts as 0, since it would be drawn black.
        rms: Root mean square of the direct decode, to compare with.
    """

    viewpoint: tuple[float, float, float]
    stats: FrameStats
    read_seconds: float
    samples: int
    coverage: float
    by_level: tuple[float, ...]
    rmse: float
    rms: float


def walk(
    volume: Volume,
    path: np.ndarray,
    samples: int = 256,
    radius: float | None = None,
    seed: int = 0,
    progress: OnProgress | None = None,
) -> list[FrameFigures]:
    """Moves a volume along a path, one update a frame, and reads it at probes near the viewer.

    The samples lie on the surfaces, where a renderer reads. Those are also the places that the volume was made from:
    the error says what the volume adds to the decoder's, not how well it guesses between probes.

    Args:
        volume: In any state; it goes on from there.
        path: [F, 3], viewpoints, in the unit of the probes' positions.
        samples: Most probes to read in a frame, drawn at random.
        radius: Half the side of the cube round the viewer that they are drawn from; None: that of the second finest
            window (32 m with the paper's settings), or of the only one.
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
        radius = volume.sizes[:2][-1] * volume.side / 2
    if samples < 1 or not radius > 0.0:
        raise ValueError(f"samples, radius: expected at least 1 and above 0, got {samples} and {radius}")
    figures = []
    meter = Meter(progress, "walk", len(path))
    for frame, viewpoint in enumerate(path):
        stats = volume.update(viewpoint)
        near, _ = volume.index.query(viewpoint[None] - radius, viewpoint[None] + radius)
        if len(near) > samples:
            near = np.random.default_rng(seed).choice(near, samples, replace=False)
        figures.append(_measure(volume, viewpoint, stats, volume.position[near]))
        if meter.due(frame + 1):
            meter.report(frame + 1)
    return figures


def _measure(volume: Volume, viewpoint: np.ndarray, stats: FrameStats, points: np.ndarray) -> FrameFigures:
    start = time.perf_counter()
    reading = volume.read(points)
    seconds = time.perf_counter() - start
    place = tuple(viewpoint.tolist())
    levels = len(volume.sizes)
    if len(points) == 0:
        return FrameFigures(place, stats, seconds, 0, math.nan, (math.nan,) * levels, math.nan, math.nan)
    direct = volume.decode(points).astype(np.float64)
    return FrameFigures(
        viewpoint=place,
        stats=stats,
        read_seconds=seconds,
        samples=len(points),
        coverage=float((reading.level >= 0).mean()),
        by_level=tuple(float((reading.level == level).mean()) for level in range(levels)),
        rmse=float(np.sqrt(((reading.values - direct) ** 2).mean())),
        rms=float(np.sqrt((direct**2).mean())),
    )


def summary(figures: Sequence[FrameFigures]) -> dict[str, object]:
    """Statistics of a walk, in numbers, lists and None alone.

    Args:
        figures: From `walk`, at least one frame.

    Returns:
        - `frames`, their number; `settled`, share of the frames that left nothing waiting; `from_cache`, share
          of the blocks written that came from the cache, None if none was written.
        - `mean`, `p95` and `max` over the frames of the counts of `FrameStats` by their names, of
          `update_ms` and its parts `find_ms`, `decode_ms` and `upload_ms`, and of `read_ms`.
        - Over the frames that have samples, None where no frame has: the same of `rmse` and `rms`; `mean`,
          `p5` and `min` of `coverage`; mean shares `by_level`.

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
    stages = {name: [1e3 * getattr(s, f"{name}_seconds") for s in stats] for name in ("find", "decode", "upload")}
    result["update_ms"] = _statistics(np.sum(list(stages.values()), 0))
    for name, values in stages.items():
        result[f"{name}_ms"] = _statistics(values)
    result["read_ms"] = _statistics([1e3 * figure.read_seconds for figure in figures])
    sampled = [figure for figure in figures if figure.samples]
    result["coverage"] = _statistics([figure.coverage for figure in sampled], more_is_worse=False)
    result["by_level"] = np.mean([figure.by_level for figure in sampled], 0).tolist() if sampled else None
    result["rmse"] = _statistics([figure.rmse for figure in sampled])
    result["rms"] = _statistics([figure.rms for figure in sampled])
    return result


def _statistics(values: Sequence[float] | np.ndarray, more_is_worse: bool = True) -> dict[str, float] | None:
    """Mean, the percentile that only 5% of the values exceed in the bad direction, and the worst value."""
    if len(values) == 0:
        return None
    mean = {"mean": float(np.mean(values))}
    if more_is_worse:
        return mean | {"p95": float(np.percentile(values, 95)), "max": float(np.max(values))}
    return mean | {"p5": float(np.percentile(values, 5)), "min": float(np.min(values))}


def camera_path(position: np.ndarray, frames: int, eye_height: float = EYE_HEIGHT, up: int = 1) -> np.ndarray:
    """A closed loop through a scene: an ellipse in the probes' box that follows the ground at eye height.

    The ground at a point is the median height of the 16 probes nearest to it in plan, averaged over an eighth of the
    loop, since a viewer doesn't jump on to a roof.

    Args:
        position: [N, 3], of the live probes.
        frames: F.
        eye_height: Above the ground, in the unit of the positions.
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
