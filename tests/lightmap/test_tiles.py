"""Tiles: cutting, putting back together, their kinds, and the gaps between charts."""

import numpy as np
import pytest
from builders.checks import error_of
from builders.small_sets import sheet_from_arrays as from_arrays
from builders.synthetic import random_sheet

from wlm.errors import WlmError
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.fit import SheetFit
from wlm.lightmap.profile import Profile
from wlm.lightmap.tiles import (
    TILE,
    TileGrid,
    TileKind,
    classify,
    place,
    split,
)
from wlm.texels import REACH, fill_gaps, near_gaps

HEIGHT, WIDTH, GAMMA = 200, 300, 2.2  # 2 rows and 3 columns of tiles, both cut at the end


def _half(values: np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float16).astype(np.float32)


@pytest.fixture(scope="module")
def lightmaps() -> SheetFrames:
    random = np.random.default_rng(1)
    frames = random.uniform(0.0, 4.0, (3, HEIGHT, WIDTH, 3)).astype(np.float32)
    mask = random.random((HEIGHT, WIDTH)) < 0.4
    mask[:TILE, TILE : 2 * TILE] = False
    return from_arrays(frames, [0, 1, 2], mask)


def _kind(linear: np.ndarray) -> TileKind:
    """The kind of a tile of linear colours that broadcast to [T, 128, 128, 3]."""
    colour = np.broadcast_to(linear, (len(linear), TILE, TILE, 3)).astype(np.float32) ** np.float32(1 / GAMMA)
    return classify(colour.reshape(len(linear), -1, 3), GAMMA)


def test_grid():
    grid = TileGrid.of(HEIGHT, WIDTH)
    assert grid == TileGrid(HEIGHT, WIDTH, 2, 3) and grid.count == 6
    assert [grid.origin(i) for i in range(6)] == [(y, x) for y in (0, 128) for x in (0, 128, 256)]
    assert [TileGrid.of(*size).count for size in ((1, 1), (128, 256), (129, 1))] == [1, 2, 2]
    for index in (-1, 6):
        assert "outside the grid" in error_of(grid.origin, index)
    assert "at least one texel" in error_of(TileGrid.of, 0, 5)


def test_split_and_place_are_inverse(lightmaps):
    grid = TileGrid.of(HEIGHT, WIDTH)
    tiles = split(lightmaps, 1.0)
    np.testing.assert_array_equal(tiles.index, range(6))
    assert tiles.colour.shape == (6, 3, TILE, TILE, 3) and tiles.colour.dtype == np.float32
    valid, image = np.zeros((HEIGHT, WIDTH, 1), bool), np.zeros((HEIGHT, WIDTH, 3), np.float32)
    place(valid, tiles.mask[..., None], tiles.index, grid)
    np.testing.assert_array_equal(valid[..., 0], lightmaps.mask)
    for t in range(3):
        place(image, tiles.colour[:, t], tiles.index, grid)
        np.testing.assert_array_equal(image[lightmaps.mask], lightmaps.frames[t][lightmaps.mask])


def test_split_encodes_gamma(lightmaps):
    plain, encoded = split(lightmaps, 1.0, [0]), split(lightmaps, GAMMA, [0])
    np.testing.assert_allclose(encoded.colour.astype(np.float64) ** GAMMA, plain.colour, rtol=1e-5)
    valid = plain.mask[0]
    np.testing.assert_allclose(encoded.colour[0][:, valid], plain.colour[0][:, valid] ** (1 / GAMMA), rtol=1e-5)


def test_gaps_hold_the_nearest_valid_texel_of_the_tile():
    frames = np.zeros((1, TILE, 2 * TILE, 3), np.float32)
    mask = np.zeros((TILE, 2 * TILE), bool)
    for (y, x), value in {(10, 10): 1.0, (10, 100): 2.0, (10, 129): 9.0}.items():
        mask[y, x], frames[0, y, x] = True, value
    colour = split(from_arrays(frames, [0], mask), 1.0).colour
    assert (colour[0, 0, :, :55] == 1.0).all()
    # Texel (10, 129) is nearer to column 127, but belongs to another tile, which may be absent.
    assert (colour[0, 0, :, 56:] == 2.0).all()
    assert (colour[1] == 9.0).all()


def test_map_end_is_edge_padded_and_not_valid(lightmaps):
    tiles = split(lightmaps, GAMMA, [5])
    rows, columns = HEIGHT - TILE, WIDTH - 2 * TILE
    assert not tiles.mask[0, rows:].any() and not tiles.mask[0, :, columns:].any()
    assert tiles.mask[0, :rows, :columns].any()
    colour = tiles.colour[0]
    inside = colour[:, :rows, :columns]
    expected = np.pad(inside, ((0, 0), (0, TILE - rows), (0, TILE - columns), (0, 0)), mode="edge")
    np.testing.assert_array_equal(colour, expected)
    assert (inside > 0).all()


