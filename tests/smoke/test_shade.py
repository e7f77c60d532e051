"""Shading: weights, lights and emission."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

<<<<<<< HEAD
from wlm.fluid.obstacles import surface
=======
>>>>>>> main
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
    ("rule", "share"),
    [("squared", (9 / 25, 16 / 25)), ("absolute", (3 / 5, 4 / 5)), ("normalised", (3 / 7, 4 / 7))],
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


def test_glow(device: str):
    """Emission is grey without a ramp, else interpolated between the colours of the stops."""
    six = _six(device, emission=True)
    np.testing.assert_allclose(six.shade([]).cpu(), six.emission[..., None].expand(8, 8, 3).cpu())
    ramp = Ramp((0.5, 1.0, 1.5), ((0, 0, 0), (1, 0.5, 0), (4, 4, 2)))
    result = six.shade([], ramp=ramp).cpu().numpy()
    for c in range(3):
        expected = np.interp(six.emission.cpu(), ramp.stops, [colour[c] for colour in ramp.colours])
        np.testing.assert_allclose(result[..., c], expected, atol=1e-5)
    for wrong in (((1.0,), ((1, 1, 1),)), ((1.0, 1.0), ((0, 0, 0),) * 2), ((0.0, 1.0), ((0, 0, 0), (0, math.nan, 0)))):
        with pytest.raises(ValueError, match="ramp"):
            Ramp(*wrong)


def test_background(device: str):
    """The background is multiplied by the transparency (eq. 4), as a colour or a picture."""
    six = _six(device)
    light = six.shade([Light((0.0, 0.0, 1.0))])
    for background in ((1.0, 2.0, 3.0), torch.rand((8, 8, 3), device=device)):
        result = six.shade([Light((0.0, 0.0, 1.0))], background=background)
        expected = light + six.transparency[..., None] * torch.as_tensor(background, device=device)
        np.testing.assert_allclose(result.cpu(), expected.cpu(), rtol=1e-6)


<<<<<<< HEAD
@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("toward", [(0.0, 1.0, 0.0), (0.5, 1.0, -0.3), (0.0, 0.0, 1.0), (-1.0, 0.2, 0.4)])
def test_shadow_of_a_box(device: str, toward: tuple, perspective: bool):
    """Rays from a plane of smoke to the light give the same shadow, except within a few texels of its edge."""
    way = (0.1, 1.0, 1.0)
    extent = 0.6 if perspective else 6.0
    camera = Camera.look_at(
        10 * np.array(way) / np.linalg.norm(way), (0, 0, 0), extent=extent, height=40, width=40, perspective=perspective
    )
    low, high = (-0.8, 0.2, -0.5), (0.6, 1.0, 0.7)
    origin, ray = (part.numpy() for part in camera.rays())
    # Smoke's surface: the plane x + 2 y + 2 z = 0.3, which cuts the box.
    normal = np.array([1.0, 2.0, 2.0])
    depth = (0.3 - origin @ normal) / (ray @ normal)
    depth[:, :3] = 0.0
    depths = torch.tensor(depth, dtype=torch.float32, device=device)
    result = shadow_of(depths, camera, toward, *_box(low, high, device), resolution=512)
    at = origin + depth[..., None] * ray
    light = np.array(toward) / np.linalg.norm(toward)

    def hidden(shrink: float) -> np.ndarray:
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = ((np.array(c) - at) / light for c in (np.array(low) + shrink, np.array(high) - shrink))
        near, far = np.minimum(a, b).max(-1), np.maximum(a, b).min(-1)
        return (near < far) & (far > shrink)

    rim = 0.03
    result = result.cpu().numpy()
    sure = depth > 0
    assert (hidden(rim) & sure).sum() > 20
    assert (result[sure & hidden(rim)] < 1e-6).all()
    assert (result[sure & ~hidden(-rim)] == 1).all()
    assert (result[~sure] == 1).all()


def test_shadow_falls_behind_only(device: str):
    """Smoke between light and obstacle is lit; a larger bias lights smoke close behind the obstacle."""
    camera = Camera.look_at((0, 0, 10), (0, 0, 0), extent=4.0, height=9, width=9)
    box = _box((-1, -1, -0.1), (1, 1, 0.1), device)
    for depth, bias, expected in ((8.0, -1.0, 1.0), (12.0, -1.0, 0.0), (12.0, 3.0, 1.0)):
        depths = torch.full((9, 9), depth, device=device)
        result = shadow_of(depths, camera, (0, 0, 1), *box, bias=bias)
        assert float(result[4, 4]) == expected and float(result[0, 0]) == 1.0


@pytest.mark.parametrize("far", [0.0, 1000.0])
def test_shadow_of_a_sphere(device: str, far: float):
    """The shadow has the area of a circle, also a thousand radii from the origin."""
    points, triangles = surface("sphere")
    corners = torch.from_numpy((points + [far, 0, far]).astype(np.float32)).to(device)
    camera = Camera.look_at((far, 8, far), (far, 0, far), extent=4.0, height=100, width=100, world_up=(0, 0, 1))
    depths = torch.full((100, 100), 12.0, device=device)
    light = shadow_of(depths, camera, (0, 1, 0), corners, torch.from_numpy(triangles).to(device))
    area = float((1 - light).sum()) * (4.0 / 100) ** 2
    # The sphere has 48 sides.
    assert area == pytest.approx(24 * np.sin(np.pi / 24), rel=5e-3)
    centre = (1 - light.cpu().numpy()).sum(0) @ (np.arange(100) + 0.5) / float((1 - light).sum())
    assert centre == pytest.approx(50.0, abs=0.1)


=======
>>>>>>> main
def test_wrong_settings():
    six = _six("cpu")
    with pytest.raises(ValueError, match="irradiance"):
        six.shade([Light((0, 0, 1), (-1, 0, 0))])
    with pytest.raises(ValueError, match="directions"):
        six.shade([Light((0, 0, 0))])
    with pytest.raises(ValueError, match="camera: the lightmaps have no camera"):
        replace(six, camera=None).shade([Light((0, 0, 1))])
    with pytest.raises(ValueError, match="transparency: the lightmaps have no"):
        replace(six, transparency=None).shade([], background=(0, 0, 0))
    with pytest.raises(ValueError, match="camera: expected the height and width of the lightmaps, .8, 8."):
        replace(six, camera=six.camera.finer(2))
    with pytest.raises(ValueError, match="depth: expected"):
        replace(six, depth=torch.ones(2, 2))
