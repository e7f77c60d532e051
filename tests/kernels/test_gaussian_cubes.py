"""The lists of Gaussians by cube: who is in them, that nobody is missing, and that they can always be made."""

import numpy as np
import pytest
import torch
import warp as wp
from reference import gaussians as reference

from benchmarks import plain
from kernels.compare import array
from wlm_kernels.probe import cubes as probe_cubes
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe.cubes import Cubes

CUT = 3.0
LOW, HIGH = [-0.2, 0.0, 0.1], [1.0, 0.7, 0.9]
LOOSE = 3e-4  # of a reach: what a list may hold beyond what meets its cube


def _gaussians(count: int, anisotropy: float, longest: float = 0.2, seed: int = 1) -> np.ndarray:
    """Rows with latents of 1, some of them centred outside of the grid."""
    random = np.random.default_rng(seed)
    rows = random.normal(size=(count, 11)).astype(np.float32)
    rows[:, :3] = LOW + (random.random((count, 3)) * 1.6 - 0.3) * (np.array(HIGH) - LOW)
    rows[:, 3:6] = np.log(longest) - np.log(anisotropy) * random.permuted(np.tile([1.0, 0.0, 0.4], (count, 1)), axis=1)
    return rows


def _shapes(rows: np.ndarray, device: str, support: str = "ellipsoid") -> wp.array:
    return gaussian_sum.shapes(array(rows, float, device), CUT, support)


def _lists(cubes: Cubes) -> list[np.ndarray]:
    start, item = cubes.start.numpy(), cubes.item.numpy()
    assert len(start) == np.prod([*cubes.counts]) + 1 and start[0] == 0 and start[-1] == len(item)
    return np.split(item, start[1:-1])


def _table(cubes: Cubes, gaussians: int) -> np.ndarray:
    """Who is listed where, bool [C, K]; the lists must rise."""
    table = np.zeros((len(cubes.start) - 1, gaussians), bool)
    for row, items in zip(table, _lists(cubes), strict=True):
        assert (np.diff(items) > 0).all()
        row[items] = True
    return table


