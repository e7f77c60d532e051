"""The path tracer: orders against quadrature and Mitsuba, energy, all kinds of lights, obstacles, hard cases."""

import math

import numpy as np
import pytest
import torch
from builders.smoke_plumes import facing, unit_grid
from reference.marching import Scene
from reference.single_light import lit
from reference.transport import scattered_twice

from benchmarks import smoke_path
from benchmarks.path_tracer import PathTracer
from benchmarks.smoke_tracing import Transport, trace
from demos.plume import make_plume
from wlm.errors import WlmError
from wlm.fluid.obstacles import surface
from wlm.fluid.volume import DensityVolume, from_array
from wlm.smoke.march.launch import medium_of
from wlm.smoke.march.six_way import bake
from wlm.smoke.shading import Light, PointLight
from wlm_kernels.smoke.march import BRICK

WAY = (1.0, 0.7, 0.8)


def ball(n: int = 12, depth: float = 4.0, device: str = "cpu") -> DensityVolume:
    """Makes a soft ball with an optical depth through its middle, in a box of edge 1."""
    x, y, z = unit_grid(n)
    density = np.clip(1.5 - 1.5 * np.sqrt(x**2 + y**2 + z**2), 0, 1).astype(np.float32)
    return from_array(density, extinction=depth, voxel=1.0 / n, device=device)


def close(traced: torch.Tensor, noise: torch.Tensor, expected: torch.Tensor, share: float) -> None:
    """Checks the mean against a relative limit, and the pixels against the stated noise."""
    assert noise.square().sum().sqrt() / noise.numel() < 0.6 * share * expected.mean()  # or nothing is shown
    assert abs(float(traced.mean() / expected.mean()) - 1.0) < share
    assert 0.6 < float((traced - expected).square().mean() / noise.square().mean()) < 1.6


@pytest.mark.parametrize("g", [-0.3, pytest.param(0.0, marks=pytest.mark.slow), 0.6])
def test_the_first_order_is_single_scattering(device: str, g: float):
    """The mean is within 0.5% of the march from every sample, the pixels within the stated noise."""
    volume = make_plume(24, hot=False, extinction=14.0, device=device)
    camera = facing(volume, (0.3, 0.2, 1.0), size=20)
    lights = [Light(WAY), Light((0.0, 0.3, -1.0))]
    traced = trace(volume, camera, lights, g=g, samples=2304, highest=1, seed=3)
    for n, light in enumerate(lights):
        expected = lit(volume, camera, light.toward, step=0.25, g=g)
        close(traced.planes[n, 1, ..., 1], traced.noise[n, ..., 1], expected, 0.005)
    assert not traced.planes[:, [0, 2]].any()


def test_the_second_order_is_that_of_quadrature(device: str):
    volume = ball(4, depth=2.5, device=device)
    camera = facing(volume, (0.2, -0.1, 1.0), size=2)
    toward = np.array(WAY) / np.linalg.norm(WAY)
    position = np.array(camera.position) / volume.voxel
    axes = [np.array(axis) for axis in (camera.right, camera.up, camera.toward)]
    density, extinction = volume.density.cpu().numpy(), volume.extinction * volume.voxel
    scene = Scene(density, extinction, position, *axes, camera.pitch / volume.voxel, 2, 2)
    expected = scattered_twice(scene, toward, 0.3, 0.5, 6, 12)
    traced = trace(volume, camera, [Light(WAY)], g=0.3, samples=400_000, orders=2, highest=2)
    got = traced.planes[0, 2, ..., 0].cpu().numpy()
    assert abs(got.mean() / expected.mean() - 1) < 0.01
    assert np.abs(got / expected - 1).max() < 0.02


@pytest.mark.parametrize(("g", "share"), [(0.0, 0.003), (0.6, 0.003)])
def test_a_white_furnace_stays_white(device: str, g: float, share: float):
    """Smoke of albedo 1 in an even sky cannot be seen."""
    volume = make_plume(24, hot=False, extinction=30.0, device=device)
    sky = (1.0, 1.0, 1.0)
    traced = trace(volume, facing(volume, size=16), sky=sky, g=g, samples=512, orders=2)
    assert abs(float(traced.total.mean()) - 1.0) < share and traced.error < 0.03
    assert float(traced.planes[0, 3].mean()) > 0.05
    # Of an albedo of 1/2 it takes light away.
    dim = trace(volume, facing(volume, size=16), sky=sky, g=g, albedo=(0.5,) * 3, samples=32)
    assert float(dim.total.mean()) < 0.9


