"""The cascaded lighting volume: its index, its blocks, its export, and walks through it."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from builders.checks import error_of, misuse_of
from builders.exported import read_export
from reference import volume as reference
from reference import volume_blocks

from wlm.errors import WlmError
from wlm.export import export
from wlm.probe.data import from_arrays
from wlm.probe.volume.bundle import volume_bundle
from wlm.probe.volume.cascade import FrameStats, Volume
from wlm.probe.volume.index import BlockIndex, finest_side
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import camera_path, loop_frames, score_volume, settle, walk

# A multiple of every block's side, so that all of a scene can move by it.
FAR = np.array([1_000_000.0, -1_000_000.0, 3_200_000.0])
SIDE = 8


def _field(position: np.ndarray, channels: int = 5) -> np.ndarray:
    """A smooth light with a number for each place."""
    random = np.random.default_rng(channels)
    slope, phase = random.normal(size=(3, channels)) / 8, random.uniform(0, 6, channels)
    return np.sin(position @ slope + phase).astype(np.float32)


def _surface(count: int = 800, seed: int = 0) -> np.ndarray:
    """Probes on two floors and a wall of a scene 120 m wide."""
    random = np.random.default_rng(seed)
    x, z = random.uniform(-60, 60, (2, count))
    kind = random.integers(0, 3, count)
    floor = np.stack([x, 0.5 * np.sin(x / 5), z], 1)
    upper = np.stack([x / 2, np.full(count, 9.0), z / 2], 1)
    wall = np.stack([np.full(count, 20.3), np.abs(x) / 4, z], 1)
    return np.where((kind == 0)[:, None], floor, np.where((kind == 1)[:, None], upper, wall))


def _volume(position: np.ndarray, device: str = "cpu", **settings: object) -> Volume:
    return Volume(position, StoredLight(_field(position), device), **({"block": 2.0, "side": SIDE} | settings))


def _names(position: np.ndarray, volume: Volume) -> set[tuple[int, ...]]:
    """(level, x, y, z) of the blocks of the windows that are read at a probe, one probe at a time."""
    return {
        (level, *block)
        for level, size in enumerate(volume.sizes)
        for block in volume_blocks.blocks(position, size)
        if ((block - volume.base[level] >= 0) & (block - volume.base[level] < volume.sides[level])).all()
    }


def _unscroll(volume: Volume) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """The windows' blocks in spatial order, 0 where one is missing, and whether they are present, for each level."""
    state, ends, values, valid = volume.state(), np.cumsum(volume.sides.prod(1)), [], []
    for base, sides, page in zip(state.bases, volume.sides, np.split(state.pages, ends[:-1]), strict=True):
        rows = np.roll(page.reshape(sides), -base, (0, 1, 2))  # a block's slot is its place modulo the sides
        valid.append(rows >= 0)
        light = state.pool[rows].view(np.float16) * state.factor[rows, None]
        values.append(np.where(valid[-1][..., None], light, np.float32(0.0)))
    return values, valid


def _there(volume: Volume) -> dict[tuple[int, ...], np.ndarray]:
    """The blocks that can be read, by name."""
    there = {}
    for level, (values, valid) in enumerate(zip(*_unscroll(volume), strict=True)):
        there |= {(level, *(i + volume.base[level]).tolist()): values[tuple(i)] for i in np.argwhere(valid)}
    return there


def _same(volume: Volume, other: Volume) -> None:
    """Both have the same blocks with the same light."""
    for got, want in zip(_unscroll(volume), _unscroll(other), strict=True):
        for level, expected in zip(got, want, strict=True):
            np.testing.assert_array_equal(level, expected)


def _settle(volume: Volume, viewpoint: object) -> list[FrameStats]:
    frames = [volume.update(viewpoint)]
    while frames[-1].left:
        frames.append(volume.update(viewpoint))
        assert len(frames) < 10_000
    return frames


