"""Blocks behind a page table: putting them in order, and reading the light at any point."""

import itertools

import numpy as np
import pytest
import warp as wp
from reference import volume as reference

from kernels.compare import array, close
from wlm_kernels.probe import volume

SIDES = np.array([[4, 4, 4], [3, 5, 4], [4, 4, 4]], np.int32)
SIDE = 4
SIZES = (0.5, 1.0, 4.0)
# Windows on both sides of 0, one across it, and one far out.
BASES = np.array([[-9, 3, -2], [-6, 0, -1], [1000000, -1000000, -2]], np.int32)


class Grid:
    """A volume on a device, and the same blocks by name."""

    def __init__(self, bases: np.ndarray, sizes: tuple[float, ...], sides: np.ndarray, channels: int, device: str):
        self.bases, self.sizes, self.sides, self.device = bases, np.array(sizes), sides, device
        self.blocks: dict[tuple[int, int, int, int], np.ndarray] = {}
        slots = int(sides.prod(1).sum())
        self.starts = np.cumsum(sides.prod(1)) - sides.prod(1)
        # Rows that no page names must not matter.
        self.pool, self.factor = np.zeros((slots, channels), np.int16), np.full(slots, np.nan, np.float32)
        self.pages = np.full(slots, -1, np.int16)

    def window(self, level: int) -> list[tuple[int, int, int, int]]:
        ranges = [range(first, first + side) for first, side in zip(self.bases[level], self.sides[level], strict=True)]
        return [(level, *block) for block in itertools.product(*ranges)]

    def slot(self, level: int, *block: int) -> int:
        x, y, z = np.array(block) % self.sides[level]
        return self.starts[level] + (x * self.sides[level][1] + y) * self.sides[level][2] + z

    def write(self, blocks: dict[tuple[int, int, int, int], np.ndarray]) -> None:
        """In rows of no order; a slot stands for the block of its level's window."""
        rows = np.random.default_rng(0).permutation(len(self.pool))
        for name, values in blocks.items():
            slot = self.slot(*name)
            row = self.pages[slot] = rows[slot]
            self.factor[row] = np.abs(values).max() / 1000
            halves = (values / max(self.factor[row], 1e-9)).astype(np.float16)
            self.pool[row] = halves.view(np.int16)
            self.blocks[name] = halves * np.float64(self.factor[row])

    def _arrays(self) -> list[wp.array]:
        kinds = {"pool": wp.int16, "factor": float, "pages": wp.int16, "starts": int, "sides": wp.vec3i}
        kinds |= {"bases": wp.vec3i}
        return [array(getattr(self, name), kind, self.device) for name, kind in kinds.items()]

    def read(self, points: np.ndarray, origin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """At points in float64."""
        place = origin / self.sizes[:, None] - self.bases - 0.5
        views = np.concatenate([place, 1.0 / self.sizes[:, None]], 1).astype(np.float32)
        out = array(np.full((len(points), self.pool.shape[1]), np.nan), float, self.device)
        level = wp.empty(len(points), dtype=int, device=self.device)
        weight = wp.empty(len(points), dtype=float, device=self.device)
        where = array((points - origin).astype(np.float32), wp.vec3, self.device)
        views = array(views, wp.vec4, self.device)
        ahead = wp.empty(0, dtype=wp.vec3, device=self.device)
        volume.read(*self._arrays(), views, where, ahead, out, level, weight)
        return out.numpy(), level.numpy(), weight.numpy()


def _filled(channels: int, device: str, share: float = 0.6, bases: np.ndarray = BASES) -> Grid:
    """A grid with a random share of its blocks."""
    random = np.random.default_rng(channels)
    grid = Grid(bases, SIZES, SIDES, channels, device)
    blocks = {}
    for level in range(len(SIZES)):
        for name in grid.window(level):
            if random.random() < share:
                blocks[name] = random.normal(size=channels)
    grid.write(blocks)
    return grid


def _near(grid: Grid, level: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in and round a level's window, and its middle; on centres, corners and sides of blocks too."""
    random = np.random.default_rng(level)
    size = grid.sizes[level]
    low = grid.bases[level] * size
    points = low + random.uniform(-1.5, SIDE + 1.5, (count, 3)) * size
    points[: count // 4] = low + random.integers(-2, 2 * SIDE + 2, (count // 4, 3)) * size / 2
    return points, low + SIDE / 2 * size


@pytest.mark.parametrize("channels", [1, 3, 8, 27])
def test_read_against_reference(device: str, channels: int):
    grid = _filled(channels, device)
    for level in range(len(SIZES)):
        points, origin = _near(grid, level, 200)
        got, answered, weight = grid.read(points, origin)
        want, shares = reference.read(grid.blocks, BASES, SIZES, SIDES, points, channels)
        covered = shares.sum(1)
        assert (covered > 0.0).any() and (covered == 0.0).any()
        close(weight, covered, 2e-6, "weight")
        # Divided by a small weight, a rounding of the place counts for more.
        close(got * covered[:, None], want * covered[:, None], 5e-6, "values")
        assert not got[covered == 0.0].any()
        first, second = np.sort(shares, 1)[:, -1], np.sort(shares, 1)[:, -2]
        clear = first - second > 1e-5
        np.testing.assert_array_equal(answered[clear], shares.argmax(1)[clear])
        np.testing.assert_array_equal(answered[covered == 0.0], -1)


def test_points_that_nothing_covers(device: str):
    """NaN, infinity and what is far outside are black, not an index out of range."""
    grid = _filled(3, device, share=1.0, bases=np.full((3, 3), -SIDE // 2, np.int32))
    points = np.array([[np.nan, 0, 0], [0, np.inf, 0], [0, 0, -np.inf], [3e38, 0, 0], [0, -1e20, 0], [11, 0, 0]])
    values, level, weight = grid.read(points, np.zeros(3))
    assert not values.any() and not weight.any() and (level == -1).all()
    assert grid.read(np.zeros((1, 3)), np.zeros(3))[2][0] == pytest.approx(1.0, abs=1e-6)
    assert grid.read(np.zeros((0, 3)), np.zeros(3))[0].shape == (0, 3)


def test_continuous_across_missing_blocks(device: str):
    """Over holes and borders of windows a small step never jumps, as long as some level has all."""
    bases = np.full((3, 3), -SIDE // 2, np.int32)
    grid = _filled(2, device, bases=bases)
    rest = {name: np.zeros(2) for name in grid.window(2) if name not in grid.blocks}
    grid.write(rest)
    way = np.linspace([-5.0, -1.0, -2.0], [5.0, 2.0, 1.5], 20001)
    values, level, weight = grid.read(way, np.zeros(3))
    close(weight, np.ones(len(way)), 1e-6, "weight")
    assert set(level) == {0, 1, 2}
    values_there = np.array([v for name, v in grid.blocks.items() if name in set(grid.window(name[0]))])
    # Each level's share and value change by at most 3 sides of difference per side of a block, in each axis.
    bound = 2 * np.ptp(values_there) * 3 * np.abs(np.diff(way, axis=0)).max() / min(SIZES) * 2
    assert np.abs(np.diff(values, axis=0)).max() < bound < 0.1 * np.ptp(values)
