"""What the network is compared with: a billboard that is seen from elsewhere."""

import numpy as np
import torch
from builders.smoke_plumes import plume

from benchmarks.rivals.smoke import billboard
from wlm.fluid.volume import DensityVolume
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake
from wlm.smoke.scene import CameraSettings, make_camera


def _camera(volume: DensityVolume, degrees: float = 0.0, **settings: object) -> Camera:
    given = CameraSettings(**{"extent": 1.6, "resolution": 32} | settings).turned(degrees)
    return make_camera(given, volume.origin, volume.voxel * np.asarray(volume.shape))


def _error(one: SixWay, other: SixWay) -> float:
    return float((one.lightmaps - other.lightmaps).square().mean().sqrt())


def test_billboard_from_the_same_side(device: str):
    """Nothing changes where the camera doesn't, with heat and without."""
    volume = plume(hot=True, device=device)
    camera = _camera(volume)
    baked = bake(volume, camera, estimate=False)
    shown = billboard(baked, camera, camera, volume.centre)
    for name in ("lightmaps", "transparency", "emission"):
        torch.testing.assert_close(getattr(shown, name), getattr(baked, name), atol=2e-6, rtol=0)
    cold = SixWay(baked.lightmaps, baked.transparency)
    assert billboard(cold, camera, camera, volume.centre).emission is None


def test_billboard_from_elsewhere(device: str):
    """A turn about the pivot shows the side that was baked, off by ever more; that is the error it is to have."""
    volume = plume(device=device)
    first = _camera(volume)
    baked = bake(volume, first, estimate=False)
    errors = []
    for degrees in (0.0, 30.0, 90.0):
        camera = _camera(volume, degrees)
        shown = billboard(baked, first, camera, volume.centre)
        torch.testing.assert_close(shown.lightmaps, baked.lightmaps, atol=1e-4, rtol=0)
        errors.append(_error(shown, bake(volume, camera, estimate=False)))
    assert errors[0] < 1e-4 < errors[1] < errors[2] and errors[2] > 0.03


def test_billboard_moves_with_the_image(device: str):
    """A camera that is shifted, nearer or finer sees the billboard there, as it sees the smoke itself."""
    volume = plume(device=device)
    first = _camera(volume, resolution=96)
    baked = bake(volume, first, estimate=False)
    target = tuple(volume.centre + np.array([0.3, -0.2, 0.0]))
    for settings in ({"target": target}, {"extent": 1.1}, {"resolution": 48}, {"aspect": 0.5}):
        camera = _camera(volume, **{"resolution": 96} | settings)
        want = bake(volume, camera, estimate=False)
        black = SixWay(torch.zeros_like(want.lightmaps), None)
        assert _error(billboard(baked, first, camera, volume.centre), want) < 0.05 * _error(black, want)
    away = _camera(volume, target=(9.0, 9.0, 9.0))
    shown = billboard(baked, first, away, volume.centre)
    assert not shown.lightmaps.any() and (shown.transparency == 1).all()