@pytest.mark.parametrize("budget", [7, 64])
def test_teleport_converges_in_the_frames_of_the_budget(device: str, budget: int):
    """ceil(blocks near a probe / budget) frames, each full but the last; empty blocks cost nothing."""
    position = _surface(150)
    volume = _volume(position, device, budget=budget)
    decoded = set()
    for viewpoint in ([0.0, 2.0, 0.0], [700.0, 0.0, 0.0], [-40.0, 3.0, 41.0]):
        frames = _settle(volume, viewpoint)
        names = _names(position, volume)
        blocks = len(names - decoded)
        decoded |= names
        assert frames[0].queued == blocks
        assert len(frames) == max(math.ceil(blocks / budget), 1)
        assert [f.updated for f in frames[:-1]] == [budget] * (len(frames) - 1)
        assert sum(f.updated for f in frames) == blocks
        assert [f.left for f in frames] == [max(blocks - budget * (i + 1), 0) for i in range(len(frames))]
        assert set(_there(volume)) == names
        again = volume.update(viewpoint)
        assert (again.entered, again.updated, again.cached, again.probes, again.left) == (0, 0, 0, 0, 0)


def test_nearest_blocks_first(device: str):
    """Blocks are decoded by their distance in units of their own side, the finer one of two alike first."""
    position = _surface()
    viewpoint = np.array([3.0, 1.0, -5.0])
    volume = _volume(position, device, budget=90)
    volume.update(viewpoint)

    def rank(name: tuple[int, ...]) -> tuple[float, int]:
        away = np.array(name[1:]) + 0.5 - viewpoint / volume.sizes[name[0]]
        return round(float((away**2).sum()), 3), name[0]

    ranks = sorted(rank(name) for name in _names(position, volume))
    assert sorted(rank(name) for name in _there(volume)) == ranks[:90]
    assert {level for _, level in ranks[:90]} == {0, 1, 2, 3}


class _Day(StoredLight):
    """Light of an hour: that of `_field` times the hour."""

    def __init__(self, position: np.ndarray, device: str) -> None:
        self._field = _field(position)
        super().__init__(self._field, device)
        self.set(1.0)

    def set(self, hour: float) -> None:
        self.time = hour
        self._values.assign(self._field * np.float32(hour))


@pytest.mark.parametrize("rows", [400, 32768])
def test_blocks_of_another_hour_are_decoded_again(device: str, rows: int):
    """Missing blocks come first, in every fourth frame last; those of another hour by distance over the hours between.
    A block shows its light until then."""
    position = _surface(60)
    light, here, away = _Day(position, device), np.array([3.0, 1.0, -5.0]), np.array([17.0, 1.0, 9.0])
    volume = Volume(position, light, block=2.0, side=SIDE, budget=20, rows=rows, tolerance=0.25)
    _settle(volume, here)
    plain = _there(volume)
    hours = dict.fromkeys(plain, 1.0)

    def frame(at: np.ndarray, hour: float) -> FrameStats:
        light.set(hour)
        stats, there = volume.update(at), _there(volume)
        entered = [name for name in there if name not in hours]

        def rank(name: tuple[int, ...]) -> float:
            late, away = abs(hours[name] - hour), np.array(name[1:]) + 0.5 - at / volume.sizes[name[0]]
            return float((away**2).sum()) / min(late, 24 - late) ** 2

        old = [name for name in there if name in hours and 0.25 < abs(hours[name] - hour) < 23.75]
        again = sorted(old, key=rank)[: 20 - len(entered)]
        if volume.frame % 4 == 0:
            assert len(again) == min(len(old), 20)
        hours.update(dict.fromkeys(entered + again, hour))
        for name, light_of in there.items():
            np.testing.assert_allclose(light_of, plain.setdefault(name, light_of / hour) * hours[name], rtol=2e-3)
        left = len(old) - len(again) + len(_names(position, volume) - set(there))
        assert (stats.updated, stats.left) == (len(entered) + len(again), left)
        return stats

    assert len(plain) > 40 and (volume.rows == 400) == (rows == 400)
    assert frame(here, 1.2).updated == 0  # within the tolerance
    assert frame(here, 6.0).updated == 20
    assert frame(here, 6.5).updated == 20  # the others are 5.5 h off, the first ones half an hour
    assert frame(away, 6.7).queued > 0
    while frame(away, 6.7).left:
        pass
    assert frame(away, 6.7).updated == 0
    frame(away, 23.9)
    light.set(0.1)  # near midnight 0.2 h lie between
    assert volume.update(away).left < len(_there(volume)) - 20


