"""A walk through a scene: the path, what each frame's figures say, and their summary."""

import json
import math

import numpy as np
import pytest

from wlm.errors import WlmError
from wlm.probe.volume import Volume
from wlm.probe.walk import camera_path, summary, walk


def _hills(count: int = 900) -> np.ndarray:
    """Probes on rolling ground, 80 m by 60 m."""
    random = np.random.default_rng(0)
    x, z = random.uniform(-40, 40, count), random.uniform(-30, 30, count)
    return np.stack([x, _ground(x, z), z], 1)


def _ground(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    return 5.0 + 2.0 * np.sin(x / 20.0) + z / 15.0


def _light(position: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(position[:, 0] / 3), np.cos(position[:, 2] / 4)], 1).astype(np.float32)


def _line(frames: int, step: float) -> np.ndarray:
    path = np.zeros((frames, 3))
    path[:, 0], path[:, 1] = np.arange(frames) * step, 7.0
    return path


def test_camera_path_follows_the_ground():
    position = _hills()
    for up in (0, 1, 2):
        order = {0: [1, 0, 2], 1: [0, 1, 2], 2: [0, 2, 1]}[up]
        path = camera_path(position[:, order], 400, eye_height=1.6, up=up)[:, order]
        low, high = position.min(0), position.max(0)
        assert path.shape == (400, 3)
        assert ((path > low) & (path < high + 1.6))[:, [0, 2]].all()
        assert np.ptp(path[:, 0]) == pytest.approx(0.7 * (high - low)[0], rel=1e-3)
        above = path[:, 1] - _ground(path[:, 0], path[:, 2])
        assert np.abs(above - 1.6).max() < 0.8
        steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
        assert steps.max() < 2.0 * steps.mean()  # closed, and without a jump


def test_camera_path_of_little():
    """One probe, coincident probes, one frame, and no room in plan."""
    place = np.array([[3.0, 4.0, 5.0]])
    np.testing.assert_allclose(camera_path(place, 3), [[3.0, 5.6, 5.0]] * 3)
    np.testing.assert_allclose(camera_path(np.repeat(place, 40, 0), 20, 0.0), np.repeat(place, 20, 0))
    assert camera_path(_hills(), 1).shape == (1, 3)
    tower = np.stack([np.zeros(5), np.arange(5.0), np.zeros(5)], 1)
    np.testing.assert_allclose(camera_path(tower, 2, 1.0), [[0.0, 3.0, 0.0]] * 2)
    for position, frames in [(np.zeros((0, 3)), 5), (place, 0)]:
        with pytest.raises(WlmError, match="camera path: expected at least"):
            camera_path(position, frames)
    for position, up in [(place[0], 1), (place, 3)]:
        with pytest.raises(ValueError, match="camera path"):
            camera_path(position, 5, up=up)


def test_figures_of_each_frame(device: str):
    """A slow walk through a whole scene: what the figures say is what the volume and the decoder do."""
    position = _hills()
    volume = Volume(position, _light, 2, budget=40, device=device)
    reports = []
    path = _line(12, 1.0)
    figures = walk(volume, path, samples=100, progress=reports.append)
    assert (reports[-1].done, reports[-1].total, len(figures)) == (12, 12, 12)
    for figure, viewpoint in zip(figures, path, strict=True):
        assert figure.viewpoint == tuple(viewpoint) and figure.samples == 100
        assert figure.coverage == pytest.approx(sum(figure.by_level)) and 0.0 < figure.coverage <= 1.0
        assert 0.0 < figure.rmse < 1.5 * figure.rms < 1.5
        assert min(figure.read_seconds, figure.stats.find_seconds, figure.stats.upload_seconds) > 0.0
    assert figures[0].stats.updated == 40 and figures[0].stats.decode_seconds > 0.0
    # The last frame again, with all probes in reach as samples.
    last = walk(volume, path[-1:], samples=10**6)[0]
    near = position[(np.abs(position - path[-1]) <= 32.0).all(1)]
    reading = volume.read(near)
    assert last.samples == len(near) and last.stats.entered == 0
    error = (reading.values - _light(near)).astype(np.float64)
    assert last.rmse == pytest.approx(np.sqrt((error**2).mean()))
    assert last.rms == pytest.approx(np.sqrt((_light(near).astype(np.float64) ** 2).mean()))
    assert last.coverage == pytest.approx((reading.level >= 0).mean())
    assert last.by_level == pytest.approx([(reading.level == level).mean() for level in range(4)])


