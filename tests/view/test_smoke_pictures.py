"""Pictures of light and smoke: what is drawn where, before and behind the smoke, and in which cell of a sheet."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from builders.checks import misuse_of
from builders.smoke_plumes import facing, plume, rays
from PIL import Image
from reference.marching import Scene, depth_to, samples

from wlm.smoke.camera import unit
from wlm.smoke.lightmaps import SixWay
from wlm.smoke.scene import CameraSettings, LightSettings, ObstacleSettings, make_camera
from wlm.smoke.shading import Light, PointLight, Ramp
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.orders import scatter
from wlm.view.display import white_of
from wlm.view.pictures import contact_sheet, encode, to_bytes
from wlm.view.smoke import Drawing, picture
from wlm_kernels.smoke.settings import March

FRONT = LightSettings(toward=(0, 0, 1), irradiance=(math.pi,) * 3).light()


def _camera(size=32, **settings):
    """Makes a camera in front of the unit box around the origin."""
    return make_camera(CameraSettings(resolution=size, **settings), (-0.5, -0.5, -0.5), (1, 1, 1))


def _ball(x=0.0, y=0.0, z=0.0, radius=0.2, **more):
    return ObstacleSettings(radius=radius, path=((0.0, x, y, z),), colour=(1.0, 0.5, 0.0), **more)


def draw_obstacles(obstacles, camera, lights, device):
    """Returns the light and the distance of the obstacles alone."""
    drawing = Drawing(camera, lights, obstacles=obstacles, device=device)
    return drawing.solid_light, drawing.solid_depth


def _flat(camera, transparency, light=0.0, device="cpu"):
    """Makes uniform smoke."""
    size = (camera.height, camera.width)
    clear = torch.full(size, transparency, device=device)
    return SixWay(torch.full((6, *size), light, device=device), clear, camera=camera)


def test_bytes():
    assert to_bytes(torch.tensor([[0.0, 0.5, 1.0, 9.0]])).tolist() == [[[0] * 3, [188] * 3, [255] * 3, [255] * 3]]
    assert to_bytes(np.full((1, 1, 3), 2.0), 4.0).tolist() == [[[188] * 3]]
    light = np.random.default_rng(0).random((256, 256, 3), np.float32) - 0.05
    np.testing.assert_array_equal(to_bytes(torch.from_numpy(light), 0.9), to_bytes(light, 0.9))


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("toward", [(0, 0, 1), (0, 1, 0), (1, -2, 0.5)])
def test_an_obstacle_is_drawn_where_it_is(device, toward, perspective):
    """A ball is compared with the rays that hit it."""
    camera = _camera(48, toward=toward, perspective=perspective)
    ball = _ball(0.1, -0.05, 0.2)
    _, depth = draw_obstacles([ball], camera, [], device)
    origin, way = rays(camera)
    middle = ball.eased.at(0.0) - origin
    along = (middle * way).sum(-1)
    gap = 0.2**2 - ((middle**2).sum(-1) - along**2)
    expected = np.where(gap > 0, along - np.sqrt(np.maximum(gap, 0)), np.inf)
    found = depth.cpu().numpy()
    # The mesh is a little smaller than the ball: its edge is left out.
    assert np.isinf(found[gap < -0.002]).all() and np.isfinite(found[gap > 0.002]).all()
    inside = gap > 0.01
    assert inside.sum() > 30
    np.testing.assert_allclose(found[inside], expected[inside], atol=0.01)


def test_an_obstacle_is_lit_from_where_the_light_is(device):
    camera = _camera(33)
    light, depth = draw_obstacles([_ball()], camera, [FRONT], device)
    seen = torch.isfinite(depth)
    # Face on: its colour times (E / pi + the ambient's 0.2).
    np.testing.assert_allclose(light[16, 16].cpu(), [1.2, 0.6, 0.0], atol=0.02)
    assert not light[~seen].any()
    side, _ = draw_obstacles([_ball()], camera, [Light((1.0, 0.0, 0.0), (1.0,) * 3)], device)
    row = side[16, seen[16]][:, 0]
    assert row[-1] > row[0] and float(row[0]) == pytest.approx(0.2)
    # The nearer one of two hides the other, whatever their order.
    for order in (1, -1):
        both = [_ball(z=0.25, radius=0.1), ObstacleSettings(radius=0.2, path=((0.0, 0, 0, 0),), colour=(0.0, 0.0, 1.0))]
        shown, _ = draw_obstacles(both[::order], camera, [FRONT], device)
        assert shown[16, 16, 0] > 0.5 and shown[16, 16, 2] == 0 and shown[16, 11, 2] > 0.3
    # What lies behind the camera isn't seen.
    _, none = draw_obstacles([_ball()], _camera(33, distance=0.3, target=(0, 0, 0.5)), [FRONT], device)
    assert torch.isfinite(none).any()
    _, none = draw_obstacles([_ball(z=1.2)], _camera(33, distance=0.3), [FRONT], device)
    assert not torch.isfinite(none).any()
    assert not torch.isfinite(draw_obstacles([], camera, [], device)[1]).any()


def test_an_obstacle_before_and_behind_smoke(device):
    camera = _camera(33)
    six = _flat(camera, 0.25, 0.5, device)
    ball, depth = draw_obstacles([_ball()], camera, [FRONT], device)
    seen = torch.isfinite(depth)
    background = (0.1, 0.2, 0.3)
    shown = {"background": background, "obstacles": [_ball()]}
    # The light is from behind the camera, whose way to the smoke's surface is free where that is before the ball.
    near, far = torch.full_like(six.transparency, 0.01), torch.full_like(six.transparency, 99.0)
    before = picture(replace(six, depth=far), [FRONT], **shown)
    torch.testing.assert_close(before[seen], ball[seen])
    behind = picture(replace(six, depth=near), [FRONT], **shown)
    lit = 0.5 * math.pi / (4 * math.pi)
    torch.testing.assert_close(behind[seen], lit + 0.25 * ball[seen])
    empty = lit + 0.25 * torch.tensor(background, device=device)
    torch.testing.assert_close(behind[~seen], empty.expand(int((~seen).sum()), 3))
    # The obstacle shadows the smoke behind it, except at the pixels where the obstacle itself is seen.
    side = Light((1.0, 0.0, 0.0), (4 * math.pi,) * 3)
    surface = float(np.dot(np.subtract(camera.position, 0), camera.toward))
    level = torch.full_like(six.transparency, surface)
    shadow = picture(replace(six, depth=level), [side], obstacles=[_ball(0.3, 0, 0, 0.1)])
    assert float(shadow[16, 5, 0]) < 0.05 and float(shadow[5, 5, 0]) == pytest.approx(0.5)


def test_without_obstacles_it_is_smoke_over_a_colour(device):
    camera = _camera(8)
    six = _flat(camera, 0.5, 0.25, device)
    six = replace(six, emission=torch.ones_like(six.transparency))
    ramp = Ramp((0.0, 2.0), ((0, 0, 0), (2.0, 1.0, 0.0)))
    light = Light((0.0, 0.0, 3.0), (4 * math.pi, 0.0, 0.0))
    found = picture(six, [light], background=(0.2, 0.4, 0.6), ramp=ramp)
    torch.testing.assert_close(found[3, 4].cpu(), torch.tensor([0.25 + 1.0 + 0.1, 0.5 + 0.2, 0.3]))
    # The same as in torch, with several lights and an emission in three stops.
    six = replace(six, emission=torch.linspace(-1, 4, 64, device=device).reshape(8, 8))
    ramp = Ramp((0.0, 0.5, 2.0), ((0, 0, 0.3), (2.0, 1.0, 0.0), (1, 5, 1)))
    lights = [light, Light((1.0, 2.0, -1.0), (3.0, 4.0, 5.0))]
    for given in (lights, lights[:1], []):
        for colours in (ramp, None):
            for rule in ("squared", "absolute"):
                expected = six.shade(given, background=(0.2, 0.4, 0.6), ramp=colours, rule=rule)
                found = picture(six, given, background=(0.2, 0.4, 0.6), ramp=colours, rule=rule)
                torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


def test_a_contact_sheet(tmp_path):
    """Each chosen picture is in its row, in order; long rows are thinned evenly."""
    rows = {"one": [np.full((10, 12, 3), i, np.uint8) for i in range(20)]}
    rows["another"] = [200 + cell for cell in rows["one"]]
    chosen = contact_sheet(tmp_path / "a.png", rows, [str(i) for i in range(20)], columns=4)
    assert chosen == (0, 6, 13, 19)
    with Image.open(tmp_path / "a.png") as image:
        sheet = np.asarray(image)
    for row, label in enumerate(rows):
        for column, i in enumerate(chosen):
            x, y = sheet.shape[1] - (4 - column) * 16, 28 + row * 14
            np.testing.assert_array_equal(sheet[y : y + 10, x : x + 12], rows[label][i])
    assert contact_sheet(tmp_path / "b.png", {"": rows["one"][:1]}) == (0,)
    assert not (tmp_path / "c.png").exists()


@pytest.mark.parametrize("orders", ["single", "all"])
def test_smoke_under_its_own_lights_is_drawn_as_it_shades(device, orders):
    """The smoke has fire and a point light."""
    volume = replace(plume(hot=True, device=device), emission=8.0)
    camera = make_camera(CameraSettings(resolution=20), volume.origin, volume.size)
    lights = [Light((1.0, 1.0, 1.0), (9.0, 4.0, 2.0)), PointLight((0.4, 0.6, 0.6), (1.0, 2.0, 3.0))]
    looks = {"background": (0.1, 0.2, 0.3), "ramp": Ramp((0.0, 1.0), ((0.0, 0.0, 0.0), (2.0, 0.5, 0.1)))}

    if orders == "single":
        smoke = light_smoke(volume, camera, lights)
        drawn = picture(smoke, albedo=(0.9, 0.5, 0.0), **looks)
    else:
        smoke = scatter(volume, camera, lights, (0.9, 0.5, 0.0))
        drawn = picture(smoke, **looks)
        assert smoke.lit.thrown.any()
    albedo = {"albedo": (0.9, 0.5, 0.0)} if orders == "single" else {}
    torch.testing.assert_close(drawn, smoke.shade(**looks, **albedo))
    assert "among obstacles" in misuse_of(picture, smoke, obstacles=[_ball(0.1, 0.6, 0.25)])


@pytest.mark.parametrize("perspective", [False, True])
@pytest.mark.parametrize("step", [0.5, 2.0])
def test_shadows_in_the_depth_of_smoke(device, perspective, step):
    """A ball in smoke shadows it from a sun and a point light and hides it, as in float64 from every sample."""
    volume = plume(device=device)
    camera = facing(volume, (0.4, 0.3, 1.0), 20, perspective=perspective, **({"extent": 0.4} if perspective else {}))
    ball = ObstacleSettings(radius=0.22, path=((0.0, 0.05, 0.6, 0.05),))
    lights = [Light((1.0, 0.5, 0.2)), PointLight((-0.5, 0.9, 0.3), (1.0, 2.0, 3.0))]
    drawing = Drawing(camera, lights, obstacles=[ball], device=device)
    made = light_smoke(drawing.among(volume), camera, lights, March(step, jitter=0.0))
    centre, radius = (ball.eased.at(0.0) - volume.origin) / volume.voxel, 0.22 / volume.voxel
    lamp = (np.array(lights[1].position) - volume.origin) / volume.voxel
    view = camera.view(volume)
    place = (np.array(view.origin), *camera.axes, view.pitch, 20, 20, perspective)
    scene = Scene(volume.density.cpu().numpy(), volume.extinction * volume.voxel, *place)

    def to_ball(p: np.ndarray, d: np.ndarray) -> np.ndarray:
        """Returns the distance from p along d to the ball, infinite if there is none."""
        along = ((centre - p) * d).sum(-1)
        half = radius**2 - (((centre - p) ** 2).sum(-1) - along**2)
        near, far = along - np.sqrt(np.maximum(half, 0)), along + np.sqrt(np.maximum(half, 0))
        return np.where((half > 0) & (far > 0), np.maximum(near, 0.0), np.inf)

    o, d = scene.rays()
    stop, light, tau = to_ball(o, d), np.zeros((2, *d.shape[:2])), np.zeros(d.shape[:2])
    for s, dt, density in samples(scene, o, d, 0.25):
        p, x = o + s[..., None] * d, scene.extinction * density * dt * (s < stop)
        way = lamp - p
        away = np.linalg.norm(way, axis=-1)
        sun = np.broadcast_to(unit(lights[0].toward), p.shape)
        for n, (toward, most) in enumerate(((sun, np.inf), (way / away[..., None], away))):
            free = to_ball(p, toward) >= most
            # No smoke is beyond the lamp.
            light[n] += free * np.exp(-tau - depth_to(scene, p, toward, 0.5)) * (1 - np.exp(-x)) / (1, away**2)[n]
        tau += x
    light[1] /= volume.voxel**2
    found = np.append(made.planes.cpu().numpy(), made.transparency.cpu().numpy()[None], 0)
    wanted = np.append(light, np.exp(-tau)[None], 0)
    error = [np.sqrt(((a - b) ** 2).mean() / (b**2).mean()) for a, b in zip(found, wanted, strict=True)]
    # Without the ball, 0.18 and 0.3.
    assert max(error) < (0.04 if step < 1.0 else 0.1)
    # On lightmaps it falls on the surface alone, which is here at one distance.
    away = float(np.linalg.norm(camera.position - volume.centre))
    drawing.draw_shadows(torch.full((20, 20), away, device=device))
    hidden = to_ball(o + (away / volume.voxel - view.moved) * d, unit(lights[0].toward)) < np.inf
    assert (hidden != (drawing.visibility[0].cpu().numpy() == 0.0)).mean() < 0.02 < hidden.mean()


def test_lightmaps_are_lit_from_directions_alone():
    camera = _camera(8)
    half = picture(_flat(camera, 0.5, 0.4), [FRONT], albedo=(0.5, 1.0, 0.0))
    torch.testing.assert_close(half, picture(_flat(camera, 0.5, 0.4), [FRONT]) * torch.tensor([0.5, 1.0, 0.0]))


def test_exposure():
    light = np.array([[[0.0, 0.5, 1.0], [2.0, -1.0, 0.001]]])
    encoded = encode(light, np.array([[True, True]]), 1.0)
    # sRGB of a half is 188, of a thousandth 12.92 / 1000.
    np.testing.assert_array_equal(encoded, [[[0, 188, 255], [255, 0, 3]]])
    assert (encode(light, np.zeros((1, 2), bool), 1.0) == 128).all()
    assert white_of(np.zeros((5, 3))) == 1.0 == white_of(np.zeros((0, 3)))
    dark = np.zeros((10000, 3))
    dark[0] = 3.0
    assert white_of(dark) == 3.0, "one lamp in the dark"
    assert white_of(np.arange(1001.0)) == pytest.approx(995.0)