def test_blocks_have_the_stated_light(device: str):
    """Blocks that few probes decide, against a dense system; of the others the probes are spread over their reach."""
    position = _surface(250)
    values = _field(position)
    volume = _volume(position, device, budget=1024)
    stats = _settle(volume, [1.0, 2.0, 3.0])
    there = _there(volume)
    assert {name[0] for name in there} == {0, 1, 2, 3}
    full = 0
    for level, *block in there:
        size, got = volume.sizes[level], there[level, *block]
        near = volume_blocks.near(position, tuple(block), size)
        low, high = values[near].min(0), values[near].max(0)
        low, high = low - 0.5 * (high - low), high + 0.5 * (high - low)
        if len(near) <= 16:
            want = volume_blocks.weights(position[near], tuple(block), size) @ values[near]
            np.testing.assert_allclose(got, np.clip(want, low, high), rtol=5e-4, atol=2e-5)
        else:
            full += 1
            room = 5e-4 * np.maximum(np.abs(low), np.abs(high)) + 1e-5
            assert (got > low - room).all() and (got < high + room).all()
    assert 0 < full < len(there) / 2
    near = (len(volume_blocks.near(position, tuple(block), volume.sizes[level])) for level, *block in there)
    assert sum(s.probes for s in stats) == sum(min(16, count) for count in near)


def test_read_at_a_probe_is_that_probes_light(device: str):
    """Most of a light without likeness from probe to probe comes back, where a mean leaves little; a constant all."""
    random = np.random.default_rng(3)
    grid = np.stack(np.meshgrid(np.arange(30.0), 0.0, np.arange(30.0)), -1).reshape(-1, 3)
    position = 2.0 * grid + random.uniform(-0.5, 0.5, grid.shape) - 30.0
    noise = random.normal(size=(len(position), 3)).astype(np.float32)
    for light, most in ((noise, 0.45), (np.full_like(noise, 2.5), 1e-5)):
        volume = Volume(position, StoredLight(light, device), budget=1024)
        settle(volume, position.mean(0))
        near = (np.abs(position - position.mean(0)) < 15 * volume.sizes[0]).all(1)
        error = volume.read(position[near]).values - light[near]
        assert near.sum() > 100 and np.sqrt((error**2).mean()) < most


def test_normals_keep_light_from_leaking(device: str):
    """A bright room and a dark one, with a wall between that is thinner than a block."""
    random = np.random.default_rng(4)
    along = np.stack(np.meshgrid(np.arange(-3.0, 3.1, 0.3), np.arange(0.0, 3.1, 0.3)), -1).reshape(-1, 2)
    along = np.concatenate([along, along]) + random.uniform(-0.1, 0.1, (2 * len(along), 2))
    bright = np.arange(len(along)) < len(along) / 2
    side = np.where(bright, -1.0, 1.0)
    position, normal = np.column_stack([0.05 * side, along]), side[:, None] * [7.0, 0.0, 0.0]
    light = StoredLight(bright[:, None].astype(float), device)
    leaks = []
    for known in (None, normal):
        volume = Volume(position, light, normal=known, block=1.0, ratios=(1,), side=16, budget=1024)
        settle(volume, np.zeros(3))
        inner = ~bright & (np.abs(along[:, 0]) < 2.5) & (np.abs(along[:, 1] - 1.5) < 1.0)
        reading = volume.read(position[inner], known if known is None else normal[inner])
        leaks.append(float(np.sqrt((reading.values**2).mean())))
    assert leaks[0] > 0.3 and leaks[1] < 0.4 * leaks[0]
    sets = [from_arrays(position, bright[:, None] + 0.1, normal=known) for known in (None, normal)]
    psnr = [score_volume(each, StoredLight(each.values, device), frames=2)["psnr"] for each in sets]
    assert psnr[1] > psnr[0] + 1.5
    assert "normal" in misuse_of(Volume, position, light, normal=normal[1:])


