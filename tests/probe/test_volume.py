"""The cascaded lighting volume and its index, against what they must hold."""

import itertools
import math

import numpy as np
import pytest
from reference import volume as reference

from wlm.errors import WlmError
from wlm.probe.index import ProbeIndex
from wlm.probe.volume import SIDE, SIZES, FrameStats, Volume

# A multiple of every block's side, so that all of a scene can move by it.
FAR = np.array([1_000_000.0, -1_000_000.0, 3_200_000.0])


class Field:
    """A smooth light with a number for each place, and a record of what was asked."""

    def __init__(self, channels: int = 5, origin: np.ndarray | float = 0.0):
        random = np.random.default_rng(channels)
        self.slope, self.phase = random.normal(size=(3, channels)) / 8, random.uniform(0, 6, channels)
        self.origin = origin
        self.asked: list[np.ndarray] = []

    def __call__(self, position: np.ndarray) -> np.ndarray:
        self.asked.append(position.copy())
        return np.sin((position - self.origin) @ self.slope + self.phase).astype(np.float32)


def _surface(count: int = 1500, seed: int = 0) -> np.ndarray:
    """Probes on two floors and a wall of a scene 120 m wide."""
    random = np.random.default_rng(seed)
    x, z = random.uniform(-60, 60, (2, count))
    kind = random.integers(0, 3, count)
    floor = np.stack([x, 0.5 * np.sin(x / 5), z], 1)
    upper = np.stack([x / 2, np.full(count, 9.0), z / 2], 1)
    wall = np.stack([np.full(count, 20.3), np.abs(x) / 4, z], 1)
    return np.where((kind == 0)[:, None], floor, np.where((kind == 1)[:, None], upper, wall))


def _names(position: np.ndarray, volume: Volume) -> set[tuple[int, int, int, int]]:
    """(level, x, y, z) of the blocks of the windows that hold a probe, one probe at a time."""
    names = set()
    for level, size in enumerate(volume.sizes):
        base = volume.base[level]
        for block in np.floor(position / size).astype(int):
            if ((block >= base) & (block < base + volume.side)).all():
                names.add((level, *block.tolist()))
    return names


def _there(volume: Volume) -> dict[tuple[int, int, int, int], np.ndarray]:
    """The blocks that can be read, by name."""
    values, valid = volume.unscroll()
    assert not values[~valid].any()
    return {(int(i[0]), *(i[1:] + volume.base[i[0]]).tolist()): values[tuple(i)] for i in np.argwhere(valid)}


def _value(name: tuple[int, ...], position: np.ndarray, volume: Volume, field: Field) -> np.ndarray:
    """A block's light by the stated formula."""
    size = volume.sizes[name[0]]
    inside = position[(np.floor(position / size) == name[1:]).all(1)]
    weight = 1.0 / (((inside - (np.array(name[1:]) + 0.5) * size) ** 2).sum(1) + (size / 4) ** 2)
    return weight @ field(inside).astype(np.float64) / weight.sum()


def _settle(volume: Volume, viewpoint: object) -> list[FrameStats]:
    """Updates until nothing is left to do."""
    frames = [volume.update(viewpoint)]
    while frames[-1].left:
        frames.append(volume.update(viewpoint))
        assert len(frames) < 10_000
    return frames


def _check_query(position: np.ndarray, low: np.ndarray, high: np.ndarray, cell: float | None) -> int:
    probes, offsets = ProbeIndex(position, cell).query(low, high)
    assert offsets.shape == (len(low) + 1,) and offsets[0] == 0 and offsets[-1] == len(probes)
    for i in range(len(low)):
        want = np.flatnonzero(((position >= low[i]) & (position < high[i])).all(1))
        np.testing.assert_array_equal(np.sort(probes[offsets[i] : offsets[i + 1]]), want)
    return len(probes)