def test_finer_blocks_err_less():
    """The error means something: it falls with the side of the blocks, and a constant light has none."""
    position = _hills(3000)
    errors = []
    for size in (1.0, 4.0, 16.0):
        volume = Volume(position, _light, 2, sizes=(size,), side=int(64 / size), budget=10**6)
        figure = walk(volume, _line(1, 0.0), samples=500, radius=20.0)[0]
        assert figure.coverage == 1.0
        errors.append(figure.rmse)
    assert errors[0] < 0.5 * errors[1] < 0.25 * errors[2]
    flat = Volume(position, lambda p: np.full((len(p), 3), 2.5, np.float32), 3)
    figure = walk(flat, _line(1, 0.0))[0]
    assert figure.rmse < 1e-6 and figure.rms == 2.5


def test_what_nothing_covers_counts_as_black():
    volume = Volume(_hills(), lambda p: np.full((len(p), 1), 2.0, np.float32), 1, sizes=(2.0,), budget=1)
    figure = walk(volume, _line(1, 0.0), samples=10**6)[0]
    assert 0.0 < figure.coverage < 0.1
    assert figure.rmse == pytest.approx(2.0 * math.sqrt(1.0 - figure.coverage), rel=1e-5)


def test_second_lap_costs_no_decode():
    position = _hills()
    path = camera_path(position, 60)
    volume = Volume(position, _light, 2, budget=10**6)
    first = walk(volume, path)
    second = walk(volume, path)
    assert sum(f.stats.updated for f in first) > 0 and sum(f.stats.updated for f in second) == 0
    figures = summary(second)
    assert figures["from_cache"] == 1.0 and figures["settled"] == 1.0 and figures["probes"]["max"] == 0.0
    assert second[5].rmse == first[5].rmse  # the same draw, too


def test_summary():
    volume = Volume(_hills(), _light, 2, budget=30)
    frames = walk(volume, _line(20, 2.0))
    figures = summary(frames)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    updated = [f.stats.updated for f in frames]
    expected = {"mean": np.mean(updated), "p95": np.percentile(updated, 95), "max": max(updated)}
    assert figures["frames"] == 20 and figures["updated"] == pytest.approx(expected)
    stages = figures["find_ms"]["mean"] + figures["decode_ms"]["mean"] + figures["upload_ms"]["mean"]
    assert figures["update_ms"]["mean"] == pytest.approx(stages)
    slowest = max(f.stats.find_seconds + f.stats.decode_seconds + f.stats.upload_seconds for f in frames)
    assert figures["update_ms"]["max"] == pytest.approx(1e3 * slowest)
    assert figures["coverage"]["min"] == min(f.coverage for f in frames)
    assert figures["settled"] == np.mean([f.stats.left == 0 for f in frames])
    assert figures["by_level"] == pytest.approx(np.mean([f.by_level for f in frames], 0))
    with pytest.raises(ValueError, match="summary"):
        summary([])


def test_a_walk_outside_of_the_scene():
    """Frames without a sample have no coverage and no error, and don't count in their means."""
    volume = Volume(_hills(), _light, 2, budget=10**6)
    away = walk(volume, _line(2, 1.0) + 1e6)
    assert all(f.samples == 0 and math.isnan(f.coverage) and math.isnan(f.rmse) for f in away)
    figures = summary(away)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert all(figures[key] is None for key in ("coverage", "by_level", "rmse", "rms", "from_cache"))
    there = walk(volume, _line(1, 0.0))
    assert summary(away + there)["rmse"]["mean"] == there[0].rmse
    assert walk(volume, np.zeros((0, 3))) == []


def test_walk_refuses():
    volume = Volume(_hills(50), _light, 2)
    for path, options in [(np.zeros(3), {}), (_line(1, 0.0), {"samples": 0}), (_line(1, 0.0), {"radius": 0.0})]:
        with pytest.raises(ValueError, match="path|samples"):
            walk(volume, path, **options)
    with pytest.raises(WlmError, match="viewpoint"):
        walk(volume, np.array([[0.0, np.nan, 0.0]]))