def test_split_refuses(lightmaps):
    for tiles, text in (([6], "outside the grid"), ([-1], "outside the grid"), ([1, 1], "twice"), ([], "none")):
        with pytest.raises(WlmError, match=text):
            split(lightmaps, GAMMA, tiles)


@pytest.mark.parametrize("value", [1e-6, 6e-5, 0.01, 0.3, 1.0, 1.999, 900.0, 60_000.0])
def test_constant_is_one_half_float_step_and_no_more(value):
    base = np.float16(value)
    step, two = np.nextafter(base, np.float16(np.inf)), np.float16(base)
    for _ in range(2):
        two = np.nextafter(two, np.float16(np.inf))
    linear = np.full((2, TILE, TILE, 3), np.float32(base))
    assert _kind(linear) is TileKind.CONSTANT
    linear[1, 5, 5, 1] = step
    assert _kind(linear) is TileKind.CONSTANT
    linear[1, 5, 5, 1] = two
    assert _kind(linear) is not TileKind.CONSTANT


def test_only_valid_texels_count():
    linear, mask = np.full((2, TILE, TILE, 3), 0.5, np.float32), np.ones((TILE, TILE), bool)
    mask[7] = False
    linear[0, 7] = 4.0
    lightmaps = [from_arrays(linear, [0, 1], valid) for valid in (mask, None)]
    kinds = [SheetFit(each, Profile(name="", frames="never")).kinds[0] for each in lightmaps]
    assert kinds == [TileKind.CONSTANT, TileKind.DYNAMIC]


PATTERN = np.random.default_rng(4).uniform(0.25, 1.0, (1, TILE, TILE, 3))
CHANNELS = np.array([[0.0, 1.0, 7.0], [3.0, 0.1, 0.0], [60_000.0, 0.0, 1e-5]])[:, None, None]


@pytest.mark.parametrize(
    ("linear", "kind"),
    [
        (_half(CHANNELS), TileKind.CONSTANT),
        (PATTERN, TileKind.DYNAMIC),
        (np.concatenate([np.full((1, TILE, TILE, 3), 0.5), PATTERN]), TileKind.DYNAMIC),
    ],
    ids=["channels", "one time", "grey time"],
)
def test_kinds_of_tiles(linear, kind):
    assert _kind(linear) is kind


def _mask(seed: int = 0, shape: tuple[int, int] = (40, 50), share: float = 0.05) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < share


@pytest.mark.parametrize("share", [0.0, 0.005, 0.05, 0.5, 1.0])
def test_each_takes_the_nearest_within_reach(share):
    mask = _mask(share=share)
    (target, source), valid = near_gaps(mask), np.argwhere(mask)
    expected = set()
    for at in np.argwhere(~mask):
        if len(valid) and np.abs(valid - at).max(1).min() <= REACH:
            expected.add(tuple(at))
    assert {tuple(at) for at in target} == expected and mask[tuple(source.T)].all()
    # The first of several that are as near, in reading order.
    first = [valid[np.square(valid - at).sum(1).argmin()] for at in target]
    np.testing.assert_array_equal(source, np.reshape(first, source.shape))


def test_they_are_filled_as_a_baker_dilates():
    mask = _mask(3)
    image = np.random.default_rng(1).random((40, 50, 3))
    target, source = (tuple(at.T) for at in near_gaps(mask))
    assert len(target[0]) > 100
    np.testing.assert_array_equal(image[source], fill_gaps(image, mask)[target])


@pytest.fixture(scope="module")
def model():
    mask = np.zeros((236, 247), bool)
    mask[20:60, 30:128] = mask[100:180, 60:90] = mask[235, 246] = True
    return random_sheet((3, 4, 3, 1), mask=mask)


@pytest.mark.parametrize("time", [7.5, 10.0])
def test_a_map_and_its_tiles_agree(model, time):
    decoder = SheetDecoder(model)
    frame = decoder.frame(time)
    raw = np.zeros((256, 256, 3), np.float32)
    for number, light in enumerate(decoder.tiles(range(4), time)):
        y, x = number // 2 * 128, number % 2 * 128
        raw[y : y + 128, x : x + 128] = light
    assert np.array_equal(frame[model.mask], raw[:236, :247][model.mask])
    target, source = near_gaps(model.mask)
    assert np.array_equal(frame[tuple(target.T)], raw[tuple(source.T)])
    assert (target // 128 != source // 128).any(), "some gaps take light from another tile"
