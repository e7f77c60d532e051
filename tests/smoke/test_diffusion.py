"""Light by diffusion: of point lights in smoke and of fire, against path tracing, and where it goes over to others."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.smoke_plumes import plume

from wlm.fluid.volume import from_array
from wlm.smoke.camera import Camera
from wlm.smoke.learn.synthetic import make_plume
from wlm.smoke.shading import Light, Ramp
from wlm.smoke.transport.diffusion import CoarseSmoke, share_of
from wlm.smoke.transport.features import orders_march
from wlm.smoke.transport.filtering import scatter
from wlm.smoke.transport.learning import psnr
from wlm.smoke.transport.lighting import light_smoke, marching
from wlm.smoke.transport.lights import PointLight, half_sphere
from wlm.smoke.transport.tracing import trace


def test_a_light_deep_in_thick_smoke_is_found(device: str):
    """Of the light that comes out, nearly all of it scattered again: its brightness, and where it is."""
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
    """From a point in smoke that nothing gets through, and in a thin slab: all of it, and what its depth says."""
    thick, camera = from_array(np.ones((12, 8, 10), np.float32), extinction=50.0, device=device), Camera.around(plume())
    thin = replace(thick, extinction=0.01)
    for volume, share in ((thick, 1.0), (thin, None)):
        coarse = CoarseSmoke(volume, 6)
        with marching(volume, camera, orders_march(volume)) as scene:
            stopped = coarse.around(scene, (6.2, 3.9, 5.1), 0.0)
        found = float(stopped.sum()) * math.prod(coarse.edges) / (16 * math.pi**2)
        if share is None:
            ways = half_sphere(2000)
            ways = np.concatenate([ways, -ways])
            low, high = (np.array(edge) - (6.2, 3.9, 5.1) for edge in ((0, 0, 0), (12, 8, 10)))
            inside = np.minimum(np.where(ways > 0, high, low) / ways, 1e9).min(1)
            share = float(1 - np.exp(-0.01 * inside).mean())
        assert found == pytest.approx(share, rel=0.02)


def test_diffusion_fades_out_beside_the_smoke():
    """A light that leaves the smoke's box is lit by diffusion, then by both, then by the filter, without a jump."""
    volume, camera = make_plume(16, hot=False, extinction=8.0), Camera.around(plume(), pixels=8)
    heights = (0.98, 0.9999, 1.0001, 1.1, 1.2499, 1.2501)
    shares = [share_of(PointLight((0.5, y, 0.5)), volume) for y in heights]
    assert shares == pytest.approx([1.0, 1.0, 1.0, 0.6, 0.0, 0.0], abs=1e-3) and not share_of(Light((1, 1, 1)), volume)
    made = [scatter(volume, camera, [PointLight((0.5, y, 0.5))]).planes for y in heights]
    for one, other in ((1, 2), (4, 5)):
        assert torch.allclose(made[one], made[other], rtol=0.01, atol=1e-3)


def test_fire_lights_its_smoke(device: str):
    """What smoke scatters of it: as bright as traced, and the picture much nearer; in the colour of the fire."""
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
