"""A walk through a scene: the path, what each frame's figures say, and their summary."""

import json
import math

import numpy as np
import pytest

from wlm.errors import WlmError
from wlm.probe.data import from_arrays
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import camera_path, loop_frames, score_volume, settle, summary, walk


def _hills(count: int = 900) -> np.ndarray:
    """Probes on rolling ground, 80 m by 60 m."""
    random = np.random.default_rng(0)
    x, z = random.uniform(-40, 40, count), random.uniform(-30, 30, count)
    return np.stack([x, _ground(x, z), z], 1)


def _ground(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    return 5.0 + 2.0 * np.sin(x / 20.0) + z / 15.0


def _light(position: np.ndarray) -> np.ndarray:
    return np.stack([np.sin(position[:, 0] / 3), np.cos(position[:, 2] / 4)], 1).astype(np.float32)


def _volume(position: np.ndarray, device: str = "cpu", **settings: object) -> Volume:
    return Volume(position, StoredLight(_light(position), device), **({"block": 2.0, "side": 16} | settings))


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
    np.testing.assert_allclose(camera_path(place, 3, 1.6), [[3.0, 5.6, 5.0]] * 3)
    np.testing.assert_allclose(camera_path(np.repeat(place, 40, 0), 20, 0.0), np.repeat(place, 20, 0))
    np.testing.assert_allclose(camera_path(_hills(), 1), camera_path(_hills(), 1, np.ptp(_hills(), axis=0).max() / 80))
    tower = np.stack([np.zeros(5), np.arange(5.0), np.zeros(5)], 1)
    np.testing.assert_allclose(camera_path(tower, 2, 1.0), [[0.0, 3.0, 0.0]] * 2)
    for position, frames in [(np.zeros((0, 3)), 5), (place, 0)]:
        with pytest.raises(WlmError, match="camera path: expected at least"):
            camera_path(position, frames)
    for position, up in [(place[0], 1), (place, 3)]:
        with pytest.raises(ValueError, match="camera path"):
            camera_path(position, 5, up=up)


def test_loop_at_a_pace():
    """So many frames that each goes as far as it should, uphill apart."""
    position = _hills() * [1.0, 0.01, 1.0]
    for up, order in ((1, [0, 1, 2]), (2, [0, 2, 1])):
        turned = position[:, order]
        path = camera_path(turned, loop_frames(turned, 0.7, up), up=up)
        steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
        assert steps.mean() == pytest.approx(0.7, rel=0.01)
    assert loop_frames(position, 1e9) == 1 and loop_frames(position, 1e-9) == 100_000


def test_figures_of_each_frame(device: str):
    """A slow walk through a whole scene: what the figures say is what the volume, the light and the original are."""
    position = _hills()
    live = np.arange(len(position)) % 9 > 0
    original = _light(position) + np.random.default_rng(1).normal(size=(len(position), 2)).astype(np.float32) / 10
    volume = _volume(position, device, live=live, budget=40)
    reports = []
    path = _line(12, 1.0)
    figures = walk(volume, path, samples=60, original=original, progress=reports.append)
    assert (reports[-1].done, reports[-1].total, len(figures)) == (12, 12, 12)
    for figure, viewpoint in zip(figures, path, strict=True):
        assert figure.viewpoint == tuple(viewpoint) and figure.samples == figure.far == 60
        assert figure.coverage == pytest.approx(sum(figure.by_level)) and 0.0 < figure.coverage <= 1.0
        assert 0.0 < figure.rmse < 1.5 * figure.rms < 1.5
        assert min(figure.read_seconds, figure.stats.seconds) > 0.0
    assert figures[0].stats.updated == 40
    # The last frame again, with all probes in reach as samples, dead ones apart.
    last = walk(volume, path[-1:], samples=10**6, original=original)[0]
    inside = (np.abs(position - path[-1]) < 16.0).all(1)
    near, far = np.flatnonzero(live & inside), np.flatnonzero(live & ~inside)
    reading, light = volume.read(position[near]), _light(position[near])
    assert (last.samples, last.far, last.stats.entered) == (len(near), len(far), 0)

    def rms(values: np.ndarray) -> object:
        return pytest.approx(np.sqrt((values.astype(np.float64) ** 2).mean()))

    assert last.rmse == rms(reading.values - light) and last.rms == rms(light)
    assert last.original_rmse == rms(reading.values - original[near])
    assert last.light_rmse == rms(light - original[near])
    assert last.far_rmse == rms(volume.read(position[far]).values - original[far])
    assert last.coverage == pytest.approx((reading.level >= 0).mean())
    assert last.by_level == pytest.approx([(reading.level == level).mean() for level in range(4)])


def test_finer_blocks_err_less():
    """The error means something: it falls with the side of the blocks."""
    position = _hills(3000)
    errors = []
    for block in (1.0, 4.0, 16.0):
        volume = _volume(position, block=block, ratios=(1,), side=int(64 / block), budget=1024)
        settle(volume, _line(1, 0.0)[0])
        figure = walk(volume, _line(1, 0.0), samples=500, radius=20.0)[0]
        assert figure.coverage == 1.0
        errors.append(figure.rmse)
    assert errors[0] < 0.5 * errors[1] < 0.25 * errors[2]


def test_what_nothing_covers_counts_as_black():
    position = _hills()
    light = StoredLight(np.full((len(position), 1), 2.0))
    volume = Volume(position, light, block=2.0, ratios=(1,), side=16, budget=1)
    figure = walk(volume, _line(1, 0.0), samples=10**6)[0]
    assert 0.0 < figure.coverage < 0.2
    assert figure.rmse == pytest.approx(2.0 * math.sqrt(1.0 - figure.coverage), rel=1e-5)


def test_second_lap_costs_no_decode():
    position = _hills()
    path = camera_path(position, 30)
    volume = _volume(position, budget=1024)
    first = walk(volume, path)
    second = walk(volume, path)
    assert sum(f.stats.updated for f in first) > 0 and sum(f.stats.updated for f in second) == 0
    figures = summary(second)
    assert figures["from_cache"] == 1.0 and figures["settled"] == 1.0 and figures["probes"]["max"] == 0.0
    assert second[5].rmse == first[5].rmse  # the same draw, too


def test_summary():
    volume = _volume(_hills(), budget=30)
    frames = walk(volume, _line(20, 2.0), original=_light(_hills()) + 0.1)
    figures = summary(frames, 2.0)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    updated = [f.stats.updated for f in frames]
    expected = {"mean": np.mean(updated), "p95": np.percentile(updated, 95), "max": max(updated)}
    assert figures["frames"] == 20 and figures["updated"] == pytest.approx(expected)
    assert figures["update_ms"]["max"] == pytest.approx(1e3 * max(f.stats.seconds for f in frames))
    squares = np.concatenate([[f.far_rmse**2] * f.far for f in frames])
    assert figures["far_psnr"] == pytest.approx(10 * np.log10(4.0 / squares.mean()))
    assert figures["light_psnr"] == pytest.approx(20 * np.log10(2.0 / 0.1), abs=1e-4)
    assert "psnr" not in summary(frames)
    assert figures["coverage"]["min"] == min(f.coverage for f in frames)
    assert figures["settled"] == np.mean([f.stats.left == 0 for f in frames])
    assert figures["by_level"] == pytest.approx(np.mean([f.by_level for f in frames], 0))
    with pytest.raises(ValueError, match="summary"):
        summary([])


def test_a_walk_outside_of_the_scene():
    """Frames without a sample have no coverage and no error, and don't count in their means."""
    volume = _volume(_hills(), budget=1024)
    away = walk(volume, _line(2, 1.0) + 1e6)
    assert all(f.samples == 0 and math.isnan(f.coverage) and math.isnan(f.rmse) for f in away)
    figures = summary(away, 1.0)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert all(figures[key] is None for key in ("coverage", "by_level", "rmse", "rms", "from_cache", "psnr"))
    there = walk(volume, _line(1, 0.0))
    assert summary(away + there)["rmse"]["mean"] == there[0].rmse
    assert walk(volume, np.zeros((0, 3))) == []


def test_walk_refuses():
    volume = _volume(_hills(50))
    for path, options in [(np.zeros(3), {}), (_line(1, 0.0), {"samples": 0}), (_line(1, 0.0), {"radius": 0.0})]:
        with pytest.raises(ValueError, match="path|samples"):
            walk(volume, path, **options)
    with pytest.raises(ValueError, match="original"):
        walk(volume, _line(1, 0.0), original=np.zeros((49, 2)))
    with pytest.raises(WlmError, match="viewpoint"):
        walk(volume, np.array([[0.0, np.nan, 0.0]]))


def test_normals_of_a_set_keep_rooms_apart():
    """A bright room and a dark one, with a wall between that is thinner than a block."""
    along = np.stack(np.meshgrid(np.arange(-3.0, 3.1, 0.3), np.arange(0.0, 3.1, 0.3)), -1).reshape(-1, 2)
    side = np.repeat([-1.0, 1.0], len(along))
    position, normal = np.column_stack([0.05 * side, np.tile(along, (2, 1))]), side[:, None] * [7.0, 0.0, 0.0]
    values = np.where(side < 0, 1.0, 0.1)[:, None]
    psnr = []
    for known in (None, normal):
        probes = from_arrays(position, values, normal=known)
        psnr.append(score_volume(probes, StoredLight(probes.values), frames=3)["psnr"])
    assert psnr[1] > psnr[0] + 1.5