def test_orders_and_albedo(device: str):
    """Light of order n is proportional to the n-th power of the albedo."""
    volume, camera = ball(device=device), facing(ball(), size=8)
    white = trace(volume, camera, [Light(WAY)], samples=64, orders=4)
    tinted = trace(volume, camera, [Light(WAY)], samples=64, orders=4, albedo=(1.0, 0.8, 0.0))
    for n in range(5):
        ratio = torch.tensor([1.0, 0.8**n, float(n == 0)], device=volume.device)
        assert torch.allclose(tinted.planes[:, n], white.planes[:, n] * ratio, rtol=1e-4, atol=1e-7)
    # Fewer paths carry what is left of the light on, which changes no mean.
    dark = trace(volume, camera, [Light(WAY)], samples=4096, orders=3, albedo=(0.3,) * 3)
    wanted = trace(volume, camera, [Light(WAY)], samples=4096, orders=3, seed=1)
    assert abs(float(dark.planes[:, 3].mean() / (0.3**3 * wanted.planes[:, 3].mean())) - 1) < 0.03


def test_point_lights(device: str):
    """A distant point light equals a directional one; the inverse square law holds; inside the smoke a march agrees."""
    volume = ball(device=device)
    camera = facing(volume, size=8)
    toward = np.array(WAY) / np.linalg.norm(WAY)
    far = PointLight(tuple(volume.centre + 500.0 * toward), (4 * math.pi * 500.0**2,) * 3)
    one, other = (trace(volume, camera, [lamp], samples=256).total for lamp in (far, Light(WAY)))
    assert abs(float(one.mean() / other.mean()) - 1) < 0.01
    inside = PointLight(tuple(volume.centre), radius=0.05)
    traced = trace(volume, camera, [inside], samples=512, highest=1)
    assert torch.isfinite(traced.total).all() and traced.error < 0.2
    assert traced.total.max() == traced.total[2:6, 2:6].max()


def test_emission_is_seen_and_scattered(device: str):
    """Unscattered emission equals that of bake; smoke of albedo 1 scatters as much as it removes."""
    volume = make_plume(20, extinction=8.0, device=device)
    camera = facing(volume, size=16)
    traced = trace(volume, camera, samples=1024, albedo=(1.0, 0.5, 0.0), orders=1, seed=1)
    assert traced.sources == ("emission",)
    close(traced.planes[0, 0, ..., 2], traced.noise[0, ..., 2], bake(volume, camera, step=0.25).emission, 0.02)
    assert not traced.planes[0, 1:, ..., 2].any() and traced.planes[0, 1, ..., 0].any()
    # Cold smoke has no such source, and fire without smoke shines as well.
    bare = from_array(np.zeros((8, 8, 8)), temperature=np.ones((8, 8, 8)), emission=0.5, device=device)
    seen = trace(bare, facing(bare, size=8), samples=1024)
    assert abs(float(seen.total[3:5, 3:5].mean()) - 4.0) < 0.1


def test_obstacles_block(device: str):
    """A plate towards the light removes its light, one in front of the camera hides everything, one aside nothing."""
    volume = ball(device=device)
    camera = facing(volume, size=8)
    corners, triangles = surface("box")

    lights = [Light((0.0, 1.0, 0.0)), Light((1.0, 0.0, 0.0))]

    def shot(place: tuple, half: tuple, samples: int = 16) -> Transport:
        plate = (corners * np.array(half) + volume.centre + np.array(place), triangles)
        return trace(volume, camera, lights, sky=(1.0, 1.0, 1.0), samples=samples, highest=1, obstacles=plate)

    free = trace(volume, camera, lights, samples=256, highest=1)
    above = shot((0.0, 0.8, 0.0), (3.0, 0.1, 3.0))
    assert not above.planes[0].any()
    assert above.planes[1].any()
    before = shot((0.0, 0.0, 2.0), (3.0, 3.0, 0.1), 2)
    assert not before.planes.any()
    beside = shot((0.0, 0.0, 9.0), (3.0, 3.0, 0.1), 256)
    assert abs(float(beside.planes[:2].mean() / free.planes.mean()) - 1) < 0.03
    # The background behind the smoke is seen where no obstacle stands before it.
    behind = shot((0.5, 0.0, -2.0), (0.5, 3.0, 0.1))
    assert behind.planes[2, 0, :, :3].mean() > 0.3 and not behind.planes[2, 0, :, 5:].any()


