"""Grids for three.js: the layout, number by number, and what is refused."""

import json

import numpy as np
import pytest
from builders.probe_models import random_model

from wlm.errors import WlmError
from wlm.export import export


@pytest.fixture(scope="module")
def grid(tmp_path_factory):
    """A model and its grid: 6 x 3 x 5 cells of a box of 8 x 3 x 6."""
    model = random_model()
    folder = tmp_path_factory.mktemp("grid") / "out"
    export(model, folder, "three", cells=6)
    return model, folder


def test_texture_as_three_lays_it_out(grid):
    model, folder = grid
    info = json.loads((folder / "grid.json").read_text())
    nx, ny, nz = info["resolution"]
    assert (nx, ny, nz) == (6, 3, 5)
    box = np.array(info["box"])
    np.testing.assert_allclose(box.mean(0), model.origin + model.extent * model.size / 2)
    np.testing.assert_allclose(np.array(info["corners"]) - box, [[2 / 3] * 3, [-2 / 3] * 3])
    texels = np.frombuffer((folder / "grid.ktx2").read_bytes()[-nx * ny * 7 * (nz + 2) * 8 :], "<f2")
    texels = texels.reshape(7, nz + 2, ny, nx, 4)
    decoder = model.decoder()
    for x, y, z in [(0, 0, 0), (5, 2, 4), (3, 1, 2)]:
        place = box[0] + (np.array([x, y, z]) + 0.5) * 4 / 3
        got = texels[:, 1 + z, y, x].reshape(-1)
        np.testing.assert_allclose(got[:27], decoder.decode(place[None])[0], rtol=1e-3, atol=1e-6)
        assert got[27] == 0.0
    np.testing.assert_array_equal(texels[:, 0], texels[:, 1])
    np.testing.assert_array_equal(texels[:, -1], texels[:, -2])


def test_export_refuses(tmp_path):
    for model, settings, message in [
        (random_model(outputs=12), {}, "expected L2 in RGB"),
        (random_model(), {"cells": 0}, "cells: expected"),
        (random_model(), {"cells": 257}, "cells: expected"),
    ]:
        with pytest.raises(WlmError, match=message):
            export(model, tmp_path / "out", "three", **settings)
    assert not (tmp_path / "out").exists()
