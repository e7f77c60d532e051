"""What the network is compared with: a billboard that is seen from elsewhere."""

import numpy as np
import pytest
import torch
from builders.smoke_plumes import plume
from builders.smoke_samples import small_pool

from benchmarks.rivals.smoke import billboard, coarse, flip_book
from wlm.fluid.volume import DensityVolume, save_volume
from wlm.smoke.camera import Camera
from wlm.smoke.evaluation import HeldOut, score
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.fine import bake
from wlm.smoke.network.dataset import fixed_cameras, pool_of_volume
from wlm.smoke.network.planes import GUIDES, PLANES, encode_lightmaps
from wlm.smoke.network.settings import DatasetSettings
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


def test_billboard_wrong_use(device: str):
    """Each wrong argument is named."""
    volume = plume(device=device)
    camera = _camera(volume)
    baked = bake(volume, camera, estimate=False)
    with pytest.raises(ValueError, match="orthographic"):
        billboard(baked, camera, _camera(volume, perspective=True), volume.centre)
    with pytest.raises(ValueError, match="32 x 32"):
        billboard(SixWay(baked.lightmaps[:, 1:], None), camera, camera, volume.centre)
    with pytest.raises(ValueError, match="transparency"):
        billboard(SixWay(baked.lightmaps, None), camera, camera, volume.centre)


def test_the_coarse_march_is_its_guide():
    pool = small_pool(2, kind="six")
    for name, plane in zip(PLANES, coarse(pool, slice(0, 2)).unbind(2), strict=True):
        assert torch.equal(plane, pool.guides[:, :, GUIDES["six"].index(name)].float())
    assert score(coarse, pool).psnr > 20
    with pytest.raises(ValueError, match="kind six"):
        coarse(small_pool(2), slice(0, 2))


def test_a_flip_book_is_the_billboard(tmp_path, device):
    """It shows the side that was baked from all others; samples that don't count are left out."""
    save_volume(tmp_path / "a.npz", plume())
    settings = DatasetSettings(cells=16, resolution=24, views=3)
    pool = pool_of_volume(tmp_path / "a.npz", settings, device=device, extinction=8.0)

    def held_out(keep: list[bool], views: int = 3) -> HeldOut:
        changed = settings.model_copy(update={"views": views})
        return HeldOut(pool, torch.tensor(keep, device=device), changed, lambda settings: pool)

    numbers, others, method = flip_book(held_out([True, True, True]))
    assert numbers.tolist() == [1, 2]
    assert len(pool) == 3 and len(others) == 2 and torch.equal(others.targets, pool.targets[1:])
    volume = plume(device=device)
    first, *rest = fixed_cameras(settings, volume.origin, volume.voxel * np.array(volume.shape))
    baked = bake(volume, first, step=settings.reference_step, estimate=False)
    for planes, camera in zip(method(others, slice(0, 2)), rest, strict=True):
        expected = encode_lightmaps(billboard(baked, first, camera, volume.centre))
        assert (planes - expected).abs().max() < 4e-3
    numbers, others, method = flip_book(held_out([False, False, True]))
    assert numbers.tolist() == [2] and len(others) == 1
    assert torch.equal(method(others, slice(0, 4)), pool.targets[:1].float())
    assert len(flip_book(held_out([True] * 3, views=1)).pool) == 0
    with pytest.raises(ValueError, match="whole sets of 2 views, got 3"):
        flip_book(held_out([True] * 3, views=2))
