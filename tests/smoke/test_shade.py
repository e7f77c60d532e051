"""Shading: weights, lights and emission."""

import math

import numpy as np
import pytest
import torch

from wlm.smoke.camera import VECTORS, Camera
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.shading import Light, Ramp

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
