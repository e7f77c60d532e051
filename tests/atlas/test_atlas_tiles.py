"""Tiles at their own resolutions: cutting, least squares, sizes, packing, and colour textures as blocks."""

import itertools
import sys

import numpy as np
import pytest
import torch

from wlm.atlas.colour import BLOCK_CODECS, block_grid, decode, quantise, stored
from wlm.atlas.model import (
    FIRST_BLOCK_CODE,
    NO_BLOCKS,
    first_block_code,
    pack_entries,
    tile_counts,
    unpack_entries,
)
from wlm.atlas.stages import Stages
from wlm.atlas.tiles import fit as grid
from wlm.atlas.tiles import layout as allocation
from wlm.atlas.tiles.layout import Size
from wlm.errors import WlmError

RANDOM = np.random.default_rng(11)


def _image(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height + width).random((height, width, 3)).astype(np.float32)


def _weight(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(height * width).random((2 * height, 2 * width))


def _bilinear(image: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """At places in texels from the first one's centre, float64 [N, 3], clamped."""
    columns = np.array([[np.interp(x, np.arange(image.shape[1]), row) for row in image[..., c]] for c in range(3)])
    rows = np.arange(image.shape[0])
    return np.array([[np.interp(b, rows, columns[c, :, i]) for c in range(3)] for i, b in enumerate(y)])


def _places(tiles: grid.Tiles, rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """x and y of each point of each tile, in texels from the first one's centre, [T, m * m]."""
    m = grid.SUPERSAMPLING * tiles.size
    inner = (np.arange(m) + 0.5) / grid.SUPERSAMPLING
    row, column = np.divmod(tiles.index.numpy(), columns)
    x = column[:, None, None] * tiles.size + inner[None, None, :] + np.zeros((1, m, 1))
    y = row[:, None, None] * tiles.size + inner[None, :, None] + np.zeros((1, 1, m))
    assert row.max() < rows
    return x.reshape(len(row), -1), y.reshape(len(row), -1)


SIZES = [(29, 36), (30, 40), (7, 7), (3, 4), (1, 20), (20, 1), (1, 1), (8, 2)]


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_cut_reads_the_light_between_texels(height: int, width: int):
    """Also where the last tiles reach beyond the lightmap, which ends at its outermost centres."""
    size = 7
    image, weight = _image(height, width), _weight(height, width)
    tiles = grid.cut(image, weight, size, "cpu")
    rows, columns = tile_counts(height, width, size)
    assert (rows, columns) == (max(1, -(-(height - 1) // size)), max(1, -(-(width - 1) // size)))
    assert len(tiles.index) == rows * columns and tiles.light.shape == (rows * columns, 3, (2 * size) ** 2)
    x, y = _places(tiles, rows, columns)
    chosen = RANDOM.integers(0, x.size, 200)
    light = tiles.light.permute(0, 2, 1).reshape(-1, 3).numpy()[chosen]
    np.testing.assert_allclose(light, _bilinear(image, x.flat[chosen], y.flat[chosen]), atol=1e-6)


@pytest.mark.parametrize(("height", "width"), SIZES)
def test_cut_keeps_all_weight(height: int, width: int):
    """Each quarter of a texel counts at its own centre; those outside of the outermost centres at the nearest point."""
    weight = _weight(height, width)
    tiles = grid.cut(_image(height, width), weight, 7, "cpu")
    assert float(tiles.weight.double().sum()) == pytest.approx(1.0, abs=1e-5)
    rows, columns = tile_counts(height, width, 7)
    x, y = _places(tiles, rows, columns)
    total = np.zeros((max(1, 2 * height - 2), max(1, 2 * width - 2)))
    row, column = (np.rint(2 * place - 0.5).astype(int).ravel() for place in (y, x))
    values = tiles.weight.numpy().ravel()
    inside = (row < total.shape[0]) & (column < total.shape[1])
    assert not values[~inside].any()
    np.add.at(total, (row[inside], column[inside]), values[inside])
    expected = np.zeros_like(total)
    rows, columns = (np.clip(np.arange(2 * n) - 1, 0, m - 1) for n, m in zip((height, width), total.shape, strict=True))
    np.add.at(expected, (rows[:, None], columns[None, :]), weight / weight.sum())
    np.testing.assert_allclose(total, expected, atol=1e-7)


def _tiles(count: int, size: int, weight: np.ndarray | None = None, seed: int = 0) -> grid.Tiles:
    """Smooth light with an edge in it, and some noise."""
    random = np.random.default_rng(seed)
    m = grid.SUPERSAMPLING * size
    y, x = np.mgrid[:m, :m] / m
    light = random.random((count, 3, 1, 1)) + x * random.normal(size=(count, 3, 1, 1))
    light += 0.1 * random.random((count, 3, m, m))
    light += random.random((count, 3, 1, 1)) * (x + y > random.random((count, 1, 1, 1)) * 2)
    weight = random.random((count, m * m)) if weight is None else weight
    return grid.Tiles(
        torch.arange(count),
        torch.from_numpy(light.reshape(count, 3, -1).astype(np.float32)),
        torch.from_numpy((weight / weight.sum()).astype(np.float32)),
        size,
    )


def _kron(nx: int, ny: int, points: int) -> np.ndarray:
    hats = [np.array([np.interp((np.arange(points) + 0.5) / points, np.linspace(0, 1, n), e) for e in np.eye(n)]).T
            if n > 1 else np.ones((points, 1)) for n in (ny, nx)]  # fmt: skip
    return np.kron(*hats)


def _least_squares(tiles: grid.Tiles, nx: int, ny: int, pull: float) -> np.ndarray:
    """The samples [T, ny, nx, 3] in float64, pulled towards those of equal weights as `solve` says."""
    points = grid.SUPERSAMPLING * tiles.size
    both = _kron(nx, ny, points)
    out = []
    for light, weight in zip(tiles.light.double().numpy(), tiles.weight.double().numpy(), strict=True):
        start = np.linalg.lstsq(both, light.T, rcond=None)[0]
        root = np.sqrt(weight / weight.mean())[:, None]
        ridge = np.sqrt(pull * points**2 / (nx * ny))
        matrix = np.concatenate([root * both, ridge * np.eye(nx * ny)])
        right = np.concatenate([root * light.T, ridge * start])
        out.append(np.linalg.lstsq(matrix, right, rcond=None)[0].reshape(ny, nx, 3))
    return np.array(out)


def _error(tiles: grid.Tiles, samples: np.ndarray) -> np.ndarray:
    """Weighted squared error of each tile in float64."""
    count, ny, nx, _ = samples.shape
    interpolated = _kron(nx, ny, grid.SUPERSAMPLING * tiles.size) @ samples.reshape(count, ny * nx, 3)
    each = ((interpolated - tiles.light.double().numpy().transpose(0, 2, 1)) ** 2).mean(2)
    return (each * tiles.weight.double().numpy()).sum(1)


SHAPES = [(1, 1), (1, 3), (4, 4), (5, 8)]


@pytest.mark.parametrize(("nx", "ny"), SHAPES)
def test_solve_against_dense_least_squares(nx: int, ny: int):
    tiles = _tiles(12, 7)
    samples = grid.solve(tiles, nx, ny).double().numpy()
    np.testing.assert_allclose(samples, _least_squares(tiles, nx, ny, grid._RIDGE), atol=2e-3)
    # The ridge costs next to nothing where every point has a weight.
    error, least = _error(tiles, samples), _error(tiles, _least_squares(tiles, nx, ny, 0.0))
    assert (error <= least * 1.002 + 1e-12).all()
    np.testing.assert_allclose(grid.errors(tiles, torch.from_numpy(samples).float()).numpy(), error, rtol=1e-4)


@pytest.mark.parametrize(("nx", "ny"), SHAPES)
def test_solve_with_few_weights(nx: int, ny: int):
    """Weights of zero but for a corner, a column, a point: these are fitted, the rest stays near the light."""
    m = 2 * 7
    weight = np.zeros((3, m, m))
    weight[0, :4, :5] = RANDOM.random((4, 5)) + 0.1
    weight[1, :, -1] = 1.0
    weight[2, 6, 9] = 1.0
    tiles = _tiles(3, 7, weight.reshape(3, -1))
    samples = grid.solve(tiles, nx, ny).double().numpy()
    assert np.isfinite(samples).all()
    best = _error(tiles, _least_squares(tiles, nx, ny, grid._RIDGE))
    assert (_error(tiles, samples) <= best * 1.05 + 1e-7).all()
    light = tiles.light.numpy()
    low, high = light.min((1, 2)), light.max((1, 2))
    margin = high - low
    assert ((samples.min((1, 2, 3)) > low - margin) & (samples.max((1, 2, 3)) < high + margin)).all()


def test_curves_and_solved():
    """A curve is the error at each size; each tile is solved at its own; no sample is negative."""
    tiles = _tiles(9, 5)
    tiles.light[:2] = (tiles.light[:2] - 2.0).clamp(min=0.0)  # a black tile with some light in it
    sizes = [Size(*sides, "half") for sides in ((1, 1), (3, 2), (6, 6))]
    error = grid.curves(tiles, sizes, Stages("cpu")).numpy()
    assert error.shape == (3, 9) and error.dtype == np.float64
    chosen = np.arange(9) % 3
    solved = grid.solved(tiles, sizes, chosen)
    samples = {i: pair for members, *parts in solved for i, *pair in zip(members.tolist(), *parts, strict=True)}
    assert sorted(samples) == list(range(9))
    for i, (values, weight) in samples.items():
        size = sizes[chosen[i]]
        assert values.shape == (size.ny, size.nx, 3) and (values >= 0).all()
        interpolation = _kron(size.nx, size.ny, 2 * tiles.size)
        np.testing.assert_allclose(weight.ravel(), tiles.weight[i].numpy() @ interpolation**2, rtol=1e-4)
        tile = grid.Tiles(*(part[i : i + 1] for part in (tiles.index, tiles.light, tiles.weight)), tiles.size)
        # A curve takes fewer rounds.
        exact = float(grid.errors(tile, values[None])[0])
        assert exact <= error[i % 3, i] * 1.01 + 1e-12 and exact >= error[i % 3, i] * 0.9 - 1e-9
    # A curve is of what the file holds.
    coarse = grid.curves(tiles, [Size(4, 4, colour) for colour in ("bc6h", "rgb9e5", "half")], Stages("cpu")).numpy()
    samples = grid.solve(tiles, 4, 4, grid._MEDIUM).clamp(min=0.0)
    of_blocks = grid.errors(tiles, stored(samples, grid.sample_weights(tiles, 4, 4), "bc6h")).numpy()
    np.testing.assert_allclose(coarse[0], of_blocks, rtol=1e-6)
    lit = coarse[2] > 0
    assert lit.sum() >= 7 and (coarse[0, lit] > coarse[1, lit]).all() and (coarse[1, lit] > 0.99 * coarse[2, lit]).all()


def test_what_is_stored_is_what_the_texture_holds():
    """Tile by tile on the device, as in the file."""
    random = np.random.default_rng(3)
    samples = random.random((5, 8, 4, 3)).astype(np.float32) * 10.0 ** random.uniform(-8, 5, (5, 1, 1, 1))
    samples = samples.astype(np.float32)
    weight = random.random((5, 8, 4)).astype(np.float32)
    for colour in ("rgb9e5", "bc6h"):
        decoded = stored(torch.from_numpy(samples), torch.from_numpy(weight), colour).numpy()
        texture = quantise(samples.reshape(40, 4, 3), colour, weight.reshape(40, 4))["texels"]
        np.testing.assert_array_equal(decoded.reshape(40, 4, 3), texture.astype(np.float32))


@pytest.mark.parametrize("seed", range(3))
def test_allocate_is_optimal_for_what_it_spends(seed: int):
    """No choice of the same cost is better, as a Lagrange multiplier promises, and nothing on the hull is left over."""
    random = np.random.default_rng(seed)
    cost = np.array([1.0, 2, 4, 6, 9])
    error = np.sort(random.random((5, 6)), 0)[::-1] * random.random(6) ** 3
    every = np.array(list(itertools.product(range(5), repeat=6)))
    all_errors, all_costs, spent = error[every, np.arange(6)].sum(1), cost[every].sum(1), []
    for budget in (6.0, 9.0, 14.0, 25.0, 40.0, 54.0):
        chosen = allocation.allocate(error, cost, budget, 0.0)
        spent.append(cost[chosen].sum())
        assert spent[-1] <= budget
        assert error[chosen, np.arange(6)].sum() == pytest.approx(all_errors[all_costs <= spent[-1]].min(), rel=1e-12)
    assert spent == sorted(spent) and spent[0] == 6 and spent[-1] == 54
    # A hull's longest edge is one tile's step from its cheapest size to its dearest.
    assert all(budget - cost_of < 9 for budget, cost_of in zip((9.0, 14.0, 25.0, 40.0), spent[1:5], strict=True))


def test_allocate_buys_no_sample_below_the_least_gain():
    cost = np.array([1.0, 2.0, 3.0])
    error = np.array([[10.0, 10.0, 0.0], [9.0, 5.0, 0.0], [8.5, 4.9, 0.0]])
    assert allocation.allocate(error, cost, 100.0, 0.0).tolist() == [2, 2, 0]
    assert allocation.allocate(error, cost, 100.0, 0.6).tolist() == [1, 1, 0]
    assert allocation.allocate(error, cost, 100.0, 2.0).tolist() == [0, 1, 0]
    assert allocation.allocate(error, cost, 4.0, 0.0).tolist() == [0, 1, 0]


def test_allocate_gives_the_cheapest_where_nothing_fits():
    error = np.array([[3.0, 2.0], [1.0, 1.0]])
    assert allocation.allocate(error, np.array([1.0, 2.0]), 0.5, 0.0).tolist() == [0, 0]
    flat = np.zeros((2, 4))
    assert allocation.allocate(flat, np.array([1.0, 2.0]), 4.0, 0.0).tolist() == [0] * 4


@pytest.mark.parametrize("seed", range(4))
def test_place(seed: int):
    """Inside, apart, and on shelves that waste little."""
    random = np.random.default_rng(seed)
    count = int(random.integers(1, 300))
    sizes = random.integers(1, 17, (count, 2))
    width = int(sizes[:, 0].max() + random.integers(0, 100))
    shelves = allocation.Shelves(sizes)
    first, (height, widest) = shelves.place(width), shelves.extent(width)
    used = np.zeros((height, width), int)
    for (x, y), (w, h) in zip(first, sizes, strict=True):
        assert x >= 0 and y >= 0 and x + w <= width and y + h <= height
        used[y : y + h, x : x + w] += 1
    assert used.max() == 1 and used[-1].any() and used[:, widest - 1].any() and not used[:, widest:].any()
    if count > 100 and width > 64:
        assert used.mean() > 0.75


BLOCKS = np.array([False, True, False])
ENTRIES = {
    "half": ([[0, 4095], [17, 1]], [[1, 16], [16, 3]], False),
    "bc6h": ([[0, 16380], [4, 8]], [[4, 16], [16, 4]], True),
    "astc": ([[0, 16380], [4, 8]], [[4, 16], [16, 4]], True),
    "mixed": ([[0, 4095], [16380, 8], [17, 1]], [[1, 12], [16, 4], [12, 3]], BLOCKS),
}


@pytest.mark.parametrize("colour", ENTRIES)
def test_entries(colour: str):
    """A table's entry holds its place and size, at the ends of their ranges too; of blocks places reach four times
    further. Numbers beyond, and what isn't of whole blocks, are refused."""
    first, size, blocks = (np.array(each) for each in ENTRIES[colour])
    code = first_block_code(colour)
    assert code == {"half": NO_BLOCKS, "mixed": FIRST_BLOCK_CODE}.get(colour, 0)
    entries = pack_entries(first, size, blocks, code)
    assert entries.dtype == np.uint16
    for found, expected in zip(unpack_entries(entries, code), (first, size, blocks[..., None]), strict=True):
        np.testing.assert_array_equal(found, np.broadcast_to(expected, first.shape))
    step = np.where(blocks[..., None], 4, 1)
    wrong = [(first + step * (first == first.max()), size), (first, size + step * (size == 16)), (first - step, size)]
    wrong += [(first, size - step)] if colour != "mixed" else [(first, np.where(step == 4, size, 13))]


def _smooth(height: int, width: int) -> np.ndarray:
    y, x = np.mgrid[:height, :width] / 20.0
    return (0.5 + (np.sin(y + 0.5) * np.cos(x) + 1.0) ** 2)[..., None] * np.array([1.0, 0.8, 0.5])


@pytest.mark.parametrize("codec", BLOCK_CODECS)
@pytest.mark.parametrize("shape", [(32, 48), (31, 45), (1, 1), (3, 9)])
def test_a_texture_comes_back(codec, shape):
    texels = _smooth(32, 48)[: shape[0], : shape[1]]
    decoded, blocks = quantise(texels.astype(np.float16), codec).values()
    rows, columns = block_grid(*shape)
    assert blocks.dtype == np.uint8 and blocks.shape == (rows * columns, 16)
    assert decoded.dtype == np.float16 and decoded.shape == texels.shape
    np.testing.assert_allclose(decoded, texels, rtol=0.02, atol=0.02)
    np.testing.assert_array_equal(decode(blocks, *shape, codec), decoded)
    blocks.flags.writeable = False
    np.testing.assert_array_equal(decode(blocks, *shape, codec), decoded)


@pytest.mark.parametrize("codec", BLOCK_CODECS)
def test_blocks_are_row_by_row_and_padding_repeats_the_border(codec):
    texels = np.arange(1.0, 7.0).reshape(2, 3).repeat(4, 0).repeat(4, 1)[..., None].repeat(3, 2)
    blocks = quantise(texels, codec)["blocks"]
    for number, block in enumerate(blocks):
        np.testing.assert_allclose(decode(block[None], 4, 4, codec), number + 1.0, rtol=0.01)
    cut = quantise(texels[:5, :9], codec)["blocks"]
    np.testing.assert_array_equal(cut, blocks)


@pytest.mark.parametrize("codec", BLOCK_CODECS)
def test_the_range_is_clamped(codec):
    texels = np.full((4, 12, 3), -3.0)
    texels[:, 4:8] = np.inf
    texels[:, 8:] = 1e30
    decoded = quantise(texels, codec)["texels"]
    assert np.isfinite(decoded).all() and not decoded[:, :4].any()
    np.testing.assert_allclose(decoded[:, 4:], 65504.0, rtol=0.01)
    assert not quantise(np.full((4, 4, 3), -np.inf), codec)["texels"].any()


def test_a_missing_package_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "astc_encoder", None)  # makes the import fail
    with pytest.raises(WlmError, match=r"astc_encoder is missing.*wlm\[atlas\]"):
        decode(np.zeros((1, 16), np.uint8), 4, 4, "astc")
