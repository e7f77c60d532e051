"""Six-way lightmaps by a coarse march: against the fine march, the guiding map, and closed forms."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from builders.smoke_plumes import facing, plume
from reference.marching import trilinear

from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake, bake_coarse, guide, march_planes
from wlm_kernels.smoke import depth_lattice, marches
from wlm_kernels.smoke import march as kernels
from wlm_kernels.smoke.settings import March

TURNED = (0.5, 0.3, 1.0)
VIEWS = {"turned": TURNED, "diagonal": (1.0, 1.0, 1.0), "above": (0.0, 1.0, 0.0), "axis": (0.0, 0.0, 1.0)}


def _camera(volume: DensityVolume, size: int = 24, toward: tuple[float, float, float] = TURNED) -> Camera:
    up = (0.3, 1.0, 0.2) if toward == TURNED else (0.0, 1.0, 0.0)
    return facing(volume, toward, size, world_up=up, extent=1.2 * max(volume.shape) * volume.voxel)


def _march(volume: DensityVolume, camera: Camera, **settings) -> SixWay:
    return bake_coarse(volume, camera, March(**settings))


def _planes(volume: DensityVolume, camera: Camera, **settings) -> torch.Tensor:
    return march_planes(volume, camera, March(**settings))


def _errors(result: SixWay, exact: SixWay) -> tuple[float, float]:
    """Returns the largest and the mean error of any plane, relative to the plane's largest value."""
    pairs = [*zip(result.lightmaps, exact.lightmaps, strict=True), (result.transparency, exact.transparency)]
    if exact.emission is not None:
        pairs += [(result.emission, exact.emission)]
    errors = [(a - b).abs() / b.abs().max() for a, b in pairs]
    return max(float(e.max()) for e in errors), max(float(e.mean()) for e in errors)


def _blob(shape: tuple[int, int, int], device: str) -> DensityVolume:
    """Makes smooth smoke that is thin at the border of the box."""
    axes = [np.linspace(-1, 1, n + 2)[1:-1] for n in shape]
    x, y, z = np.meshgrid(*axes, indexing="ij")
    density = np.exp(-4 * (x * x + y * y + z * z + x * y)) * (1 + 0.4 * np.sin(4 * x + 3 * z))
    return from_array(density.astype(np.float32), extinction=0.5, device=device)


@pytest.mark.parametrize("view", VIEWS)
def test_small_steps_give_the_fine_march(device: str, view: str):
    """All planes of hot smoke with an anisotropic phase function, from all views."""
    volume = plume(hot=True, device=device)
    camera = _camera(volume, toward=VIEWS[view])
    exact = bake(volume, camera, step=0.25, g=0.4, estimate=False)
    errors = []
    for step, spacing in ((4.0, 4.0), (2.0, 2.0), (0.5, 1.0)):
        result = _march(volume, camera, step=step, spacing=spacing, jitter=0.0, g=0.4)
        errors.append(_errors(result, exact))
    # Where the box cuts smoke off, the shadow ends within a gap between nodes.
    assert errors[2][0] < 0.06 and errors[2][1] < 0.004
    assert errors[2][1] < 0.5 * errors[1][1] < 0.3 * errors[0][1]


@pytest.mark.parametrize("view", ["turned", "axis"])
@pytest.mark.parametrize("shape", [(20, 20, 20), (5, 30, 12), (1, 16, 16), (16, 1, 16), (1, 1, 24)])
def test_boxes(device: str, shape: tuple[int, int, int], view: str):
    """Boxes of any shape, also thin ones, with smoke up to the border."""
    rng = np.random.default_rng(5)
    volume = from_array(rng.uniform(0.5, 1.0, shape).astype(np.float32), extinction=0.1, device=device)
    camera = _camera(volume, 32, VIEWS[view])
    exact = bake(volume, camera, step=0.25, estimate=False)
    result = _march(volume, camera, step=0.5, spacing=1.0, jitter=0.0)
    most, mean = _errors(result, exact)
    # Light that grazes a sheet changes within it by more than nodes a voxel apart can follow.
    limits = (0.03, 0.004) if min(shape) > 1 else (0.12, 0.02)
    assert most < limits[0] and mean < limits[1]


def test_a_pixel_by_float64(device: str):
    """The definition in float64, without shared work."""
    volume = _blob((12, 14, 10), device)
    middle = np.array([6.2, 7.5, 5.1])
    camera = Camera.look_at((30.0, 22.0, 41.0), middle, world_up=(0.3, 1.0, 0.1), extent=1.0, height=1, width=1)
    density, h = volume.density.cpu().numpy(), 0.1
    way = h * (np.arange(300) + 0.5)
    right, up, toward = camera.axes
    # The camera is farther off, and 15 voxels on either side of the middle there is nothing.
    ray = middle + np.outer(15.0 - way, toward)
    x = volume.extinction * h * trilinear(density, ray)
    passed = np.cumsum(x) - x
    share = np.exp(-passed) * -np.expm1(-x)
    result = _march(volume, camera, step=0.1, spacing=0.5, jitter=0.0, cutoff=0.0)
    for name, light in (("right", right), ("left", -right), ("top", up), ("bottom", -up)):
        tau = volume.extinction * h * trilinear(density, ray[:, None] + way[:, None] * light).sum(1)
        assert float(result[name]) == pytest.approx(float((share * np.exp(-tau)).sum()), rel=0.01)
    t = np.exp(-x.sum())
    assert float(result.transparency) == pytest.approx(t, rel=1e-3)
    assert float(result["front"]) == pytest.approx(0.5 * (1 - t * t), rel=1e-3)
    assert float(result["back"]) == pytest.approx(-t * np.log(t), rel=1e-3)