def test_any_way_leads_to_the_same_volume(device: str):
    """After a walk with jumps, once settled, it equals one that starts there, bit for bit."""
    position = _surface()
    walked = _volume(position, device, budget=16, rows=2048)
    random = np.random.default_rng(5)
    viewpoint = np.zeros(3)
    for step in range(60):
        viewpoint = random.uniform(-50, 50, 3) if step % 15 == 14 else viewpoint + random.normal(size=3) * 2
        walked.update(viewpoint)
    settle(walked, viewpoint)
    fresh = _volume(position, device)
    settle(fresh, viewpoint)
    _same(walked, fresh)
    points = viewpoint + random.uniform(-70, 70, (500, 3))
    np.testing.assert_array_equal(walked.read(points).values, fresh.read(points).values)


def test_a_frame_without_change_is_left_out_without_effect(device: str):
    """Neither the light nor the rows that are given away next depend on frames in which the viewer hardly moves."""
    position = _surface(1500)
    random = np.random.default_rng(6)
    usual, full = (_volume(position, device, budget=256, rows=900) for _ in range(2))
    ran, step = [], usual._step
    usual._step = lambda: (ran.append(usual.frame), step())
    for _ in range(40):
        viewpoint = random.uniform(-60, 60, 3) * [1.0, 0.1, 1.0]
        for moved in (0.0, 0.0, 0.0, 0.0, 0.01):
            full._left = 1
            stats = (each.update(viewpoint + moved) for each in (usual, full))
            assert len({replace(each, seconds=0.0) for each in stats}) == 1
    assert 40 <= len(ran) < 160
    for got, want in zip(usual.state(), full.state(), strict=True):
        np.testing.assert_array_equal(got, want)


def test_no_read_of_a_block_that_is_not_there(device: str):
    """In every frame of a hurried walk what is there lies in the windows and is right, and a read takes that alone."""
    position = _surface(250)
    volume = _volume(position, device, budget=3, rows=400)
    whole = _volume(position, side=16, budget=1024)
    settle(whole, np.zeros(3))
    truth = _there(whole)
    random = np.random.default_rng(6)
    home, dropped, cached = np.array([0.0, 1.0, 0.0]), 0, 0
    for step in range(9):
        if step % 3 == 0:
            viewpoint = np.array([40.0, 3.0, -30.0]) if step == 3 else home
        viewpoint = viewpoint + random.normal(size=3) * [4, 1, 4]
        stats = volume.update(viewpoint)
        dropped, cached = dropped + stats.dropped, cached + stats.cached
        there = _there(volume)
        names = _names(position, volume)
        assert set(there) <= names and len(names - set(there)) == stats.left > 0
        for name, value in there.items():
            if name in truth:
                np.testing.assert_array_equal(value, truth[name])
        points = viewpoint + random.uniform(-1, 1, (20, 3)) * np.repeat([3.0, 20.0], 10)[:, None]
        reading = volume.read(points)
        want, shares = reference.read(there, volume.base, volume.sizes, volume.sides, points, 5)
        np.testing.assert_allclose(reading.weight, shares.sum(1), atol=1e-5)
        np.testing.assert_allclose(reading.values * reading.weight[:, None], want * shares.sum(1)[:, None], atol=1e-4)
    assert dropped > 0 and cached > 0


def test_the_pool_gives_away_the_least_recently_used(device: str):
    """Three places of one block each, and rows for two: what was seen last is still there, what is seen never goes."""
    position = np.array([[1.0, 1.0, 1.0], [101.0, 1.0, 1.0], [201.0, 1.0, 1.0]])

    def cached(stops: str, rows: int) -> list[int]:
        volume = _volume(position, device, ratios=(1,), side=2, budget=1, rows=rows)
        stats = [volume.update(position["abc".index(stop)]) for stop in stops]
        assert all(s.left == 0 and s.cached + s.updated == 1 for s in stats)
        return [s.cached for s in stats]

    assert cached("abab", 1) == [0, 0, 0, 0]
    assert cached("abab", 2) == [0, 0, 1, 1]
    assert cached("abacab", 2) == [0, 0, 1, 0, 1, 0]


