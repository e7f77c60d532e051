"""Shading: weights, lights and emission; and six-way lightmaps by least squares over the sphere."""

import math

import numpy as np
import pytest
import torch
from builders.smoke_plumes import facing, plume

from wlm.fluid.volume import from_array
from wlm.smoke.camera import VECTORS, Camera, weights
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.march.six_way import bake
from wlm.smoke.shading import Light, Ramp, half_sphere
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import scatter
from wlm.smoke.transport.sphere import bake_sphere
from wlm_kernels.smoke.settings import March

FULL = (4 * math.pi,) * 3


def _six(device: str, emission: bool = False) -> SixWay:
    """Makes random lightmaps with an oblique camera."""
    random = np.random.default_rng(0)
    maps = torch.tensor(random.uniform(0, 1, (8, 8, 8)), dtype=torch.float32, device=device)
    camera = Camera.look_at(10 * np.array((0.4, 0.7, 1.0)), (0, 0, 0), extent=4.0, height=8, width=8)
    return SixWay(maps[:6], maps[6], 2 * maps[7] if emission else None, camera)


def test_one_light_along_each_axis(device: str):
    six = _six(device)
    for index, way in enumerate(VECTORS):
        toward = tuple(5.0 * six.camera.axes.T @ way)
        result = six.shade([Light(toward, (4 * math.pi, 2 * math.pi, 0.0))])
        expected = six.lightmaps[index][..., None] * torch.tensor([1.0, 0.5, 0.0], device=device)
        np.testing.assert_allclose(result.cpu(), expected.cpu(), atol=1e-6)


@pytest.mark.parametrize(
    ("rule", "share"), [("squared", (9 / 25, 16 / 25)), ("absolute", (3 / 5, 4 / 5)), ("normalised", (3 / 7, 4 / 7))]
)
def test_rules(device: str, rule: str, share: tuple):
    """A light from the left and the back by each rule; eq. 5 is "absolute"."""
    six = _six(device)
    toward = tuple(six.camera.axes.T @ np.array([-3.0, 0.0, -4.0]))
    result = six.shade([Light(toward, FULL)], rule=rule)[..., 0]
    np.testing.assert_allclose(result.cpu(), (share[0] * six["left"] + share[1] * six["back"]).cpu(), atol=1e-6)


def test_lights_add_up(device: str):
    six = _six(device)
    lights = [Light((1.0, 2.0, 0.5), (1, 2, 3)), Light((-1.0, 0.1, 0.5), (3, 2, 1)), Light((0.0, 0.0, -1.0))]
    both = sum(six.shade([light]) for light in lights)
    np.testing.assert_allclose(six.shade(lights).cpu(), both.cpu(), rtol=1e-5)
    assert not six.shade([]).any()
    tinted = six.shade(lights, albedo=(0.5, 0.0, 1.0))
    assert torch.allclose(tinted, both * torch.tensor([0.5, 0.0, 1.0], device=device), rtol=1e-5)


def test_glow(device: str):
    """Emission is grey without a ramp, else interpolated between the colours of the stops."""
    six = _six(device, emission=True)
    np.testing.assert_allclose(six.shade([]).cpu(), six.emission[..., None].expand(8, 8, 3).cpu())
    ramp = Ramp((0.5, 1.0, 1.5), ((0, 0, 0), (1, 0.5, 0), (4, 4, 2)))
    result = six.shade([], ramp=ramp).cpu().numpy()
    for c in range(3):
        expected = np.interp(six.emission.cpu(), ramp.stops, [colour[c] for colour in ramp.colours])
        np.testing.assert_allclose(result[..., c], expected, atol=1e-5)


def test_background(device: str):
    """The background is multiplied by the transparency (eq. 4), as a colour or a picture."""
    six = _six(device)
    light = six.shade([Light((0.0, 0.0, 1.0))])
    for background in ((1.0, 2.0, 3.0), torch.rand((8, 8, 3), device=device)):
        result = six.shade([Light((0.0, 0.0, 1.0))], background=background)
        expected = light + six.transparency[..., None] * torch.as_tensor(background, device=device)
        np.testing.assert_allclose(result.cpu(), expected.cpu(), rtol=1e-6)


def lights(count: int = 12) -> list[Light]:
    ways = np.random.default_rng(5).normal(size=(count, 3))
    return [Light(tuple(map(float, way))) for way in ways]


def rms(six, lamps: list[Light], exact: torch.Tensor) -> float:
    """Returns the relative RMS error of pictures under each light."""
    shaded = torch.stack([six.shade([lamp])[..., 0] for lamp in lamps])
    return float(((shaded - exact).square().mean() / exact.square().mean()).sqrt())


def test_random_lights_are_nearer_than_by_the_axes(device: str):
    volume = plume(device=device)
    camera, lamps = facing(volume, (0.3, 0.2, 1.0), size=12), lights()
    exact = light_smoke(volume, camera, lamps).planes
    made = bake_sphere(volume, camera)
    assert rms(made, lamps, exact) < 0.92 * rms(bake(volume, camera, step=1.0, estimate=False), lamps, exact)
    assert (made.lightmaps >= 0).all() and made.lightmaps.any()
    # No other maps of at least 0 are nearer to the lights that they are fitted to.
    ways = half_sphere(16)
    weigh = torch.tensor(np.concatenate([weights(ways), weights(-ways)]), dtype=torch.float32, device=device)
    fitted = [Light(tuple(map(float, way @ camera.axes))) for way in ways]
    lit = light_smoke(volume, camera, fitted, March(step=1.0, jitter=0.0))
    planes = torch.cat([lit.planes, lit.opposite])

    def error(maps: torch.Tensor) -> torch.Tensor:
        return (torch.einsum("lp,phw->lhw", weigh, maps) - planes).square().sum()

    least = error(made.lightmaps)
    for index in range(6):
        for change in (0.9, 1.1):
            other = made.lightmaps.clone()
            other[index] *= change
            assert error(other) > least


def test_of_all_orders(device: str):
    volume = plume(device=device)
    camera, lamps = facing(volume, size=12), lights(4)
    exact = scatter(volume, camera, lamps, (0.9,) * 3).planes[..., 0]
    made = bake_sphere(volume, camera, lights=12, albedo=0.9)
    once = bake_sphere(volume, camera, lights=12)
    assert rms(made, lamps, exact) < 0.35 < 0.45 < rms(once, lamps, exact)
    assert not bake_sphere(from_array(np.zeros((4, 4, 4)), device=device), camera, lights=12).lightmaps.any()
