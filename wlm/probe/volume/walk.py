"""Walks through a scene with a cascaded lighting volume, and measures the cost, coverage and error of its frames."""

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import Light, at_probes
from wlm.system import Meter, OnProgress

_EYE_SHARE = 1.6 / 128  # eye height over the longest side of the probes' box: 1.6 m in a village of 128 m
_STEP = 0.1  # sides of the finest block that a viewer moves per frame: with blocks of 2 m at 60 Hz, 43 km/h
_LOOP = 0.35  # half axes of the loop over the sides of the box: the loop stays inside, near the border
_GROUND = 16  # probes whose median height is that of the ground
_TURNS = 1024  # frames without a free row after which waiting blocks are abandoned
_MOST_FRAMES = 100_000
_SAMPLES = 256  # most probes at which the volume is read in a frame, near the viewer and farther away


def walk(
    volume: Volume,
    path: np.ndarray,
    original: np.ndarray,
    *,
    samples: int = _SAMPLES,
    progress: OnProgress | None = None,
) -> dict[str, object]:
    """Moves a volume along a path, one update per frame, and compares its light at probes with the original.

    The light is read at random live probes, the samples, since probes lie on surfaces in most sets, as a renderer's
    points do. Samples have the probes' normals if the volume has normals. A probe is near if the finest window around
    the viewer contains it.

    Args:
        volume: A volume in any state; the walk continues from there.
        path: [F, 3], viewpoints, in the unit of the probes' positions.
        original: [N, D], original light of all probes.
        samples: Largest number of probes to read per frame near the viewer; as many are read farther away.
        progress: Called about twice a second, with the number of finished frames.

    Returns:
        JSON values:

        - `frames`, their number.
        - `mean`, `p95` and `max` over the frames: of `updated`, blocks decoded; `probes`, probes decoded; `left`,
          blocks that still wait; and `update_ms`, the duration of a frame.
        - `mean`, `p95` and `max` over the frames that have near samples, or None: of `rmse`, the RMS difference between
          the light read and the light that fills the volume, where a point that no block covers counts as 0; and of
          `rms`, the RMS of the filling light. `mean` and `min` of `coverage`, the share of near samples in a block.
        - PSNRs in dB over the samples of all frames, or None; the peak is the range of the original light: `psnr` of
          the near readings against the original, `light_psnr` of the light that fills the volume at the same samples,
          and `far_psnr` of the readings farther away.

    Raises:
        WlmError: A viewpoint is not finite, or too far away.
        ValueError: A shape is different, or there is no frame or no sample.
    """
    path, original = np.asarray(path, np.float64), np.asarray(original)
    if path.ndim != 2 or path.shape[1] != 3 or len(path) == 0 or samples < 1:
        raise ValueError(f"walk: expected viewpoints [F, 3] and 1 or more samples, got {path.shape} and {samples}")
    if original.shape != (len(volume.position), volume.channels):
        raise ValueError(f"original: expected {[len(volume.position), volume.channels]}, got {list(original.shape)}")
    position, truth = volume.position[volume.numbers], original[volume.numbers].astype(np.float64)
    normal = None if volume.normal is None else volume.normal[volume.numbers]
    light = at_probes(volume.light, volume.numbers).astype(np.float64)
    costs: dict[str, list[float]] = {name: [] for name in ("updated", "probes", "left", "update_ms")}
    near_figures: dict[str, list[float]] = {name: [] for name in ("coverage", "rmse", "rms")}
    errors = {name: np.zeros(2) for name in ("psnr", "light_psnr", "far_psnr")}  # sums of squares and of numbers
    meter = Meter(progress, "walk", len(path))
    for frame, viewpoint in enumerate(path):
        stats = volume.update(viewpoint)
        for name in ("updated", "probes", "left"):
            costs[name].append(getattr(stats, name))
        costs["update_ms"].append(1e3 * stats.seconds)
        low = volume.sizes[0] * volume.base[0]
        inside = ((position > low) & (position < low + volume.sizes[0] * volume.sides[0])).all(1)
        random = np.random.default_rng(0)  # the same samples whenever the viewer is here
        near, far = (_draw(np.flatnonzero(part), samples, random) for part in (inside, ~inside))
        reading = volume.read(position[near], None if normal is None else normal[near])
        away = volume.read(position[far], None if normal is None else normal[far])
        if len(near):
            near_figures["coverage"].append(float((reading.level >= 0).mean()))
            near_figures["rmse"].append(_rms(reading.values - light[near]))
            near_figures["rms"].append(_rms(light[near]))
        errors["psnr"] += _squares(reading.values - truth[near])
        errors["light_psnr"] += _squares(light[near] - truth[near])
        errors["far_psnr"] += _squares(away.values - truth[far])
        if meter.due(frame + 1):
            meter.report(frame + 1)
    coverage, peak = near_figures.pop("coverage"), float(original.max()) - float(original.min())
    figures = {name: _statistics(values) for name, values in (costs | near_figures).items()}
    decibels = {name: psnr_from_mse(total / count, peak) if count else None for name, (total, count) in errors.items()}
    covered = {"mean": float(np.mean(coverage)), "min": min(coverage)} if coverage else None
    return {"frames": len(path), **figures, "coverage": covered, **decibels}