def test_sums_are_the_guiding_map(device: str):
    """Front, top and bottom add up to the guide's light; without jitter depth and transparency are equal."""
    volume = plume(device=device)
    camera = _camera(volume)
    settings = {"jitter": 0.0, "threshold": 0.05, "g": -0.2}
    six, maps = (method(volume, camera, March(2.5, **settings)) for method in (bake_coarse, guide))
    torch.testing.assert_close(six.transparency, maps.transparency, rtol=0, atol=1e-6)
    torch.testing.assert_close(six.depth, maps.depth, rtol=0, atol=1e-5)
    six, maps = (method(volume, camera, March(1.0, **settings)) for method in (bake_coarse, guide))
    light = six["front"] + six["top"] + six["bottom"]
    assert float((light - maps.light).abs().mean()) < 0.005 * float(maps.light.max())


def test_empty_bricks_change_nothing(device: str, monkeypatch):
    volume = plume(1, hot=True, device=device)
    volume = replace(volume, density=volume.density.half(), temperature=volume.temperature.half())
    camera = _camera(volume)
    skipped = _planes(volume, camera, step=1.5)
    made = []
    occupied = kernels.occupied
    monkeypatch.setattr(kernels, "occupied", lambda medium: made.append(occupied(medium)) or made[-1])
    _march(volume, camera, step=7.9)
    (bricks,) = made
    assert 0 < bricks.numpy().sum() < bricks.size
    monkeypatch.setattr(marches, "BRICK", 0)
    torch.testing.assert_close(_planes(volume, camera, step=1.5), skipped, rtol=0, atol=1e-6)
    assert len(made) == 1
    # A volume need not be contiguous.
    turned = replace(volume, density=volume.density.mT.contiguous().mT)
    torch.testing.assert_close(_planes(turned, camera, step=1.5), skipped, rtol=0, atol=1e-6)


def _shifts(seed: int, device: str, size: int = 64, jitter: float = 1.0) -> torch.Tensor:
    """Returns the jitter of a single step through the box, measured by the depth of its sample."""
    volume = from_array(np.ones((8, 8, 8), np.float32), device=device)
    camera = Camera.look_at((4.0, 4.0, 18.5), (4.0, 4.0, 4.0), extent=6.0, height=size, width=size)
    result = _march(volume, camera, step=9.0, jitter=jitter, seed=seed, threshold=0.0)
    return (result.depth.cpu().double() - 10.0) / 9.0


@pytest.mark.parametrize("seed", [1, 63, 64 * 10**12 + 9, -3])
def test_jitter(device: str, seed: int):
    """The noise is Jimenez's with 64 patterns; half the jitter has half the range."""
    result = _shifts(seed, device)
    assert float(result.min()) > -1e-6 and float(result.max()) < 1.0
    y, x = np.mgrid[:64, :64] + 5.588238 * (seed % 64)
    expected = np.mod(52.9829189 * np.mod(0.06711056 * x + 0.00583715 * y, 1.0), 1.0)
    off = np.abs(result.numpy() - expected)
    assert np.minimum(off, 1.0 - off).max() < 2e-3
    assert torch.equal(result, _shifts(seed, device)) and torch.equal(result, _shifts(seed % 64 + 128, device))
    assert float((result - _shifts(seed + 1, device)).abs().mean()) > 0.1
    half = _shifts(seed, device, jitter=0.5)
    torch.testing.assert_close(half, 0.5 + 0.5 * (result - 0.5), rtol=0, atol=1e-6)


def test_nodes_are_bounded(device: str):
    """The number of nodes is bounded for any spacing and any box."""
    volume = _blob((12, 9, 10), device)
    camera = _camera(volume)
    expected = _planes(volume, camera, step=1.0, spacing=0.25)
    torch.testing.assert_close(_planes(volume, camera, step=1.0, spacing=0.01), expected, rtol=0, atol=2e-3)
    for shape, spacing in (((400, 400, 400), 1.0), ((10**6, 1, 1), 5.0), ((2, 30000, 30000), 1e-3)):
        box = SimpleNamespace(origin=np.zeros(3), voxel=1.0, shape=shape)
        view = _camera(volume, toward=VIEWS["diagonal"]).view(box)
        axes = (view.right, view.up, view.forward)
        lattice, counts = depth_lattice.make_lattice(shape, axes, spacing, view.origin)
        assert min(counts) >= 2 and np.prod(counts, dtype=float) < 1.01 * 2**28
        # They cover the eight corners.
        corners = np.array(list(np.ndindex(2, 2, 2))) * (np.array(shape) + 1.0) - 0.5 - np.array(view.origin)
        for axis, along in enumerate(axes):
            ends = lattice.low[axis], lattice.low[axis] + (counts[axis] - 1) * lattice.gap[axis]
            reach = corners @ np.array(along)
            assert ends == pytest.approx((reach.min(), reach.max()), rel=1e-5, abs=1e-2)
    far = _planes(volume, camera, step=1.0, spacing=1e30)
    assert torch.isfinite(far).all()