def test_the_seed_alone_decides(device: str):
    camera = facing(ball(), size=6)
    thick = trace(ball(depth=80.0, device=device), camera, [Light(WAY)], samples=16, sky=(1.0, 1.0, 1.0))
    assert torch.isfinite(thick.total).all() and 0.7 < float(thick.planes[1].sum(0).mean()) < 1.3
    smoke = ball(device=device)
    first, again, other = (trace(smoke, camera, [Light(WAY)], samples=40, seed=n).planes for n in (5, 5, 6))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_empty_bricks_around_smoke_are_left_out(device: str):
    """Smoke in a corner of a large box is traced like smoke in its own box, with as few bricks."""
    small = ball(20, device=device)
    density = torch.zeros(64, 40, 48, device=device)
    density[41:61, 3:23, 20:40] = small.density
    large = DensityVolume(density, small.extinction, small.voxel, tuple(-small.voxel * n for n in (41, 3, 20)))
    made = [trace(volume, facing(small, size=8), [Light(WAY)], samples=512, orders=2) for volume in (small, large)]
    assert float(made[1].total.mean()) == pytest.approx(float(made[0].total.mean()), rel=0.02)
    bounds = smoke_path.bounds(medium_of(large), 2 * BRICK)
    assert bounds.low == (40, 0, 16) and bounds.size == (24, 24, 32) and bounds.most.shape == (3, 3, 4)
    assert smoke_path.bounds(medium_of(from_array(np.zeros((9, 9, 9)), device=device)), 1.0).most.shape == (1, 1, 1)


def test_the_noise_of_all_lights_counts_what_they_share(device: str):
    """Lights share their paths; the stated noise equals the spread between seeds."""
    volume = ball(8, depth=8.0, device=device)
    lights = [Light((0.1 * n, 1.0, 0.2)) for n in range(4)]
    made = [trace(volume, facing(volume, size=8), lights, samples=32, orders=6, seed=seed) for seed in range(16)]
    spread = torch.stack([each.total for each in made]).var(0).mean()
    stated = torch.stack([each.total_noise.square() for each in made]).mean()
    assert 0.7 < float(stated / spread) < 1.4
    alone = trace(volume, facing(volume, size=8), lights, samples=1)
    assert alone.error == math.inf and torch.isfinite(alone.total).all() and alone.total.any()


def test_smoke_too_dense_and_planes_beyond_the_memory_are_refused_at_once():
    with pytest.raises(WlmError, match=r"smoke: expected optical depths of at most 10000 per voxel"):
        trace(ball(4, depth=1e9), facing(ball(4), size=2), [Light(WAY)])
    volume = ball(4)
    with pytest.raises(WlmError, match=r"orders: .* planes of 16384 x 16384 pixels need .* fewer orders or pixels"):
        trace(volume, facing(volume, size=16384), [Light(WAY)], samples=2, orders=1000)


@pytest.mark.slow
def test_half_floats_are_traced_as_floats(device: str):
    camera = facing(ball(), size=6)
    half = ball(device=device)
    half = DensityVolume(half.density.half(), half.extinction, half.voxel)
    whole = DensityVolume(half.density.float(), half.extinction, half.voxel)
    a, b = (trace(smoke, camera, [Light(WAY)], samples=16).total for smoke in (half, whole))
    assert torch.allclose(a, b, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("albedo", [0.8, 0.95, 1.0])
@pytest.mark.parametrize("g", [-0.3, 0.0, 0.6])
@pytest.mark.parametrize("name", ["cube", "ball", "plume", "thick"])
def test_against_mitsuba(name: str, g: float, albedo: float):
    """Each order of Mitsuba's `volpath` within 1% above the noise of the two."""
    pytest.importorskip("mitsuba")
    volume = {
        "cube": lambda: from_array(np.ones((8, 8, 8)), extinction=0.25, voxel=1.0),
        "ball": ball,
        "plume": lambda: make_plume(16, hot=False, extinction=14.0),
        "thick": lambda: make_plume(16, seed=3, hot=False, extinction=40.0),
    }[name]()
    camera, rays, most = facing(volume, size=8), 4, 4
    way = np.array(WAY) / np.linalg.norm(WAY)
    ours = []
    for seed in range(4):
        options = {"albedo": (albedo,) * 3, "g": g, "samples": 256, "orders": most, "highest": most, "seed": seed}
        planes = trace(volume, camera.finer(rays), [Light(camera.axes.T @ way)], **options).planes[0, 1:-1, ..., 0]
        ours.append(torch.nn.functional.avg_pool2d(planes, rays).double().numpy())
    sums = np.zeros((4, most + 1, camera.height, camera.width))
    for order in range(1, most + 1):
        tracer = PathTracer(volume, camera, variant="scalar_rgb", albedo=albedo, g=g, order=order)
        sums[:, order] = [tracer.trace(way, 2048, 10 * order + seed)[..., 0] for seed in range(4)]
    theirs = np.diff(sums, axis=1)
    for order in range(most):
        a, b = np.stack([run[order] for run in ours]), theirs[:, order]
        noise = math.hypot(*(runs.mean((1, 2)).std(ddof=1) / 2 for runs in (a, b)))
        assert abs(a.mean() - b.mean()) < 0.01 * b.mean() + 3.0 * noise, f"order {order + 1}: {a.mean()} {b.mean()}"
