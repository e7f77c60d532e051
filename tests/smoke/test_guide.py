"""Guiding maps in world units: depth, cameras, and the error of the step."""

import numpy as np
import pytest
from builders.smoke_plumes import rays, unit_grid

from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.camera import Camera
from wlm.smoke.march.six_way import guide
from wlm_kernels.smoke.settings import March


def _ball(device: str, n: int = 32, voxel: float = 0.5, extinction: float = 0.4) -> DensityVolume:
    """Makes a soft ball with a bump, away from the world's origin."""
    x, y, z = unit_grid(n)
    density = np.clip(1.6 - 2 * np.sqrt(x**2 + y**2 + z**2), 0, 1) * (1 + 0.5 * np.sin(5 * x) * np.cos(4 * y))
    place = (10.0, -3.0, 5.0)
    return from_array(density.astype(np.float32), extinction=extinction, voxel=voxel, origin=place, device=device)


def _camera(volume: DensityVolume, way: tuple = (0.3, 0.4, 1.0), distance: float = 30.0, **options) -> Camera:
    target = volume.centre
    extent = options.pop("extent", 16.0)
    position = target + distance * np.array(way) / np.linalg.norm(way)
    return Camera.look_at(position, target, extent=extent, height=24, width=24, **options)


@pytest.mark.parametrize("perspective", [False, True])
def test_depth_is_in_the_world(device: str, perspective: bool):
    """A pixel's depth ends on the surface of the ball; scaling and moving the world changes nothing else."""
    volume = _ball(device)
    camera = _camera(volume, extent=0.4 if perspective else 16.0, perspective=perspective)
    result = guide(volume, camera, March(0.5, jitter=0.0, threshold=0.05))
    origin, way = rays(camera)
    depth = result.depth.cpu().numpy().astype(np.float64)
    hit = depth > 0
    assert 50 < hit.sum() < 24 * 24
    distance = np.linalg.norm((origin + depth[..., None] * way - volume.centre)[hit], axis=1)
    # A density of 0.25, the threshold, lies at 0.55 to 0.72 of the half size, 8, as the bumps go.
    assert distance.min() > 4.2 and distance.max() < 5.8
    twice = DensityVolume(volume.density, 0.5 * volume.extinction, 2 * volume.voxel, (0.0, 0.0, 0.0))
    far = _camera(twice, distance=60.0, extent=0.4 if perspective else 32.0, perspective=perspective)
    other = guide(twice, far, March(0.5, jitter=0.0, threshold=0.05))
    np.testing.assert_allclose(other.light.cpu(), result.light.cpu(), atol=2e-4)
    np.testing.assert_allclose(other.depth.cpu(), 2 * result.depth.cpu(), atol=2e-3)


def test_distance_of_an_orthographic_camera(device: str):
    """The distance changes only the depths, by the same amount, also from very far away."""
    volume = _ball(device)
    cameras = (_camera(volume, distance=distance) for distance in (30.0, 30_000.0))
    near, far = (guide(volume, camera, March(1.0, jitter=0.0)) for camera in cameras)
    np.testing.assert_allclose(far.maps[:2].cpu(), near.maps[:2].cpu(), atol=1e-3)
    hit = (near.depth > 0) & (far.depth > 0)
    np.testing.assert_allclose((far.depth - near.depth)[hit].cpu(), 29_970.0, atol=0.3)
    assert (far.depth[near.depth == 0] == 0).float().mean() > 0.99