def test_a_pool_too_small_keeps_what_it_has(device: str):
    """The nearest blocks fill it; the others wait, and nothing that is seen is taken away."""
    position = _surface(200)
    volume = _volume(position, device, budget=8, rows=40)
    stats = [volume.update([0.0, 1.0, 0.0]) for _ in range(30)]
    there = _there(volume)
    assert len(there) == 40 and stats[-1].left == len(_names(position, volume)) - 40 and stats[-1].updated == 0
    assert settle(volume, np.array([0.0, 1.0, 0.0])) > 1  # gives up
    for got, want in zip(_there(volume).items(), there.items(), strict=True):
        assert got[0] == want[0] and (got[1] == want[1]).all()


def test_far_from_the_origin(device: str):
    """A million metres out it has the same blocks and reads the same."""
    position = np.round(_surface(400) * 1024) / 1024  # exact there too
    light = StoredLight(_field(position), device)
    near, far = (Volume(place, light, block=2.0, side=SIDE, budget=1024) for place in (position, position + FAR))
    viewpoint = np.array([2.125, 1.5, -3.25])
    settle(near, viewpoint)
    settle(far, viewpoint + FAR)
    _same(far, near)
    np.testing.assert_array_equal(far.base - near.base, FAR / np.array(near.sizes)[:, None])
    points = viewpoint + np.random.default_rng(7).integers(-4096, 4096, (300, 3)) / 128
    got, want = far.read(points + FAR), near.read(points)
    np.testing.assert_allclose(got.values, want.values, atol=1e-6)
    assert (want.level >= 0).mean() > 0.3


def test_one_probe(device: str):
    """Its light at every level, all round it."""
    place = np.array([[11.0, -3.0, 5.0]])
    volume = _volume(place, device)
    viewpoint = np.array([10.0, 0.0, 0.0])
    stats = volume.update(viewpoint)
    # It lies at a centre, on two faces' middles, and so on: 1, 8, 8 and 8 blocks, less those of too small a share.
    assert stats.updated == stats.probes == len(_names(place, volume)) and stats.left == 0
    viewpoint += 100.0  # the volume keeps its own
    points = np.concatenate([place, place + 15.0, place + 1000.0])
    reading = volume.read(points)
    assert volume.update([10.3, 0.2, -0.4]).entered == 0
    np.testing.assert_allclose(volume.read(points).weight, reading.weight, atol=1e-6)  # seen from elsewhere
    np.testing.assert_allclose(reading.values[:2], np.repeat(_field(place), 2, 0), rtol=5e-4)
    assert volume.memory_bytes == sum(volume.memory.values()) <= 64_000
    assert reading.level.tolist() == [0, 3, -1] and reading.weight[0] == 1.0 and 0.0 < reading.weight[1] < 1.0
    assert reading.weight[2] == 0.0 and not reading.values[2].any()


def test_memory_follows_the_scene(device: str):
    """At most 1 MB for 2,001 probes of 216 kB on a floor, and windows as flat as the floor."""
    position = np.random.default_rng(0).uniform(0, 50, (2001, 3)) * [1, 0, 1]
    volume = Volume(position, StoredLight(np.ones((2001, 27)), device), normal=np.tile([0.0, 1.0, 0.0], (2001, 1)))
    assert volume.memory_bytes <= 1_000_000 and volume.sides[:, 1].tolist() == [2, 2, 2, 2]
    assert volume.memory.keys() == {"index", "page table", "pool", "work"}


def test_light_of_any_range(device: str):
    """Numbers keep 11 bits, however bright or dark their block is; a light that is NaN reads as NaN."""
    for scale in (0.0, 1e-20, 1.0, 1e12):
        place = np.array([[1.0, 1.0, 1.0]])
        light = np.array([[1.0, -0.3, 1e-6]]) * scale
        volume = Volume(place, StoredLight(light, device))
        volume.update(place[0])
        np.testing.assert_allclose(volume.read(place).values, light, rtol=5e-4)
    volume.light._values.fill_(float("nan"))
    fresh = Volume(place, volume.light)
    fresh.update(place[0])
    assert np.isnan(fresh.read(place).values).all()