@pytest.mark.parametrize(
    ("scale", "origin", "cell"),
    [
        (10, 0, None),
        (10, 0, 2.0),
        (10, 0, 0.1),  # no power of two
        (1e3, 1e6, 2.0),
        (1e-3, 1e6, None),
        (1e12, 0, 1e-3),  # more cells than a key has
        (1e99, 0, 1.0),
        (1, 1e15, 1e-300),  # cells below float64's resolution
        (1, 0, 5e-324),
        (1, 0, 1e300),
        (0, 7, 2.0),  # all probes in one place
    ],
)
def test_index_against_brute_force(scale: float, origin: float, cell: float | None):
    """Boxes of all sizes, with corners on probes, empty ones, inverted ones, endless ones."""
    random = np.random.default_rng(1)
    position = random.uniform(-1, 1, (300, 3)) * scale + origin
    low = random.uniform(-1.3, 1.3, (200, 3)) * scale + origin
    high = low + random.uniform(0, 0.8, (200, 3)) ** 2 * scale
    low[:50], high[50:100] = position[:50], position[50:100]
    high[100:105] = low[100:105]
    high[105:110] = low[105:110] - scale
    low[110], high[110] = -np.inf, np.inf
    low[111], high[111] = position[0], np.nextafter(position[0], np.inf)
    assert _check_query(position, low, high, cell) > 300


def test_index_of_blocks():
    """The grid's own blocks part the probes: each lies in one block of each size, also where rounding bites."""
    position = _surface(800)
    position[:100] = np.floor(position[:100] / 0.3) * 0.3  # on corners, as computed in float64
    for size in (0.3, 2.0, 3.0, 8.0):
        block = np.unique(np.floor(position / size), axis=0)
        around = np.array(list(itertools.product((-1, 0, 1), repeat=3)))
        block = np.unique((block[:, None] + around).reshape(-1, 3), axis=0)
        probes, offsets = ProbeIndex(position, 0.3).query(block * size, (block + 1) * size)
        np.testing.assert_array_equal(np.sort(probes), np.arange(len(position)))
        assert (np.diff(offsets) == 0).any()


@pytest.mark.parametrize("position", [np.zeros((0, 3)), np.full((1, 3), 5.0), np.full((7, 3), -0.0)])
def test_index_of_few(position: np.ndarray):
    """No probe, one, and coincident ones."""
    low = np.array([[0.0, 0.0, 0.0], [5.0, 5.0, 5.0], [-9.0, -9.0, -9.0], [1.0, 1.0, 1.0]])
    _check_query(position, low, low + [[1.0], [1.0], [np.inf], [-1.0]], None)
    assert _check_query(position, np.zeros((0, 3)), np.zeros((0, 3)), 1.0) == 0


def test_index_refuses():
    good = np.zeros((2, 3))
    for position, cell in [(np.zeros(3), 1), (np.array([[0, np.nan, 0]]), 1), (np.full((1, 3), 1e101), 1), (good, 0)]:
        with pytest.raises(ValueError, match="position|cell"):
            ProbeIndex(position, cell)
    index = ProbeIndex(good)
    for low, high in [(good, good[:1]), (np.zeros(3), np.ones(3)), (good * np.nan, good)]:
        with pytest.raises(ValueError, match="boxes"):
            index.query(low, high)


@pytest.mark.parametrize("budget", [1, 64, 10**6])
def test_teleport_converges_in_the_frames_of_the_budget(device: str, budget: int):
    """ceil(blocks with a probe / budget) frames, each full but the last; empty blocks cost nothing."""
    position = _surface(600)
    volume = Volume(position, Field(), 5, budget=budget, device=device)
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


def test_nearest_blocks_first():
    """By the distance in sides of their own; the finest of two alike."""
    position = _surface()
    viewpoint = np.array([3.0, 1.0, -5.0])
    volume = Volume(position, Field(), 5, budget=50)
    volume.update(viewpoint)

    def rank(name: tuple[int, ...]) -> tuple[float, int]:
        away = np.array(name[1:]) + 0.5 - viewpoint / volume.sizes[name[0]]
        return float((away**2).sum()), name[0]

    ranks = sorted(rank(name) for name in _names(position, volume))
    assert sorted(rank(name) for name in _there(volume)) == ranks[:50]
    assert {level for _, level in ranks[:50]} == {0, 1, 2, 3}


