"""Light by diffusion: its equation, point lights and fire against path tracing, and lights outside the smoke."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.smoke_plumes import plume

from benchmarks.smoke_learning import psnr
from benchmarks.smoke_tracing import trace
from demos.plume import make_plume
from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.camera import Camera, unit
from wlm.smoke.march.launch import in_bricks
from wlm.smoke.shading import Light, PointLight, Ramp, half_sphere
from wlm.smoke.transport.diffusion import CoarseSmoke, share_of
from wlm.smoke.transport.lighting import light_smoke, marching
from wlm.smoke.transport.orders import orders_march, scatter
from wlm_kernels.smoke import diffusion as kernels


def test_a_light_deep_in_thick_smoke_is_found(device: str):
    """Most of the light was scattered several times; its brightness and its position are right."""
    volume = make_plume(32, seed=5, hot=False, extinction=16.0, device=device)
    camera = Camera.around(volume, toward=(0.2, 0.4, 1.0), pixels=16)
    at = tuple(map(float, (np.argwhere(volume.density.cpu().numpy() > 0.4).mean(0) + 0.5) / 32))
    lamp = PointLight(at, (4 * math.pi, 2 * math.pi, 0.0), radius=0.06)
    wanted = trace(volume, camera, [lamp], albedo=(1.0, 0.9, 0.9), samples=512).total
    made = scatter(volume, camera, [lamp], (1.0, 0.9, 0.9))
    found, once = made.shade(), made.lit.shade(albedo=(1.0, 0.9, 0.9))
    for channel in (0, 1):
        assert float(found[..., channel].sum() / wanted[..., channel].sum()) == pytest.approx(1.0, abs=0.15)
        assert float(once[..., channel].sum() / wanted[..., channel].sum()) < 0.15
    scale = 1.0 / float(wanted.max())
    assert psnr(scale * found, scale * wanted) > psnr(scale * once, scale * wanted) + 10.0
    assert not found[..., 2].any()


def test_of_the_light_that_smoke_stops_no_cell_loses_any(device: str):
    """Opaque smoke stops all light of a point light; a thin slab stops the share that follows from its depth."""
    thick, camera = from_array(np.ones((12, 8, 10), np.float32), extinction=50.0, device=device), Camera.around(plume())
    thin = replace(thick, extinction=0.01)
    for volume, share in ((thick, 1.0), (thin, None)):
        coarse = CoarseSmoke(volume, 6)
        with marching(volume, camera, orders_march(volume)) as scene:
            stopped = torch.zeros_like(coarse.extinction)
            coarse.around(scene, (6.2, 3.9, 5.1), 0.0, stopped)
        found = float(stopped.sum()) * math.prod(coarse.edges) / (16 * math.pi**2)
        if share is None:
            ways = half_sphere(2000)
            ways = np.concatenate([ways, -ways])
            low, high = (np.array(edge) - (6.2, 3.9, 5.1) for edge in ((0, 0, 0), (12, 8, 10)))
            inside = np.minimum(np.where(ways > 0, high, low) / ways, 1e9).min(1)
            share = float(1 - np.exp(-0.01 * inside).mean())
        assert found == pytest.approx(share, rel=0.02)


def test_cells_have_the_mean_of_their_voxels(device: str):
    """A voxel that two cells share counts for each by its part in it; bricks without smoke may be hot."""
    volume = in_bricks(plume(hot=True, device=device))
    coarse = CoarseSmoke(volume, 7)
    shares = []
    for n, count in zip(volume.shape, coarse.extinction.shape, strict=True):
        edges = np.arange(count + 1) * n / count
        low, high = np.maximum(np.arange(n)[:, None], edges[:-1]), np.minimum(np.arange(1, n + 1)[:, None], edges[1:])
        shares.append(np.maximum(high - low, 0.0) * count / n)
    mean = coarse.extinction / (volume.extinction * volume.voxel)
    for found, voxels in ((mean, volume.density), (coarse.mean(hot=True), volume.temperature)):
        expected = np.einsum("xyz,xi,yj,zk->ijk", voxels.cpu().double().numpy(), *shares)
        np.testing.assert_allclose(found.cpu().numpy(), expected, rtol=1e-5, atol=1e-6 * expected.max())


def stopped_by_cells(coarse: CoarseSmoke, volume: DensityVolume, lights: Sequence[Light]) -> torch.Tensor:
    """Returns the light of irradiance 4 pi that cells stop, [L, X, Y, Z]."""
    source = torch.zeros(len(lights), *coarse.extinction.shape, device=volume.device)
    with marching(volume, Camera.around(volume, pixels=4), orders_march(volume)) as scene:
        for light, out in zip(lights, source, strict=True):
            coarse.lit(scene, scene.reach(unit(light.toward), None), out)
    return source


def test_parallel_light_is_stopped_as_beer_says(device: str):
    """Uniform smoke follows the Beer-Lambert law in each cell; opaque smoke stops all light on the box."""
    lights = [Light((0.0, 1.0, 0.0)), Light((1.0, 1.0, 1.0))]
    thick = from_array(np.ones((16, 32, 24), np.float32), extinction=2.0, device=device)
    coarse = CoarseSmoke(thick, 32)
    assert coarse.edges == (1.0, 1.0, 1.0)
    found = stopped_by_cells(coarse, thick, lights)
    sides = 16 * 24 / 3**0.5 + 32 * 24 / 3**0.5 + 16 * 32 / 3**0.5
    # Before the cells there is half a voxel more of smoke, which fades out.
    assert float(found[0].sum()) == pytest.approx(4 * math.pi * 16 * 24 * math.exp(-0.25), rel=0.03)
    assert float(found[1].sum()) == pytest.approx(4 * math.pi * sides * math.exp(-0.25 * 3**0.5), rel=0.08)
    thin = replace(thick, extinction=0.1)
    found = stopped_by_cells(CoarseSmoke(thin, 8), thin, lights[:1])[0].cpu().numpy() / (4 * math.pi)
    shares = np.diff(np.exp(-0.1 * np.arange(32.0, -1.0, -4.0)))
    assert found.shape == (4, 8, 6) and 4.0 * found[1, :, 2] == pytest.approx(shares, rel=0.04)


def test_diffused_light_fades_as_its_equation_says(device: str, monkeypatch):
    """Deep in uniform smoke light falls as exp(-k x), where k^2 D = (1 - a) s with the limited D."""
    # There is so little light that it takes more sweeps to be found.
    monkeypatch.setattr(kernels, "_ROUNDS", 4)
    monkeypatch.setattr(kernels, "_SWEEPS", 24)
    volume = from_array(np.ones((24, 24, 24), np.float32), extinction=30.0, voxel=1 / 24, device=device)
    coarse = CoarseSmoke(volume, 24)
    lights = [Light((0.0, 1.0, 0.0)), Light((0.0, -1.0, 0.0))]
    down, up = coarse.spread(stopped_by_cells(coarse, volume, lights), [0.9])[:, 12, :, 12].cpu().numpy()
    lost, steepest = 3.0, 3.0 * 30.0
    expected = max(np.roots([1.0, -lost, -steepest * lost]))
    assert 24 * np.log(down[8:17] / down[7:16]) == pytest.approx(expected, rel=0.03)
    # From the other side as from this one.
    assert up[::-1] == pytest.approx(down, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize("shape", [(32, 24, 32), (20, 9, 13), (1, 24, 3), (1, 1, 1)])
def test_coarser_grids_lead_to_the_same_fluence(device: str, shape: tuple[int, int, int], monkeypatch):
    """The result is within 4% of many rounds on the finest grid alone, in boxes of any shape."""
    density = make_plume(32, seed=3, hot=False).density[:, 8:, :][tuple(slice(n) for n in shape)].numpy() + 0.05
    volume = from_array(density, extinction=20.0, voxel=1 / max(shape), device=device)
    coarse = CoarseSmoke(volume, 16)
    source = stopped_by_cells(coarse, volume, [Light((0.3, 1.0, 0.2))])
    found = coarse.spread(source, [0.8, 1.0])
    monkeypatch.setattr(kernels, "_FEWEST", 1 << 20)
    monkeypatch.setattr(kernels, "_FIRST", 12)
    monkeypatch.setattr(kernels, "_SWEEPS", 120)
    exact = coarse.spread(source, [0.8, 1.0])
    error = (found - exact).square().mean((1, 2, 3)).sqrt() / exact.square().mean((1, 2, 3)).sqrt()
    assert float(error.max()) < 0.04 and (found >= 0).all()


def test_diffusion_fades_out_beside_the_smoke():
    """The result is continuous for a light that leaves the box: diffusion, a blend, then the fitted weights."""
    volume, camera = make_plume(16, hot=False, extinction=8.0), Camera.around(plume(), pixels=8)
    heights = (0.98, 0.9999, 1.0001, 1.1, 1.2499, 1.2501)
    shares = [share_of(PointLight((0.5, y, 0.5)), volume) for y in heights]
    assert shares == pytest.approx([1.0, 1.0, 1.0, 0.6, 0.0, 0.0], abs=1e-3) and not share_of(Light((1, 1, 1)), volume)
    for pair in (heights[1:3], heights[4:]):
        one, other = (scatter(volume, camera, [PointLight((0.5, y, 0.5))]).planes for y in pair)
        assert torch.allclose(one, other, rtol=0.01, atol=1e-3)


def test_fire_lights_its_smoke(device: str):
    """The scattered light of fire is as bright as traced, and has the colour of the fire."""
    volume = replace(make_plume(32, seed=4, hot=True, extinction=20.0, device=device), emission=10.0)
    camera = Camera.around(volume, toward=(0.3, 0.2, 1.0), pixels=16)
    traced = trace(volume, camera, [], albedo=(0.9, 0.9, 0.0), samples=384, orders=1)
    wanted, made = traced.planes[0], scatter(volume, camera, [], (0.9, 0.9, 0.0))
    thrown = made.lit.thrown
    assert float(thrown[..., 0].sum() / wanted[1:, ..., 0].sum()) == pytest.approx(1.0, abs=0.12)
    assert torch.equal(thrown[..., 0], thrown[..., 1]) and not thrown[..., 2].any()
    whole, scale = wanted.sum(0)[..., 0], 1.0 / float(wanted.sum(0).max())
    without = psnr(scale * made.lit.emission, scale * whole)
    assert psnr(scale * made.shade()[..., 0], scale * whole) > without + 5.0
    red = made.shade(ramp=Ramp((0.0, 100.0), ((0.0, 0.0, 0.0), (100.0, 50.0, 0.0))))
    assert torch.allclose(red[..., 1], 0.5 * red[..., 0], rtol=1e-4) and not red[..., 2].any()
    assert torch.allclose(red[..., 0], made.shade()[..., 0], rtol=1e-4)
    # Not of cold smoke, nor where light is scattered once alone.
    assert light_smoke(volume, camera, []).thrown is None
    assert scatter(replace(volume, temperature=None), camera, []).lit.thrown is None