def test_outside_the_scene_the_windows_stay_on_it(device: str):
    """A viewer above or beside the probes has the blocks nearest to the viewer, and far from all the coarsest."""
    position = _surface()
    volume = _volume(position, device)
    for viewpoint in ([0.0, 500.0, 0.0], [-1e5, 4.0, 1e5]):
        settle(volume, viewpoint)
        assert set(_there(volume)) == _names(position, volume)
        reading = volume.read(position)
        assert (reading.level >= 0).all() and {0, 3} <= set(reading.level.tolist())


@pytest.mark.parametrize("kind", ["dead", "none"])
def test_nothing_to_see(device: str, kind: str):
    """A scene of dead probes, and one without any."""
    position = np.zeros((0, 3)) if kind == "none" else _surface(50)
    live = np.zeros(len(position), bool) if kind == "dead" else None
    volume = _volume(position, device, live=live)
    stats = volume.update([0.0, 0.0, 0.0])
    assert stats.entered == 4
    assert (stats.queued, stats.updated, stats.left, stats.probes) == (0, 0, 0, 0)
    reading = volume.read(_surface(50))
    assert not reading.values.any() and not reading.weight.any() and (reading.level == -1).all()


def test_dead_probes_are_left_out(device: str):
    position = _surface(500)
    live = np.arange(500) % 3 > 0
    volumes = [_volume(position, device, live=live), _volume(position[live], device)]
    for volume in volumes:
        settle(volume, np.zeros(3))
    _same(*volumes)


@pytest.mark.parametrize(
    "viewpoint",
    [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0], 3.0, [3e9, 0.0, 0.0]],
    ids=["nan", "inf", "two", "one", "far"],
)
def test_a_wrong_viewpoint_changes_nothing(viewpoint: object):
    volume = _volume(_surface(100), budget=1024)
    volume.update([0.0, 0.0, 0.0])
    points = _surface(100)
    before = volume.read(points).values
    assert "viewpoint: expected" in error_of(volume.update, viewpoint)
    np.testing.assert_array_equal(volume.read(points).values, before)
    assert volume.update([0.0, 0.0, 0.0]).entered == 0


@pytest.mark.parametrize(
    "settings",
    [
        {"block": 0.0},
        {"ratios": ()},
        {"ratios": (1, 3)},
        {"ratios": (1, 2, 2)},
        {"side": 3},
        {"budget": 0},
        {"rows": 63},
        {"tolerance": 12.5},
        {"tolerance": math.nan},
    ],
)
def test_wrong_settings(settings: dict):
    assert f"volume {next(iter(settings))}" in error_of(_volume, _surface(10), **settings)


def test_wrong_arrays():
    position = _surface(10)
    for live in (np.ones(9, bool), np.ones(10), np.ones((10, 1), bool)):
        assert "live" in misuse_of(_volume, position, live=live)
    assert "position: expected [10, 3]" in misuse_of(Volume, position[1:], StoredLight(_field(position)))
    with pytest.raises(WlmError, match="probe 4: expected finite"):
        StoredLight(np.where(np.arange(10)[:, None] == 4, np.nan, _field(position)))
    volume = _volume(position)
    assert "a call of `update` before" in misuse_of(volume.read, position)
    volume.update([0.0, 0.0, 0.0])
    assert "read" in misuse_of(volume.read, position[0])
    assert volume.read(np.zeros((0, 3))).values.shape == (0, 5)


@pytest.fixture(scope="module")
def volume() -> Volume:
    """Half done, so that there are holes, far from the origin, on both sides of a block's number 0."""
    random = np.random.default_rng(0)
    position = random.uniform(-1, 1, (400, 3)) * [9.0, 1.0, 9.0] + [4000.0, -30.0, 0.0]
    made = Volume(position, StoredLight(random.normal(size=(400, 27))), side=8, budget=40)
    for _ in range(6):
        made.update([4000.3, -29.0, 0.2])
    return made