def test_blocks_have_the_stated_light(device: str):
    position, field = _surface(600), Field()
    volume = Volume(position, field, 5, budget=10**6, probes=None, device=device)
    stats = volume.update([1.0, 2.0, 3.0])
    asked = field.asked[0]
    assert stats.probes == len(asked) == len(np.unique(asked, axis=0)) == len(position)  # each once for four levels
    there = _there(volume)
    assert {name[0] for name in there} == {0, 1, 2, 3}
    for name, value in there.items():
        np.testing.assert_allclose(value, _value(name, position, volume, field), atol=2e-6)


def test_thinned_blocks():
    """At most so many probes a block, spread over all of it; small blocks are not touched."""
    position, field = np.random.default_rng(2).uniform(0, 32, (20000, 3)), Field()
    exact = Volume(position, field, 5, sizes=(1.0, 32.0), budget=10**6, probes=None)
    exact.update([16.0, 16.0, 16.0])
    volume = Volume(position, field, 5, sizes=(1.0, 32.0), budget=10**6, probes=64)
    volume.update([16.0, 16.0, 16.0])
    got, want = _there(volume), _there(exact)
    assert set(got) == set(want) and len(got) > 1000
    assert 0.0 < np.abs(got[1, 0, 0, 0] - want[1, 0, 0, 0]).max() < 0.2
    small = [name for name in got if name[0] == 0]
    np.testing.assert_array_equal([got[name] for name in small], [want[name] for name in small])
    single = Volume(position, field, 5, sizes=(32.0,), probes=64)
    assert single.update([16.0, 16.0, 16.0]).probes == 64
    spread = field.asked[-1]
    assert np.ptp(spread, axis=0).min() > 24 and np.abs(spread.mean(0) - 16).max() < 4


def test_one_step_rewrites_one_slab():
    """A step of a block's side along one axis: 16 x 16 blocks enter at the finest level, and no other block is made."""
    position, field = _surface(), Field()
    volume = Volume(position, field, 5)
    _settle(volume, [0.0, 0.0, 0.0])
    before = _there(volume)
    field.asked.clear()
    stats = volume.update([2.0, 0.0, 0.0])
    assert stats.entered == SIDE**2 + SIDE**2  # and a step of the second level, whose window turns at half its side
    after = _there(volume)
    new = set(after) - set(before)
    assert len(new) == stats.updated > 0 and {name[0] for name in new} <= {0, 1}
    assert {name[1] for name in new if name[0] == 0} == {8}
    gone = set(before) - set(after)
    assert {name[1] for name in gone if name[0] == 0} == {-8}
    for name in set(before) & set(after):
        np.testing.assert_array_equal(before[name], after[name])


def test_any_way_leads_to_the_same_volume(device: str):
    """After a walk with jumps, once settled, it equals one that starts there, bit for bit."""
    position = _surface()
    walked = Volume(position, Field(), 5, cache=300, device=device)
    random = np.random.default_rng(5)
    viewpoint = np.zeros(3)
    for step in range(60):
        viewpoint = random.uniform(-50, 50, 3) if step % 15 == 14 else viewpoint + random.normal(size=3) * 2
        walked.update(viewpoint)
    _settle(walked, viewpoint)
    fresh = Volume(position, Field(), 5, device=device)
    _settle(fresh, viewpoint)
    for got, want in zip(walked.unscroll(), fresh.unscroll(), strict=True):
        np.testing.assert_array_equal(got, want)
    points = viewpoint + random.uniform(-70, 70, (500, 3))
    np.testing.assert_array_equal(walked.read(points).values, fresh.read(points).values)


