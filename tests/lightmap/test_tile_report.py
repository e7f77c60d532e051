"""Reports of tiles: their bytes are those of the file's parts, and each tile has a reason for its encoding."""

import numpy as np
import pytest
from builders.small_sets import moving_light, tiny_profile
from builders.synthetic import random_model

from wlm.lightmap.codec import part_bytes
from wlm.lightmap.fit import compress
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.tile_report import report_tiles


@pytest.fixture(scope="module")
def model():
    mask = np.ones((364, 375), bool)
    mask[256:, 128:] = False
    mask[:128, :128] = False
    mask[130:, 130:250] = False
    return random_model((0, 1, 2, 3, 4, 1, 3, 0, 0), columns=3, mask=mask)


def test_the_bytes_are_those_of_the_file(model):
    tiles = report_tiles(model.sheets[LIGHT])
    parts = part_bytes(model, model.file_bytes())
    assert sum(tile.bytes for tile in tiles) == parts["tiles"] + parts["constant"]
    kinds = ["empty", "constant", "static", "dynamic", "frames", "constant", "dynamic", "empty", "empty"]
    assert [tile.kind for tile in tiles] == kinds
    assert [(tile.number, tile.row, tile.column) for tile in tiles] == [(n, n // 3, n % 3) for n in range(9)]
    valid = [
        int(model.sheets[LIGHT].mask[y : y + 128, x : x + 128].sum()) for y in (0, 128, 256) for x in (0, 128, 256)
    ]
    assert [tile.valid for tile in tiles] == valid
    assert tiles[0].bytes == 0 and tiles[2].bytes < tiles[3].bytes


def test_each_has_its_reason(model):
    said = [tile.why for tile in report_tiles(model.sheets[LIGHT])]
    assert said[0] == "no texel is inside a chart" and said[1].startswith("all valid texels have one colour")
    assert said[2].endswith("60 dB at all times") and said[3].startswith("the light changes over time")


def test_a_tile_that_was_left_out_says_so():
    model = compress(moving_light(128, 256), tiny_profile(steps=10), tiles=[1])
    assert next(tile.why for tile in report_tiles(model.sheets[LIGHT])) == "it was left out of the fit"