def settle(volume: Volume, viewpoint: np.ndarray) -> int:
    """Updates a volume at one viewpoint until no block waits, or no memory is free for the waiting blocks. The volume
    may be in any state; `viewpoint` is [3]. Returns the number of frames that it took."""
    frames, idle = 1, 0
    left = volume.update(viewpoint).left
    # Groups of the pool's rows take turns: the next frame may have a free row even if this one has none.
    while left and idle < _TURNS:
        stats = volume.update(viewpoint)
        left, frames = stats.left, frames + 1
        idle = 0 if stats.updated or volume.light.waiting else idle + 1
    return frames


def score_volume(
    probes: ProbeSet, light: Light, *, frames: int | None = None, progress: OnProgress | None = None
) -> dict[str, object]:
    """Walks around a scene with a volume that starts empty, and compares its light with the original probes.

    Args:
        probes: The original probes.
        light: Light of all probes, original or decoded.
        frames: Number of frames of the loop; None: each frame moves the viewer by a tenth of a block.
        progress: As for `walk`.

    Returns:
        The result of `walk`, with `block`, the side of the finest blocks; `first_ms`, the duration of the first frame;
        `first_frames`, the number of frames until no block waits; `memory`, the bytes of the volume by part, and
        `memory_bytes`, their sum.
    """
    volume = Volume(probes.position, light, live=probes.live, normal=probes.normal)
    lit = probes.position[probes.live]
    path = camera_path(lit, frames or loop_frames(lit, _STEP * volume.sizes[0]))
    first = volume.update(path[0])
    count = 1 + (settle(volume, path[0]) if first.left else 0)
    return walk(volume, path, probes.values, progress=progress) | {
        "block": volume.sizes[0],
        "first_ms": 1e3 * first.seconds,
        "first_frames": count,
        "memory": volume.memory,
        "memory_bytes": volume.memory_bytes,
    }


def _draw(numbers: np.ndarray, most: int, random: np.random.Generator) -> np.ndarray:
    return random.choice(numbers, most, replace=False) if len(numbers) > most else numbers


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt((values.astype(np.float64) ** 2).mean()))


def _squares(error: np.ndarray) -> tuple[float, int]:
    return float(np.square(error).sum()), error.size


def _statistics(values: Sequence[float]) -> dict[str, float] | None:
    if len(values) == 0:
        return None
    return {"mean": float(np.mean(values)), "p95": float(np.percentile(values, 95)), "max": float(np.max(values))}


def loop_frames(position: np.ndarray, step: float) -> int:
    """Returns the number of frames of the loop of `camera_path`, y up, for a viewer who moves by `step` per frame."""
    # Ramanujan's circumference of an ellipse, within 0.1% up to an aspect ratio of 3.
    a, b = _LOOP * np.ptp(np.asarray(position, np.float64), axis=0)[[0, 2]]
    around = math.pi * (3 * (a + b) - math.sqrt((3 * a + b) * (a + 3 * b)))
    return int(np.clip(math.ceil(around / step), 1, _MOST_FRAMES))


def camera_path(position: np.ndarray, frames: int, *, up: int = 1) -> np.ndarray:
    """Returns a closed loop through a scene: an ellipse in the probes' box that follows the ground at eye height.

    The eye height is an 80th of the longest side of the box. The ground at a point is the median height of the 16
    probes nearest to it in plan, averaged over an eighth of the loop, so that the viewer does not jump onto a roof.

    Args:
        position: [N, 3], of the live probes.
        frames: Number of frames, F.
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
    path[:, up] = smooth + _EYE_SHARE * float(np.ptp(position, axis=0).max())
    return path