def test_no_read_of_a_block_that_is_not_there(device: str):
    """In every frame of a hurried walk what is there lies in the windows and is right, and a read takes that alone."""
    position, field = _surface(600), Field()
    volume = Volume(position, field, 5, budget=5, cache=100, probes=None, device=device)
    truth: dict[tuple[int, ...], np.ndarray] = {}
    random = np.random.default_rng(6)
    viewpoint, dropped = np.array([0.0, 1.0, 0.0]), 0
    for step in range(24):
        viewpoint = random.uniform(-50, 50, 3) if step % 8 == 7 else viewpoint + random.normal(size=3) * [4, 1, 4]
        stats = volume.update(viewpoint)
        dropped += stats.dropped
        there = _there(volume)
        names = _names(position, volume)
        assert set(there) <= names and len(names - set(there)) == stats.left > 0
        for name, value in there.items():
            if name not in truth:
                truth[name] = _value(name, position, volume, field)
            np.testing.assert_allclose(value, truth[name], atol=2e-6)
        points = viewpoint + random.uniform(-1, 1, (20, 3)) * np.repeat([3.0, 20.0], 10)[:, None]
        reading = volume.read(points)
        want, shares = reference.read(there, volume.base, volume.sizes, SIDE, points, 5)
        np.testing.assert_allclose(reading.weight, shares.sum(1), atol=1e-5)
        np.testing.assert_allclose(reading.values * reading.weight[:, None], want * shares.sum(1)[:, None], atol=1e-4)
    assert dropped > 0


def test_queue_of_a_place_that_was_left():
    """What waited there is dropped; what was done there comes back without decoding."""
    position, field = _surface(), Field()
    volume = Volume(position, field, 5)
    first = volume.update([0.0, 1.0, 0.0])
    away = volume.update([5000.0, 1.0, 0.0])
    assert away.dropped == first.left > 0 and (away.left, away.queued, away.updated) == (0, 0, 0)
    field.asked.clear()
    back = volume.update([0.0, 1.0, 0.0])
    # The empty blocks far out were never written over what the slots held.
    assert back.queued == first.queued - 64 and back.cached == 0 and back.left == first.left - 64


def test_oscillation_costs_no_decode():
    """To and fro over the border of a block: after one cycle, nothing is decoded and nothing waits."""
    position, field = _surface(), Field()
    volume = Volume(position, field, 5)
    ends = ([0.9, 1.0, 0.9], [1.1, 1.0, 1.1])
    for end in ends:
        _settle(volume, end)
    field.asked.clear()
    stats = [volume.update(ends[i % 2]) for i in range(40)]
    assert not field.asked and sum(s.cached for s in stats) > 0
    assert all((s.left, s.updated, s.queued, s.dropped) == (0, 0, 0, 0) for s in stats)


def _tour(cache: int, stops: list[str]) -> list[int]:
    """Blocks that come from the cache at each stop; b leaves the block of a in the window, c takes its slot."""
    probes = np.array([[1.0, 1.0, 1.0], [3.0, 1.0, 1.0], [33.0, 1.0, 1.0]])
    volume = Volume(probes, Field(), 5, sizes=(2.0,), side=2, cache=cache)
    along = {"a": 0.0, "b": 2.0, "c": 32.0, "d": 64.0}
    stats = [volume.update([along[stop], 0.0, 0.0]) for stop in stops]
    assert sum(s.updated for s in stats) == sum(s.probes for s in stats) == sum(s.queued for s in stats)
    return [s.cached for s in stats]


def test_cache_keeps_the_latest():
    assert _tour(0, ["a", "c", "a", "c"]) == [0, 0, 0, 0]
    assert _tour(1, ["a", "c", "a", "c"]) == [0, 0, 0, 0]
    assert _tour(2, ["a", "c", "a", "c"]) == [0, 0, 1, 1]
    # a's block, made first, was in use until the viewer left for c: the one that only b shows gives way.
    assert _tour(2, ["a", "b", "a", "c", "a"]) == [0, 0, 0, 0, 1]
    # What a slot still holds costs nothing at all: nothing lies round d.
    assert _tour(0, ["a", "d", "a"]) == [0, 0, 0]


def test_far_from_the_origin(device: str):
    """A million metres out it has the same blocks and reads the same."""
    position = np.round(_surface(400) * 1024) / 1024  # exact there too
    near = Volume(position, Field(), 5, budget=10**6, device=device)
    far = Volume(position + FAR, Field(origin=FAR), 5, budget=10**6, device=device)
    viewpoint = np.array([2.125, 1.5, -3.25])
    near.update(viewpoint)
    far.update(viewpoint + FAR)
    for got, want in zip(far.unscroll(), near.unscroll(), strict=True):
        np.testing.assert_allclose(got, want, atol=1e-6)
    np.testing.assert_array_equal(far.base - near.base, FAR / np.array(SIZES)[:, None])
    points = viewpoint + np.random.default_rng(7).integers(-4096, 4096, (300, 3)) / 128
    got, want = far.read(points + FAR), near.read(points)
    np.testing.assert_allclose(got.values, want.values, atol=1e-6)
    assert (want.level >= 0).mean() > 0.5


