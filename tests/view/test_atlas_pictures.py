"""Pictures of a mesh under its lightmap: the cells of a sheet, on one exposure."""

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts, constant, sheet, triangle
from PIL import Image

from wlm.atlas.evaluation import original
from wlm.errors import WlmError
from wlm.ops.views import View
from wlm.view.atlas import comparison, draw
from wlm.view.display import white_of
from wlm.view.pictures import encode, save_png

FRONT = View.of((0.2, 0.1, 1.0))


def _shifted(mesh, by):
    """The lightmap and a number."""
    read = original(mesh)
    return lambda points, state: read(points, state) + by


def test_a_view_shows_the_lightmap(device):
    mesh = sheet(constant(0.25, 0.5, 1.0))
    pictures, hit = draw(mesh, {"a": original(mesh, device)}, FRONT, 64, device)
    assert hit.shape == (64, 64) and 0.1 < hit.mean() < 0.9
    np.testing.assert_allclose(pictures["a"][hit], [[0.25, 0.5, 1.0]] * int(hit.sum()), rtol=1e-6)
    assert not pictures["a"][~hit].any()


def test_a_decoder_gets_the_corners_weights():
    mesh = charts()

    def place(points, state):
        corner = torch.from_numpy(mesh.sheets[0].uv[mesh.sheets[0].triangle].astype(np.float32))
        interpolated = (corner[points.triangle.long()] * points.weight[:, :, None]).sum(1)
        np.testing.assert_allclose(interpolated.numpy(), points.uv.numpy(), atol=1e-6)
        return torch.ones(len(points.uv), 3)

    pictures, hit = draw(mesh, {"a": place}, FRONT, 48)
    assert (pictures["a"][hit] == 1).all() and hit.any()


def test_exposure():
    light = np.array([[[0.0, 0.5, 1.0], [2.0, -1.0, 0.001]]])
    encoded = encode(light, np.array([[True, True]]), 1.0)
    # sRGB of a half is 188, of a thousandth 12.92 / 1000.
    np.testing.assert_array_equal(encoded, [[[0, 188, 255], [255, 0, 3]]])
    assert (encode(light, np.zeros((1, 2), bool), 1.0) == 128).all()
    assert white_of(np.zeros((5, 3))) == 1.0 == white_of(np.zeros((0, 3)))
    dark = np.zeros((10000, 3))
    dark[0] = 3.0
    assert white_of(dark) == 3.0, "one lamp in the dark"
    assert white_of(np.arange(1001.0)) == pytest.approx(995.0)


def test_the_comparison(tmp_path):
    mesh = sheet()
    samplers = {"same": original(mesh), "brighter": _shifted(mesh, 1 / 64)}
    views = [FRONT, View.of((0.0, 1.0, 1.0))]
    comparison(tmp_path / "a.png", mesh, samplers, views, resolution=96)
    with Image.open(tmp_path / "a.png") as image:
        sheet_pixels = np.asarray(image)
    # Five columns of one width, right of the labels.
    rows, wide = _window(mesh, FRONT)[0], max(_window(mesh, view)[1] for view in views)
    assert 20 < wide <= 96
    left = sheet_pixels.shape[1] - 5 * (wide + 4)
    columns = [sheet_pixels[28 : 28 + rows, left + k * (wide + 4) :][:, :wide] for k in range(5)]
    np.testing.assert_array_equal(columns[0], columns[1])
    inside = (columns[0] != 128).any(axis=2) & (columns[0] != 96).any(axis=2)
    assert 0.2 < inside.mean() < 1.0
    assert (columns[2][inside].astype(int) >= columns[0][inside]).all() and (columns[2] != columns[0]).any()
    white = white_of(np.concatenate([_seen(mesh, view) for view in views]))
    expected = encode(np.full((1, 1, 3), 8 / 64), np.ones((1, 1), bool), white)[0, 0]
    assert (columns[3][inside] == 0).all()
    assert (np.abs(columns[4][inside].astype(int) - expected) <= 1).all()


def _window(mesh, view):
    """Height and width of the part of a view that a sheet shows."""
    _, hit = draw(mesh, {"a": original(mesh)}, view, 96)
    return tuple(int(np.ptp(np.flatnonzero(hit.any(axis=axis)))) + 1 for axis in (1, 0))


def _seen(mesh, view):
    pictures, hit = draw(mesh, {"a": original(mesh)}, view, 96)
    return pictures["a"][hit]


def test_what_cannot_be_drawn(tmp_path):
    mesh = triangle()
    with pytest.raises(ValueError, match="at least one decoder"):
        comparison(tmp_path / "a.png", mesh, {}, [FRONT])
    with pytest.raises(ValueError, match="one view"):
        comparison(tmp_path / "a.png", mesh, {"a": original(mesh)}, [])
    with pytest.raises(WlmError, match="triangle: cannot draw it: no camera shows a surface"):
        comparison(tmp_path / "a.png", mesh, {"a": original(mesh)}, [View.of((1, 0, 0))])
    with pytest.raises(WlmError, match="cannot write"):
        save_png(tmp_path / "none" / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert not list(tmp_path.iterdir())
