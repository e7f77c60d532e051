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