def test_linear_light_is_read_exactly(device: str):
    """Probes at the finest centres: every block of every level has the field's value at its centre."""
    slope = np.random.default_rng(8).normal(size=(3, 27)) / 10
    lattice = np.array(list(itertools.product(np.arange(-15.0, 16.0, 2.0), repeat=3)))

    def decode(position: np.ndarray) -> np.ndarray:
        return (position @ slope).astype(np.float32)

    volume = Volume(lattice, decode, 27, sizes=(2.0, 4.0, 8.0), side=4, budget=10**6, probes=None, device=device)
    volume.update([0.3, -0.2, 0.1])
    points = np.random.default_rng(9).uniform(-1, 1, (900, 3)) * np.repeat([3.0, 6.0, 12.0], 300)[:, None]
    reading = volume.read(points)
    away = np.abs(points).max(1)
    for level, (first, last) in enumerate([(0, 3), (5, 6), (10, 12)]):
        alone = (away > first) & (away < last)
        assert (reading.level[alone] == level).all() and alone.sum() > 50
        np.testing.assert_allclose(reading.values[alone], points[alone] @ slope, atol=2e-6)


def test_one_probe(device: str):
    """One block a level, and their light all round the probe."""
    field = Field()
    place = np.array([[11.0, -3.0, 5.0]])
    volume = Volume(place, field, 5, device=device)
    viewpoint = np.array([10.0, 0.0, 0.0])
    stats = volume.update(viewpoint)
    assert (stats.updated, stats.probes, stats.left) == (4, 1, 0)
    viewpoint += 100.0  # the volume keeps its own
    points = np.concatenate([place, place + 15.0, place + 1000.0])
    reading = volume.read(points)
    assert volume.update([10.3, 0.2, -0.4]).entered == 0
    np.testing.assert_allclose(volume.read(points).weight, reading.weight, atol=1e-6)  # seen from elsewhere
    np.testing.assert_allclose(reading.values[:2], np.repeat(field(place), 2, 0), atol=1e-6)
    # Its centre is the finest block's own; 15 m further only the coarsest reaches.
    assert reading.level.tolist() == [0, 3, -1] and reading.weight[0] == 1.0 and 0.0 < reading.weight[1] < 1.0
    assert reading.weight[2] == 0.0 and not reading.values[2].any()


@pytest.mark.parametrize("kind", ["outside", "dead", "none"])
def test_nothing_to_see(device: str, kind: str):
    """A viewer outside of the scene, a scene of dead probes, and one without any."""
    field = Field()
    position = np.zeros((0, 3)) if kind == "none" else _surface(50)
    live = np.zeros(len(position), bool) if kind == "dead" else None
    volume = Volume(position, field, 5, live=live, device=device)
    stats = volume.update([1e5, 0.0, 0.0] if kind == "outside" else [0.0, 0.0, 0.0])
    assert stats.entered == 4 * SIDE**3
    assert (stats.queued, stats.updated, stats.left, stats.probes) == (0, 0, 0, 0) and not field.asked
    reading = volume.read(_surface(50))
    assert not reading.values.any() and not reading.weight.any() and (reading.level == -1).all()


def test_dead_probes_are_left_out():
    position, field = _surface(500), Field()
    live = np.arange(500) % 3 > 0
    volume = Volume(position, field, 5, live=live, budget=10**6)
    volume.update([0.0, 0.0, 0.0])
    only = Volume(position[live], field, 5, budget=10**6)
    only.update([0.0, 0.0, 0.0])
    for got, want in zip(volume.unscroll(), only.unscroll(), strict=True):
        np.testing.assert_array_equal(got, want)
    assert len(volume.position) == live.sum()


def test_coincident_probes_count_alike():
    place = np.array([[1.0, 1.0, 1.0]] * 3)
    values = iter([1.0, 2.0, 6.0])
    volume = Volume(place, lambda p: np.array([[next(values)] for _ in p], np.float32), 1)
    volume.update([0.0, 0.0, 0.0])
    assert volume.read(place[:1]).values[0, 0] == pytest.approx(3.0)