def test_export_of_nothing_and_over_another(volume, tmp_path):
    nothing = Volume(volume.position, volume.light, side=8)
    with pytest.raises(ValueError, match="viewpoint"):
        _ = nothing.viewpoint
    assert "no block" in error_of(volume_bundle, nothing)
    paths = export(volume_bundle(volume), tmp_path / "out")
    assert [path.exists() for path in paths] == [True] * 8 and export(volume_bundle(volume), tmp_path / "out") == paths
    document, arrays = read_export(tmp_path / "out")
    pages, rows = arrays["pages"].view("<i2"), arrays["pool"].reshape(-1, 15)
    pool = rows[:, :1].view("<f4") * rows[:, 1:].copy().view("<f2")[:, :27]
    values, valid = _unscroll(volume)
    first = 0
    for level, described in enumerate(document["levels"]):
        place, sides = np.argwhere(valid[level]), np.array(described["sides"])
        block = (place + np.array(described["base"]) - np.array(described["start"], int)) % sides
        own = pages[first + np.ravel_multi_index(tuple(block.T), tuple(sides))]
        np.testing.assert_array_equal(pool[own], values[level][tuple(place.T)])
        first += sides.prod()
    assert (pages >= 0).sum() == sum(level.sum() for level in valid) == len(pool)
    (tmp_path / "out" / "bundle.json").write_text("{}")
    with pytest.raises(WlmError):
        export(volume_bundle(volume), tmp_path / "out")


def _hills(count: int = 900) -> np.ndarray:
    """Probes on rolling ground, 80 m by 60 m."""
    random = np.random.default_rng(0)
    x, z = random.uniform(-40, 40, count), random.uniform(-30, 30, count)
    return np.stack([x, _ground(x, z), z], 1)


