"""The march to each light: against a march from every sample, the path tracer, and six-way lightmaps."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import warp as wp
from builders.smoke_plumes import facing, plume
from reference.single_light import lit

from benchmarks.smoke_tracing import trace
from demos.plume import make_plume
from wlm.fluid.volume import from_array, gather
from wlm.smoke.camera import Camera
from wlm.smoke.march.motion import motion
from wlm.smoke.march.six_way import bake, bake_coarse, guide
from wlm.smoke.shading import Light, PointLight, sky_lights
from wlm.smoke.transport.lighting import fine_march, light_smoke
from wlm.smoke.transport.orders import scatter
from wlm_kernels.smoke.settings import March

WAYS = [(1.0, 0.7, 0.8), (-0.3, -0.9, 0.5), (0.0, 0.0, -1.0)]


def rms(a: torch.Tensor, b: torch.Tensor) -> float:
    """Returns the RMS of the difference relative to that of `b`."""
    return float(((a - b).double().square().mean() / b.double().square().mean()).sqrt())


@pytest.mark.parametrize(("g", "perspective"), [(0.0, True), (0.6, False)])
def test_each_light_has_its_own_march(device: str, g: float, perspective: bool):
    """Lights from any direction and their opposites are within 0.5% of a march from every sample."""
    volume = make_plume(28, hot=False, extinction=10.0, device=device)
    camera = Camera.around(volume, toward=(0.4, 0.2, 1.0), pixels=12, perspective=perspective)
    made = light_smoke(volume, camera, [Light(way) for way in WAYS], fine_march(volume, g))
    for n, way in enumerate(WAYS):
        for plane, sign in ((made.planes[n], 1.0), (made.opposite[n], -1.0)):
            expected = lit(volume, camera, sign * np.array(way), step=0.25, g=g)
            assert abs(float(plane.mean() / expected.mean()) - 1) < 0.005
            assert rms(plane, expected) < 0.01


@pytest.mark.parametrize("inside", [False, True])
def test_point_lights_against_the_tracer(device: str, inside: bool):
    volume = make_plume(20, hot=False, extinction=8.0, device=device)
    camera = facing(volume, size=10)
    lamp = PointLight((0.55, 0.6, 0.5) if inside else (1.4, 1.2, 1.1), (3.0, 2.0, 0.0), radius=0.15)
    made = light_smoke(volume, camera, [lamp], March(step=0.35, jitter=0.0, g=0.3)).shade(albedo=(1.0, 0.5, 1.0))
    traced = trace(volume, camera, [lamp], albedo=(1.0, 0.5, 1.0), g=0.3, samples=8192, highest=1, seed=7)
    assert abs(float(made.mean() / traced.total.mean()) - 1) < 0.01
    assert rms(made, traced.total) < 0.04
    assert not made[..., 2].any()


@pytest.mark.parametrize("half", [False, True])
def test_smoke_in_bricks_is_lit_as_in_all_voxels(device: str, half: bool):
    """Every march of bricks gives the light of the dense volume; the box is no whole number of bricks."""
    dense = plume(hot=True, device=device)
    if half:
        dense = replace(dense, density=dense.density.half(), temperature=dense.temperature.half())
    numbers, values = gather([dense.density, dense.temperature])
    places = torch.zeros(3 * 3 * 3, dtype=torch.int32, device=device)
    places[numbers.long()] = torch.arange(1, len(numbers) + 1, dtype=torch.int32, device=device)
    density, temperature = (torch.cat([torch.zeros_like(part[:1]), part]) for part in values)
    where = {"places": places.view(3, 3, 3), "cells": dense.shape}
    bricks = replace(dense, density=density, temperature=temperature, **where)
    assert 1 < len(density) < 27 and bricks.shape == dense.shape and bricks.thickness == pytest.approx(dense.thickness)
    camera = facing(dense, (0.4, 0.3, 1.0), 16)
    lights = [Light((1.0, 0.5, 0.2)), PointLight((-0.5, 0.9, 0.3), (1.0, 2.0, 3.0))]
    velocity = wp.array(np.full((5, 6, 5, 3), 0.1), dtype=wp.vec3, device=device)
    for march in (
        lambda volume: scatter(volume, camera, lights).shade(),
        lambda volume: bake(volume, camera, estimate=False).lightmaps,
        lambda volume: bake_coarse(volume, camera, March(2.5)).lightmaps,
        lambda volume: guide(volume, camera, March(3.0)).maps,
        lambda volume: motion(volume, velocity, camera, reach=0.2),
    ):
        part, whole = march(bricks), march(dense)
        assert whole.any()
        torch.testing.assert_close(part, whole, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("z", [4.0, 4.5])
def test_a_point_light_at_a_sample_is_no_brighter_than_beside_it(device: str, z: float):
    volume = from_array(np.ones((9, 9, 9), np.float32), extinction=0.05, device=device)
    camera = Camera.around(volume, toward=(0, 0, 1), pixels=9)
    made = light_smoke(volume, camera, [PointLight((4.5, 4.5, z))], March(step=1.0, jitter=0.0)).planes
    assert 0.05 < float(made.max()) < 2.0


def test_the_whole_picture_is_the_tracers(device: str):
    """Coloured lights, albedo, emission and background give the first traced order."""
    volume = make_plume(28, hot=True, extinction=8.0, device=device)
    camera = facing(volume, (0.2, 0.1, 1.0), size=12)
    lights = [Light((1.0, 0.7, 0.8), (6.0, 3.0, 1.0)), Light((-1.0, 0.1, 0.2), (0.0, 4.0, 8.0))]
    made = light_smoke(volume, camera, lights).shade(albedo=(0.9, 0.6, 0.3), background=(0.2, 0.2, 0.5))
    traced = trace(volume, camera, lights, albedo=(0.9, 0.6, 0.3), samples=4096, highest=1)
    # Emission that is scattered isn't in the march.
    wanted = traced.planes[:2].sum((0, 1)) + traced.planes[2, 0]
    clear = bake(volume, camera, step=0.25).transparency[..., None]
    wanted = wanted + clear * torch.tensor([0.2, 0.2, 0.5], device=device)
    assert abs(float(made.mean() / wanted.mean()) - 1) < 0.005
    assert rms(made, wanted) < 0.02


def test_a_sky_is_twelve_lights(device: str):
    """The lights have all light of the sky, and the picture is near the traced one."""
    sky = (0.3, 0.3, 0.6)
    lights = sky_lights(sky)
    total = sum(np.array(light.irradiance) for light in lights)
    assert len(lights) == 12 and total == pytest.approx(4 * math.pi * np.array(sky))
    assert np.abs(sum(np.array(light.toward) for light in lights)).max() < 1e-6
    volume = make_plume(20, seed=6, hot=False, extinction=12.0, device=device)
    camera = Camera.around(volume, toward=(0.3, 0.2, 1.0), pixels=10)
    wanted = trace(volume, camera, [], sky=sky, samples=192, orders=0, highest=1).planes[0, 1:].sum(0)
    made = light_smoke(volume, camera, lights).shade()
    assert float(made.mean() / wanted.mean()) == pytest.approx(1.0, abs=0.03) and rms(made, wanted) < 0.13
