"""Six-way lightmaps by the fine march: directions, the estimated error, and a path tracer."""

import itertools
import math

import numpy as np
import pytest
import torch
from builders.smoke_plumes import facing, unit_grid
from reference.single_light import lit

from benchmarks.path_tracer import PathTracer
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.camera import DIRECTIONS, RULES, VECTORS, Camera, weights
from wlm.smoke.lightmaps import axis_faults
from wlm.smoke.march.six_way import bake


def _plume(device: str = "cpu", extinction: float = 7.0) -> DensityVolume:
    return make_plume(28, hot=False, extinction=extinction, device=device)


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (1.0, 0.5, -0.3), (0.0, 1.0, 0.0)])
def test_names_of_the_axes(device: str, way: tuple):
    """The bright side of a dense ball has the right name from all views, and the check finds exchanged maps."""
    x, y, z = unit_grid(20)
    ball = np.clip(6 - 8 * np.sqrt(x**2 + y**2 + z**2), 0, 1).astype(np.float32)
    volume = from_array(ball, extinction=1.0, device=device)
    maps = bake(volume, facing(volume, way), step=1.0, estimate=False).lightmaps.cpu()
    assert axis_faults(maps) == ()
    for a, b in ((0, 1), (2, 3), (4, 5)):
        swapped = maps.clone()
        swapped[[a, b]] = maps[[b, a]]
        assert axis_faults(swapped)
    assert axis_faults(maps.flip(2)) and axis_faults(maps.flip(1)) and not axis_faults(torch.zeros_like(maps))
    maps[3] = 0.0
    assert axis_faults(maps) == ("no light in bottom",)


def test_halving_the_step(device: str):
    """Halving the step at least halves the error, until rounding; the estimate exceeds the remaining error."""
    volume = _plume(device, 24.0)
    camera = facing(volume, (0.4, 0.3, 1.0))
    fine = bake(volume, camera, step=1 / 16, estimate=False)
    errors, stated = [], []
    for step in (2.0, 1.0, 0.5, 0.25):
        maps = bake(volume, camera, step=step)
        off = (maps.lightmaps - fine.lightmaps).double()
        errors.append(float((off.square().mean() / fine.lightmaps.double().square().mean()).sqrt()))
        stated.append(maps.error.rms)
        assert float(off.abs().max()) < maps.error.largest
        assert float((maps.transparency - fine.transparency).abs().max()) < maps.error.transparency + 1e-6
    assert all(b < 0.5 * a for a, b in itertools.pairwise(errors))
    assert all(error < said for error, said in zip(errors, stated, strict=True))
    assert errors[2] < 0.01


def test_shading_approximates_oblique_lights(device: str):
    """Over twelve lights the squares are right on average; eq. 5's weights are about 1.5 times too bright."""
    volume = _plume(device)
    camera = facing(volume)
    six = bake(volume, camera, estimate=False).lightmaps.double().cpu()
    # The corners of an icosahedron, turned off the axes.
    golden = (1 + math.sqrt(5)) / 2
    corners = [np.roll((0, a, b * golden), k) for k in range(3) for a in (-1, 1) for b in (-1, 1)]
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    ways = np.array(corners) @ turn / math.sqrt(1 + golden**2)
    expected = torch.stack([lit(volume, camera, camera.axes.T @ way, step=0.7) for way in ways]).double().cpu()
    ratio, error = {}, {}
    for rule in RULES:
        result = torch.einsum("lc,chw->lhw", torch.tensor(weights(ways, rule)), six)
        ratio[rule] = float(result.sum() / expected.sum())
        error[rule] = float((result - expected).square().mean().sqrt())
    assert 0.9 < ratio["squared"] < 1.05 and 0.9 < ratio["normalised"] < 1.05
    assert 1.3 < ratio["absolute"] < 1.65
    assert error["squared"] < 0.6 * error["absolute"]


def test_supersampling(device: str):
    """A pixel of n x n rays is the mean of the n x n pixels of a finer image."""
    volume = _plume(device)
    camera = facing(volume, size=12)
    result = bake(volume, camera, step=1.0, supersample=3)
    fine = bake(volume, camera.finer(3), step=1.0)
    expected = torch.nn.functional.avg_pool2d(fine.lightmaps[None], 3)[0]
    np.testing.assert_allclose(result.lightmaps.cpu(), expected.cpu(), rtol=1e-6)
    assert result.lightmaps.shape == (6, 12, 12) and result.error.rms > 0


def test_emission(device: str):
    """A hot voxel in clear air emits along the ray; cold smoke has no emission."""
    hot = np.zeros((6, 6, 6), np.float32)
    hot[:, :, 2:4] = 0.5
    volume = from_array(np.zeros_like(hot), temperature=hot, emission=3.0, voxel=0.5, device=device)
    camera = Camera.look_at((1.5, 1.5, 9), (1.5, 1.5, 0), extent=0.5, height=2, width=2)
    six = bake(volume, camera, step=0.1)
    np.testing.assert_allclose(six.emission.cpu(), 3.0 * 0.5 * 2 * 0.5, rtol=1e-4)
    assert (six.transparency == 1).all() and not six.lightmaps.any()
    assert bake(_plume(device), camera).emission is None
    # Of a medium that also absorbs, L (1 - exp(-tau)) with L = emission / extinction.
    both = from_array(np.ones_like(hot), temperature=np.ones_like(hot), emission=3.0, extinction=0.7, device=device)
    camera = Camera.look_at((3, 3, 9), (3, 3, 0), extent=0.5, height=1, width=1)
    assert float(bake(both, camera, step=0.05).emission) == pytest.approx(3 / 0.7 * -math.expm1(-4.2), rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cube", "plume"])
def test_against_a_path_tracer(name: str):
    """Mitsuba's volumetric path tracer of one bounce: within 1% above its own noise, in every direction."""
    pytest.importorskip("mitsuba")
    volume = from_array(np.ones((12, 12, 12)), extinction=0.15) if name == "cube" else _plume()
    camera = facing(volume, size=16)
    trace = PathTracer(volume, camera, variant="scalar_rgb")
    ours = bake(volume, camera, step=0.25, supersample=4, estimate=False)
    for index, way in enumerate(VECTORS):
        runs = np.stack([trace.trace(way, 2048, seed) for seed in range(4)])
        expected = ours.lightmaps[index].double().numpy()
        light = runs[..., 0].astype(np.float64)
        energy, noise = np.square(expected).mean(), light.var(0, ddof=1).mean() / len(light)
        above = np.square(light.mean(0) - expected).mean() - noise
        # The noise itself is known to a few times sqrt(2 / pixels) of it, and the mean to its standard error.
        assert above < 1e-4 * energy + 4.0 * noise * math.sqrt(2.0 / expected.size), DIRECTIONS[index]
        assert abs(light.mean() - expected.mean()) < 0.002 * expected.mean() + 4.0 * math.sqrt(noise / expected.size)
    assert np.abs(1 - runs[..., 3].mean(0) - ours.transparency.numpy()).max() < 0.05