def _ground(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    return 5.0 + 2.0 * np.sin(x / 20.0) + z / 15.0


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
        assert "camera path: expected at least" in error_of(camera_path, position, frames)
    for position, up in [(place[0], 1), (place, 3)]:
        assert "camera path" in misuse_of(camera_path, position, 5, up=up)


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
    original = _field(position) + np.random.default_rng(1).normal(size=(len(position), 5)).astype(np.float32) / 10
    volume = _volume(position, device, side=16, live=live, budget=40)
    reports = []
    path = _line(12, 1.0)
    figures = walk(volume, path, original, samples=60, progress=reports.append)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert (reports[-1].done, reports[-1].total, figures["frames"]) == (12, 12, 12)
    assert figures["updated"]["max"] == 40 and figures["left"]["max"] > 0 and figures["update_ms"]["mean"] > 0.0
    assert 0.0 < figures["coverage"]["min"] <= figures["coverage"]["mean"] <= 1.0
    # The last frame again, with all probes as samples.
    last = walk(volume, path[-1:], original, samples=10**6)
    low = 2.0 * volume.base[0]
    inside = ((position > low) & (position < low + 2.0 * volume.sides[0])).all(1)
    near, far = np.flatnonzero(live & inside), np.flatnonzero(live & ~inside)
    reading, light, peak = volume.read(position[near]), _field(position[near]), np.ptp(original)

    def rms(values: np.ndarray) -> float:
        return float(np.sqrt((values.astype(np.float64) ** 2).mean()))

    assert last["rmse"]["mean"] == pytest.approx(rms(reading.values - light))
    assert last["rms"]["max"] == pytest.approx(rms(light))
    assert last["coverage"]["mean"] == pytest.approx((reading.level >= 0).mean())
    errors = {"psnr": reading.values - original[near], "light_psnr": light - original[near]}
    errors["far_psnr"] = volume.read(position[far]).values - original[far]
    for name, error in errors.items():
        assert last[name] == pytest.approx(20.0 * np.log10(peak / rms(error)))


def test_a_walk_where_no_probe_is():
    """Frames without a near sample have no coverage and no error: here between two hills."""
    position = np.concatenate([_hills(), _hills() + [1000.0, 0.0, 0.0]])
    volume, light = _volume(position, side=16, budget=1024), _field(position)
    between = _line(2, 1.0) + [500.0, 0.0, 0.0]
    figures = walk(volume, between, light)
    assert json.loads(json.dumps(figures, allow_nan=False)) == figures
    assert all(figures[key] is None for key in ("coverage", "rmse", "rms", "psnr", "light_psnr"))
    there = walk(volume, _line(1, 0.0), light)
    again = walk(volume, np.concatenate([between, _line(1, 0.0)]), light)
    assert again["rmse"]["mean"] == there["rmse"]["mean"]


def test_walk_refuses():
    volume, light = _volume(_hills(50), side=16), _field(_hills(50))
    for path, options in [(np.zeros(3), {}), (np.zeros((0, 3)), {}), (_line(1, 0.0), {"samples": 0})]:
        assert "walk: expected" in misuse_of(walk, volume, path, light, **options)
    assert "original" in misuse_of(walk, volume, _line(1, 0.0), light[1:])
    assert "viewpoint" in error_of(walk, volume, np.array([[0.0, np.nan, 0.0]]), light)


def _cells(key: np.ndarray) -> np.ndarray:
    """The cells of Morton keys, bit by bit."""
    bits = (key[:, None, None] >> (3 * np.arange(21)[:, None] + np.arange(3))) & 1
    return (bits << np.arange(21)[:, None]).sum(1)


@pytest.mark.parametrize(
    ("scale", "origin", "side"),
    [
        (10, 0, 2.0),
        (10, 0, 0.3),  # no power of two
        (1e3, 1e6, 8.0),
        (1e-3, 1e6, 1e-3),
        (1e12, 0, 1e-3),  # more cells than a key has
        (1e99, 0, 1.0),
        (1, 1e15, 1e-300),  # cells below float64's resolution
        (0, 7, 2.0),  # all probes in one place
    ],
)
def test_places_and_blocks_by_brute_force(scale: float, origin: float, side: float):
    position = np.random.default_rng(1).uniform(-1, 1, (60, 3)) * scale + origin
    index = BlockIndex(position, side, (1, 2, 16))
    assert index.sizes[0] >= side and index.sizes[2] == 16 * index.sizes[0]
    assert (np.diff(index.key) >= 0).all() and sorted(index.number) == list(range(60))
    cell = index.sizes[0] / 2
    place = (index.start[0] * 2 + _cells(index.key) + index.place) * cell
    np.testing.assert_allclose(place, position[index.number], atol=1e-6 * cell + 1e-15 * abs(origin))
    for level, size in enumerate(index.sizes):
        keys = index.block[index.level_start[level] : index.level_start[level + 1]]
        assert (np.diff(keys) > 0).all()
        cells = _cells(keys)
        assert (cells.min(0) == index.low[level]).all() and (cells.max(0) == index.high[level]).all()
        got = {tuple(b) for b in (cells + index.start[level]).astype(int).tolist()}
        want = volume_blocks.blocks(position, size)
        # Rounded in another order, a share may be a tenth or not.
        assert len(got ^ want) <= 0.01 * len(want)


def test_no_probe_and_coincident_ones():
    empty = BlockIndex(np.zeros((0, 3)), 1.0, (1, 4))
    assert empty.count == 0 and len(empty.block) == 0 and empty.level_start.tolist() == [0, 0, 0]
    assert len(BlockIndex(np.full((7, 3), 0.5), 1.0, (1,)).block) == 1  # at its centre, that block alone


def test_side_follows_the_spacing():
    random = np.random.default_rng(0)
    plane = np.stack([*random.uniform(0, 30, (2, 900)), np.zeros(900)], 1)
    side = finest_side(plane)
    assert 0.3 < side < 1.3 and finest_side(plane * 1e-9 + 5.0) == pytest.approx(side * 1e-9, rel=0.26)
    lattice = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    # Fewer blocks than probes could not tell them apart.
    assert len(BlockIndex(lattice, finest_side(lattice), (1,)).block) >= 2 * len(lattice)
    assert finest_side(np.zeros((0, 3))) == finest_side(np.ones((5, 3))) == 1.0
    for position in (np.array([[0, np.nan, 0]]), np.full((1, 3), 1e101)):
        assert "position: expected probes" in misuse_of(BlockIndex, position, 1.0, (1,))
    assert "positions: expected distances" in error_of(finest_side, np.array([[0.0, 0.0, 0.0], [1e300, 1e300, 1e300]]))