def _boxes(cubes: Cubes) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corners [C, 3], infinite at the border."""
    counts = np.array([*cubes.counts])
    cell = np.stack(np.unravel_index(np.arange(counts.prod()), counts), 1)
    low = np.array([*cubes.low]) + cubes.size * cell
    return np.where(cell == 0, -np.inf, low), np.where(cell == counts - 1, np.inf, low + cubes.size)


def _distances(rows: np.ndarray, cubes: Cubes, support: str) -> np.ndarray:
    """Distance of each cube from each Gaussian, [C, K], in units of the size of its support."""
    low, high = _boxes(cubes)
    centre = rows[:, :3].astype(np.float64)
    apart = np.maximum(low[:, None] - centre, 0.0) + np.minimum(high[:, None] - centre, 0.0)
    if support == "sphere":
        return np.linalg.norm(apart, axis=2) / reference.reach(rows, CUT, "sphere").max(1)
    exact_rows = torch.tensor(rows, dtype=torch.float64)
    # W = S^-1 R^T.
    whiten = (plain.rotations(exact_rows[:, 6:10]) / exact_rows[:, None, 3:6].exp()).transpose(1, 2).numpy()
    nearest = [
        reference.nearest(w, c, a, b) if (c < a).any() or (c > b).any() else 0.0
        for a, b in zip(low, high, strict=True)
        for w, c in zip(whiten, centre, strict=True)
    ]
    return np.array(nearest).reshape(len(low), len(rows)) / CUT


@pytest.mark.parametrize(
    ("anisotropy", "longest", "support"),
    [(20.0, 0.2, "ellipsoid"), (20.0, 0.2, "sphere"), (1.0, 0.1, "ellipsoid"), (300.0, 0.4, "ellipsoid")]
    + [(30000.0, 0.4, "ellipsoid")],
)
def test_lists_hold_the_gaussians_that_meet_the_cube(device: str, anisotropy: float, longest: float, support: str):
    """The lists agree with float64, for ellipsoids with a solver of bounded least squares; sheets are among them."""
    rows = _gaussians(24, anisotropy, longest)
    rows[::2, 4] = rows[::2, 3]
    cubes = probe_cubes.build(_shapes(rows, device, support), LOW, HIGH, 0.3)
    assert [*cubes.counts] == [4, 3, 3]
    far = _distances(rows, cubes, support)
    listed = _table(cubes, len(rows))
    assert listed[far <= 1.0].all()
    # A cube is a little larger than it should be; to a sheet of 1e-5 that is far.
    slack = LOOSE + 4e-6 / (CUT * np.exp(rows[:, 3:6].min(1)))
    assert not listed[far > 1.0 + slack].any()
    assert 0.02 < listed.mean() < 0.98


def _reached(row: np.ndarray, random: np.random.Generator, count: int = 60) -> np.ndarray:
    """Points at the border of what a Gaussian reaches, on either side of it by rounding."""
    turn = plain.rotations(torch.tensor(row[None, 6:10], dtype=torch.float64))[0].numpy()
    u = random.normal(size=(count, 3))
    u *= CUT * (1.0 + 1e-6 * random.normal(size=(count, 1))) / np.linalg.norm(u, axis=1, keepdims=True)
    return row[:3] + (u * np.exp(row[3:6].astype(np.float64))) @ turn.T


@pytest.mark.parametrize("anisotropy", [1.0, 90.0, 30000.0])
@pytest.mark.parametrize("offset", [0.0, 300.0])
def test_no_list_lacks_a_gaussian_that_reaches(device: str, anisotropy: float, offset: float):
    """Sums over lists are those over all Gaussians to the last bit, at points that they barely reach, in and outside
    of the grid, and where float32 is coarse."""
    random = np.random.default_rng(3)
    rows = _gaussians(60, anisotropy)
    x = np.concatenate([*(_reached(row, random) for row in rows), random.random((500, 3)) * 3 - 1, [LOW, HIGH]])
    rows[:, :3] += offset
    x = array((x + offset).astype(np.float32), wp.vec3, device)
    used = array(rows, float, device)
    low, high = np.add(LOW, offset), np.add(HIGH, offset)
    for support in ("ellipsoid", "sphere"):
        shapes = gaussian_sum.shapes(used, CUT, support)
        want = wp.zeros((1, len(x)), dtype=float, device=device)
        gaussian_sum.sum(used, shapes, None, x, want, CUT)
        for size in (0.03, 0.31):
            f = wp.zeros_like(want)
            gaussian_sum.sum(used, shapes, probe_cubes.build(shapes, low, high, size), x, f, CUT)
            np.testing.assert_array_equal(f.numpy(), want.numpy())


def test_hard_gaussians(device: str):
    """Collapsed: one cube. As large as all: every cube. Far off: the cubes at the border that face it. Not a number:
    every cube, for no test can say."""
    rows = np.tile(np.array([0.35, 0.35, 0.35, 0, 0, 0, 1, 0, 0, 0, 1], np.float32), (5, 1))
    rows[0, 3:6] = np.log(1e-4)
    rows[1, 3:6] = np.log(4.0)
    rows[2, :3], rows[2, 3:6] = [9.0, 0.35, 0.35], np.log(1e-2)
    rows[3, 0] = np.nan
    rows[4, 4] = np.nan
    cubes = probe_cubes.build(_shapes(rows, device), [0, 0, 0], [1, 1, 1], 0.1)
    listed = _table(cubes, 5).reshape(10, 10, 10, 5)
    assert np.argwhere(listed[..., 0]).tolist() == [[3, 3, 3]]
    assert listed[..., [1, 3, 4]].all()
    assert np.argwhere(listed[..., 2]).tolist() == [[9, 3, 3]]


def test_no_gaussians(device: str):
    """Empty lists; one cube where its size is left to us."""
    for size, count in ((0.5, 12), (None, 1)):
        cubes = probe_cubes.build(_shapes(np.zeros((0, 11), np.float32), device), LOW, HIGH, size)
        assert cubes.start.numpy().tolist() == [0] * (count + 1) and cubes.item.shape == (0,)


def test_flat_boxes(device: str):
    """Probes in a plane, in a line, or in one point."""
    rows = _gaussians(40, 5.0, longest=0.05)
    for axes in (1, 2, 3):
        high = np.array(HIGH)
        high[:axes] = LOW[:axes]
        for size in (0.05, None):
            cubes = probe_cubes.build(_shapes(rows, device), LOW, high, size)
            counts = [*cubes.counts]
            assert counts[:axes] == [1] * axes and all(count > 1 for count in counts[axes:])
            assert _table(cubes, 40).any(0).all()
