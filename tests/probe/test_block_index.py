"""Where probes are: cells that say it exactly, the blocks near them, and a side for these."""

import numpy as np
import pytest
from reference import volume_blocks as reference

from wlm.errors import WlmError
from wlm.probe.volume.index import BlockIndex, finest_side


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
    np.testing.assert_array_equal(_cells(index.key), index.cell)
    cell = index.sizes[0] / 2
    place = (index.start[0] * 2 + index.cell + index.place) * cell
    np.testing.assert_allclose(place, position[index.number], atol=1e-6 * cell + 1e-15 * abs(origin))
    for level, size in enumerate(index.sizes):
        keys = index.block[index.level_start[level] : index.level_start[level + 1]]
        assert (np.diff(keys) > 0).all()
        got = {tuple(b) for b in (_cells(keys) + index.start[level]).astype(int).tolist()}
        want = reference.blocks(position, size)
        # Rounded in another order, a share may be a tenth or not.
        assert len(got ^ want) <= 0.01 * len(want)


def test_no_probe_and_coincident_ones():
    empty = BlockIndex(np.zeros((0, 3)), 1.0, (1, 4))
    assert empty.count == 0 and len(empty.block) == 0 and empty.level_start.tolist() == [0, 0, 0]
    assert len(BlockIndex(np.full((7, 3), 0.5), 1.0, (1,)).block) == 1  # at its centre, that block alone


def test_index_refuses():
    good = np.zeros((2, 3))
    for position, side in [(np.zeros(3), 1), (np.array([[0, np.nan, 0]]), 1), (np.full((1, 3), 1e101), 1), (good, 0)]:
        with pytest.raises(ValueError, match="position|side"):
            BlockIndex(position, side, (1,))


def test_side_follows_the_spacing():
    random = np.random.default_rng(0)
    plane = np.stack([*random.uniform(0, 30, (2, 900)), np.zeros(900)], 1)
    side = finest_side(plane)
    assert 0.3 < side < 1.3 and finest_side(plane * 1e-9 + 5.0) == pytest.approx(side * 1e-9, rel=0.26)
    lattice = np.stack(np.meshgrid(*[np.arange(6.0)] * 3), -1).reshape(-1, 3)
    # Fewer blocks than probes could not tell them apart.
    assert len(BlockIndex(lattice, finest_side(lattice), (1,)).block) >= 2 * len(lattice)
    assert finest_side(np.zeros((0, 3))) == finest_side(np.ones((5, 3))) == 1.0
    with pytest.raises(WlmError, match="positions: expected distances"):
        finest_side(np.array([[0.0, 0.0, 0.0], [1e300, 1e300, 1e300]]))
