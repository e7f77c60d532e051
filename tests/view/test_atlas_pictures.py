"""Pictures of a mesh under its lightmap."""

import numpy as np
import pytest
import torch
from builders.atlas_meshes import charts, constant, sheet

from wlm.atlas.evaluation import original
from wlm.errors import WlmError
from wlm.ops.views import View
from wlm.view.atlas import draw
from wlm.view.display import white_of
from wlm.view.pictures import encode, save_png

FRONT = View.of((0.2, 0.1, 1.0))


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


def test_a_picture_in_no_folder(tmp_path):
    with pytest.raises(WlmError, match="cannot write"):
        save_png(tmp_path / "none" / "a.png", np.zeros((2, 2, 3), np.uint8))
    assert not list(tmp_path.iterdir())
