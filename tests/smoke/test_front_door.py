"""The calls of `wlm.smoke` as in the README, and the three ways to make lightmaps."""

import dataclasses

import pytest
import torch
from builders.checks import error_of
from builders.smoke_plumes import plume

import wlm
from wlm.errors import WlmError
from wlm.fluid.volume import save_volume
from wlm.smoke.codec import open_network
from wlm.smoke.network import prediction


@pytest.fixture
def smoke(tmp_path):
    save_volume(tmp_path / "cloud.npz", plume(hot=True))
    return wlm.smoke.load(tmp_path / "cloud.npz", extinction=0.2)


def test_the_snippet(smoke):
    camera = wlm.smoke.Camera.around(smoke, toward=(1, 0, 1), pixels=64)
    six = wlm.smoke.predict(smoke, camera)
    image = six.shade([wlm.smoke.Light((1, 1, 0.5))])
    assert image.shape == (64, 64, 3) and six.transparency.shape == (64, 64) and six.camera == camera
    assert torch.isfinite(image).all() and image.max() > 0
    over = six.shade([wlm.smoke.Light((1, 1, 0.5))], background=(0.5, 0.5, 0.5))
    torch.testing.assert_close(over, image + 0.5 * six.transparency[..., None])


def test_a_predictor_for_many_frames(smoke, monkeypatch):
    """One predictor serves more sizes than it keeps; the seed is that of the guiding map."""
    monkeypatch.setattr(prediction, "_SIZES", 1)
    predictor = wlm.smoke.SmokePredictor()
    cameras = [wlm.smoke.Camera.around(smoke, pixels=pixels) for pixels in (16, 8)]
    first = [wlm.smoke.predict(smoke, camera, predictor, seed=1) for camera in cameras]
    again = [predictor(smoke, camera, 1) for camera in cameras]
    assert all(torch.equal(a.lightmaps, b.lightmaps) for a, b in zip(first, again, strict=True))
    assert not torch.equal(predictor(smoke, cameras[0], 2).lightmaps, first[0].lightmaps)


def test_a_network_of_extreme_weights_is_an_error(smoke):
    """Half floats hold the weights, but float32 does not hold what they give."""
    model = open_network()
    with torch.no_grad():
        for weight in model.network.parameters():
            weight.fill_(65504.0)
    with pytest.raises(WlmError, match="the network predicts NaN or infinite light"):
        wlm.smoke.predict(smoke, wlm.smoke.Camera.around(smoke, pixels=16), model)


@pytest.mark.parametrize(("voxel", "origin"), [(1e-30, 0.0), (1.0, 1e30)])
def test_smoke_that_no_camera_can_frame_is_refused(voxel, origin):
    tiny = dataclasses.replace(plume(), voxel=voxel, origin=(origin,) * 3)
    assert "camera: the smoke is too small, or too far from 0" in error_of(wlm.smoke.Camera.around, tiny, pixels=8)
