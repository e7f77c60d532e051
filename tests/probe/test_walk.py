"""A walk through a scene: the path and the figures."""

import json
import math

import numpy as np
import pytest

from wlm.errors import WlmError
from wlm.probe.data import from_arrays
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import camera_path, loop_frames, score_volume, settle, walk


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
        path = camera_path(position[:, order], 400, up=up)[:, order]
        low, high = position.min(0), position.max(0)
        eye = (high - low).max() / 80
        assert path.shape == (400, 3)
        assert ((path > low) & (path < high + eye))[:, [0, 2]].all()
        assert np.ptp(path[:, 0]) == pytest.approx(0.7 * (high - low)[0], rel=1e-3)
        above = path[:, 1] - _ground(path[:, 0], path[:, 2])
        assert np.abs(above - eye).max() < 0.8
        steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
        assert steps.max() < 2.0 * steps.mean()  # closed, and without a jump


def test_camera_path_of_little():
    """One probe, coincident probes, and no room in plan."""
    place = np.array([[3.0, 4.0, 5.0]])
    np.testing.assert_allclose(camera_path(place, 3), np.repeat(place, 3, 0))
    np.testing.assert_allclose(camera_path(np.repeat(place, 40, 0), 20), np.repeat(place, 20, 0))
    tower = np.stack([np.zeros(5), np.arange(5.0), np.zeros(5)], 1)
    np.testing.assert_allclose(camera_path(tower, 2), [[0.0, 2.05, 0.0]] * 2)
    for position, frames in [(np.zeros((0, 3)), 5), (place, 0)]:
        with pytest.raises(WlmError, match="camera path: expected at least"):
            camera_path(position, frames)
    for position, up in [(place[0], 1), (place, 3)]:
        with pytest.raises(ValueError, match="camera path"):
            camera_path(position, 5, up=up)


def test_loop_at_a_pace():
    """The number of frames gives the asked step in plan."""
    position = _hills() * [1.0, 0.01, 1.0]
    path = camera_path(position, loop_frames(position, 0.7))
    steps = np.linalg.norm(np.diff(path, axis=0, append=path[:1]), axis=1)
    assert steps.mean() == pytest.approx(0.7, rel=0.01)
    assert loop_frames(position, 1e9) == 1 and loop_frames(position, 1e-9) == 100_000


def test_figures_are_those_of_the_readings(device: str):
    """The figures of one frame follow from the volume, its light and the original, dead probes left out."""
    position = _hills()
    live = np.arange(len(position)) % 9 > 0
    original = _light(position) + np.random.default_rng(1).normal(size=(len(position), 2)).astype(np.float32) / 10
    volume = _volume(position, device, live=live, budget=40)
    reports = []
    path = _line(12, 1.0)
    figures = walk(volume, path, original, samples=60, progress=reports.append)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert (reports[-1].done, reports[-1].total, figures["frames"]) == (12, 12, 12)
    assert figures["updated"]["max"] == 40 and figures["left"]["max"] > 0 and figures["update_ms"]["mean"] > 0.0
    assert 0.0 < figures["coverage"]["min"] <= figures["coverage"]["mean"] <= 1.0
    # The last frame again, with all probes as samples.
    last = walk(volume, path[-1:], original, samples=10**6)
    inside = (np.abs(position - path[-1]) < 16.0).all(1)
    near, far = np.flatnonzero(live & inside), np.flatnonzero(live & ~inside)
    reading, light, peak = volume.read(position[near]), _light(position[near]), np.ptp(original)

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt((values.astype(np.float64) ** 2).mean()))

    assert last["rmse"]["mean"] == pytest.approx(rms(reading.values - light))
    assert last["rms"]["max"] == pytest.approx(rms(light))
    assert last["coverage"]["mean"] == pytest.approx((reading.level >= 0).mean())
    errors = {"psnr": reading.values - original[near], "light_psnr": light - original[near]}
    errors["far_psnr"] = volume.read(position[far]).values - original[far]
    for name, error in errors.items():
        assert last[name] == pytest.approx(20.0 * np.log10(peak / rms(error)))


def test_finer_blocks_err_less():
    """The error falls with the side of the blocks."""
    position = _hills(3000)
    errors = []
    for block in (1.0, 4.0, 16.0):
        volume = _volume(position, block=block, ratios=(1,), side=int(64 / block), budget=1024)
        settle(volume, _line(1, 0.0)[0])
        figures = walk(volume, _line(1, 0.0), _light(position), samples=500)
        assert figures["coverage"]["min"] > 0.99
        errors.append(figures["rmse"]["mean"])
    assert errors[0] < 0.5 * errors[1] < 0.25 * errors[2]


def test_points_that_nothing_covers_count_as_black():
    position = _hills()
    light = np.full((len(position), 1), 2.0, np.float32)
    volume = Volume(position, StoredLight(light), block=2.0, ratios=(1,), side=16, budget=1)
    figures = walk(volume, _line(1, 0.0), light, samples=10**6)
    covered = figures["coverage"]["mean"]
    assert 0.0 < covered < 0.2
    assert figures["rmse"]["mean"] == pytest.approx(2.0 * math.sqrt(1.0 - covered), rel=1e-5)


def test_a_second_lap_decodes_nothing():
    position = _hills()
    path, volume = camera_path(position, 30), _volume(position, budget=1024)
    first, second = (walk(volume, path, _light(position)) for _ in range(2))
    assert first["updated"]["max"] > 0 and second["updated"]["max"] == second["probes"]["max"] == 0
    assert second["left"]["max"] == 0 and second["light_psnr"] == first["light_psnr"] == 120.0


def test_a_walk_outside_of_the_scene():
    """Frames without a near sample have no coverage and no error."""
    volume, light = _volume(_hills(), budget=1024), _light(_hills())
    figures = walk(volume, _line(2, 1.0) + 1e6, light)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert all(figures[key] is None for key in ("coverage", "rmse", "rms", "psnr", "light_psnr"))
    there = walk(volume, _line(1, 0.0), light)
    again = walk(volume, np.concatenate([_line(2, 1.0) + 1e6, _line(1, 0.0)]), light)
    assert again["rmse"]["mean"] == there["rmse"]["mean"]


def test_walk_refuses():
    volume, light = _volume(_hills(50)), _light(_hills(50))
    for path, options in [(np.zeros(3), {}), (np.zeros((0, 3)), {}), (_line(1, 0.0), {"samples": 0})]:
        with pytest.raises(ValueError, match="walk: expected"):
            walk(volume, path, light, **options)
    with pytest.raises(ValueError, match="original"):
        walk(volume, _line(1, 0.0), light[1:])
    with pytest.raises(WlmError, match="viewpoint"):
        walk(volume, np.array([[0.0, np.nan, 0.0]]), light)


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