def test_scale_is_a_change_of_unit():
    position = _surface(300)
    metres, small = Volume(position, Field(), 5), Volume(position / 32, Field(), 5, scale=1 / 32)
    metres.update([1.0, 2.0, 3.0])
    small.update(np.array([1.0, 2.0, 3.0]) / 32)
    np.testing.assert_array_equal(metres.unscroll()[1], small.unscroll()[1])


@pytest.mark.parametrize(
    "viewpoint",
    [[np.nan, 0.0, 0.0], [0.0, np.inf, 0.0], [0.0, 0.0], 3.0, [3e9, 0.0, 0.0]],
    ids=["nan", "inf", "two", "one", "far"],
)
def test_a_wrong_viewpoint_changes_nothing(viewpoint: object):
    volume = Volume(_surface(100), Field(), 5, budget=10**6)
    volume.update([0.0, 0.0, 0.0])
    points = _surface(100)
    before = volume.read(points).values
    with pytest.raises(WlmError, match="viewpoint: expected") as caught:
        volume.update(viewpoint)
    assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(volume.read(points).values, before)
    assert volume.update([0.0, 0.0, 0.0]).entered == 0


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"sizes": ()}, "sizes"),
        ({"sizes": (2.0, 2.0)}, "sizes"),
        ({"sizes": (4.0, 2.0)}, "sizes"),
        ({"sizes": (0.0, 2.0)}, "sizes"),
        ({"sizes": (1.0, np.nan)}, "sizes"),
        ({"scale": 0.0}, "sizes"),
        ({"scale": np.inf}, "sizes"),
        ({"scale": 1e-40}, "sizes"),
        ({"side": 3}, "side"),
        ({"side": 0}, "side"),
        ({"side": 130}, "side"),
        ({"budget": 0}, "budget"),
        ({"probes": 0}, "probes"),
        ({"cache": -1}, "cache"),
        ({"device": "cuda:99"}, "device"),
    ],
)
def test_wrong_settings(settings: dict, word: str):
    with pytest.raises(WlmError, match=word) as caught:
        Volume(_surface(10), Field(), 5, **settings)
    assert "\n" not in str(caught.value)


def test_wrong_arrays():
    position = _surface(10)
    for live in (np.ones(9, bool), np.ones(10), np.ones((10, 1), bool)):
        with pytest.raises(ValueError, match="live"):
            Volume(position, Field(), 5, live=live)
    with pytest.raises(ValueError, match="channels"):
        Volume(position, Field(), 0)
    volume = Volume(position, Field(), 5)
    with pytest.raises(ValueError, match="after an update"):
        volume.read(position)
    volume.update([0.0, 0.0, 0.0])
    with pytest.raises(ValueError, match="read"):
        volume.read(position[0])
    assert volume.read(np.zeros((0, 3))).values.shape == (0, 5)


def test_a_decoder_that_fails_once():
    """Another shape or a NaN is refused; the blocks still wait, and the next frame makes them."""
    position, field = _surface(200), Field()
    answers = iter([lambda p: np.zeros((len(p), 4)), lambda p: np.full((len(p), 5), np.nan)])
    volume = Volume(position, lambda p: next(answers, field)(p), 5, budget=10**6)
    for message in ("expected \\(200, 5\\)", "finite"):
        with pytest.raises(ValueError, match=message):
            volume.update([0.0, 0.0, 0.0])
    assert volume.update([0.0, 0.0, 0.0]).updated == len(_there(volume)) == len(_names(position, volume))


def test_memory(device: str):
    """What the volume takes up: 4 windows of 16^3 blocks of 27 numbers and 3 coordinates, and its small tables."""
    volume = Volume(_surface(100), Field(27), 27, device=device)
    assert volume.memory_bytes == 4 * 16**3 * 4 * (27 + 3) + 4 * 4 * (3 + 4)
    empty = volume.host_bytes
    stats = volume.update([0.0, 0.0, 0.0])
    assert volume.host_bytes == empty + stats.updated * 27 * 4
