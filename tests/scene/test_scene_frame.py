"""Frames of a scene against a ray caster in float64, a film with a lamp, and the street of the demos."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from builders import day_scenes
from builders.checks import error_of
from PIL import Image
from scipy.ndimage import maximum_filter, minimum_filter

import wlm
from wlm.errors import WlmError
from wlm.formats.light import read_light
from wlm.interop import available_devices
from wlm.scene import frame as frame_module
from wlm.scene.frame import Renderer
from wlm.scene.probes import six_lights
from wlm.smoke.camera import VECTORS, weights
from wlm.view.display import Display
from wlm.view.scene_run import run

SIZE = HEIGHT, WIDTH = 72, 128
SKY, FLOOR, WALL, CAR = range(4)
FRAMES = 11


def mixed(times, values, hour):
    """Values [T, ...] at an hour, linear over a day, without the switch."""
    times, values = [*times, times[0] + 24.0], np.concatenate([values, values[:1]])
    i = np.searchsorted(times, hour, side="right") - 1
    if (times[i], times[i + 1]) == (18.45, 18.55):
        return values[i]
    share = (hour - times[i]) / (times[i + 1] - times[i])
    return (1.0 - share) * values[i] + share * values[i + 1]


def reference(scene, second, hour, factors=(1.0, 1.0), size=SIZE):
    """The picture by rays in float64, and pixels whose neighbours show the same things."""
    height, width = size
    hour = hour % 24.0
    eye, target, fov = scene.camera_at(second)
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    y, x = np.mgrid[:height, :width] + 0.5
    tangent = math.tan(math.radians(fov) / 2.0)
    ray = forward + tangent * ((2.0 * x - width) / height)[..., None] * right
    ray = ray + tangent * (1.0 - 2.0 * y / height)[..., None] * up

    pose, puff = scene.moving[0].pose(second), scene.smoke[0]
    lower = puff.position - 0.5 * puff.size * right
    squares = {
        FLOOR: ([-2, 0, 2], [4, 0, 0], [0, 0, -4]),
        WALL: ([-2, 0, -2], [4, 0, 0], [0, 3, 0]),
        CAR: (pose[:3, :3] @ [-0.4, 0, 0] + pose[:3, 3], 0.8 * pose[:3, 0], [0, 0.6, 0]),
        "smoke": (lower, puff.size * right, puff.size * up),
    }
    nearest, seen, smoke = np.full(size, np.inf), np.full(size, SKY), np.zeros(size, bool)
    for name, (corner, along, above) in squares.items():
        normal = np.cross(along, above)
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = ((np.array(corner) - eye) @ normal) / (ray @ normal)
            point = eye + distance[..., None] * ray - corner
        inside = (distance > 0) & (distance < nearest)
        for axis in (np.array(along, float), np.array(above, float)):
            part = point @ axis / (axis @ axis)
            inside &= (part > 0) & (part < 1)
        if name == "smoke":
            smoke = inside
        else:
            nearest[inside], seen[inside] = distance[inside], name

    parts = [
        factor * np.stack([mixed(day_scenes.TIMES, tile, hour) for tile in light])
        for factor, light in zip(factors, (day_scenes.SKY, day_scenes.SUN), strict=True)
    ]
    floor, wall = parts[0] + parts[1]
    even = mixed(list(day_scenes.LIGHT), np.array(list(day_scenes.LIGHT.values())), hour)
    sky = mixed([0.0, 12.0], np.array([[0.0, 0.0, 0.1, 1.0], [0.5, 0.6, 0.8, -1.0]]), hour)
    lit = day_scenes.FLOOR * floor / np.pi, day_scenes.WALL * wall / np.pi, np.multiply(day_scenes.SQUARE, even)
    table = np.stack([sky[:3], *lit])
    radiance = table[seen]
    radiance[smoke] = 0.2 * (puff.frame(second) + 1) * even + 0.5 * radiance[smoke]
    shown = 2.0 ** sky[3] * radiance
    shown = np.clip(shown * (1.0 + shown / 16.0) / (1.0 + shown), 0.0, 1.0)
    label = 2 * seen + smoke
    inner = maximum_filter(label, 5) == minimum_filter(label, 5, mode="constant", cval=-1)
    return np.where(shown <= 0.0031308, 12.92 * shown, 1.055 * shown ** (1 / 2.4) - 0.055), inner, label


@pytest.fixture(scope="module", params=available_devices())
def renderer(request, scene):
    with Renderer(scene, *SIZE, request.param, samples=1) as renderer:
        yield renderer


@pytest.mark.parametrize("second", [0.0, 1.1, 2.26, 2.3])
def test_frames_are_those_of_rays(renderer, scene, second):
    frame = renderer.draw(second, complete=True)
    expected, inner, label = reference(scene, second, scene.hour_at(second))
    assert frame.current == 1.0 and sum((inner & (label == each)).sum() > 9 for each in np.unique(label)) >= 4
    apart = np.abs(frame.screen.cpu().numpy() - expected).max(-1)
    assert apart[inner].max() < 2.0 / 255.0
    np.testing.assert_array_equal(frame.surface.cpu().numpy()[inner], np.isin(label // 2, (FLOOR, WALL))[inner])
    assert np.abs(frame.picture() / 255.0 - frame.screen.cpu().numpy()).max() < 0.501 / 255.0


def test_weights_and_points_of_pixels(renderer, scene):
    renderer.pages.set_weights({"sun": 0.25})
    one = renderer.draw(1.1, complete=True)
    renderer.pages.set_weights({"sun": 1.0})
    expected, inner, _ = reference(scene, 1.1, scene.hour_at(1.1), (1.0, 0.25))
    assert np.abs(one.screen.cpu().numpy() - expected).max(-1)[inner].max() < 2.0 / 255.0
    with Renderer(scene, *SIZE, renderer.device, samples=3) as finer:
        smooth = finer.draw(1.1, complete=True).screen.cpu().numpy()
    whole = renderer.draw(1.1, complete=True).screen.cpu().numpy()
    assert np.abs(smooth - whole).max(-1)[inner].max() < 2.0 / 255.0
    assert (np.abs(smooth - whole).max(-1) > 0.02).sum() > 50  # mixed colours at edges


def test_a_camera_may_pass_above_its_target(changed):
    rows = [{"second": s, "eye": [0, 2, z], "target": [0, 0, 0]} for s, z in ((0, 1), (4, -1))]
    path = changed(camera=rows, probes=None, moving=None, smoke=None)
    with wlm.scene.load(path) as scene, Renderer(scene, 9, 16, samples=1) as renderer:
        assert scene.camera_at(2.0)[0].tolist() == [0.0, 2.0, 0.0]
        above = renderer.draw(2.0, complete=True)
        assert torch.isfinite(above.screen).all() and above.surface[4, 8]
        assert not torch.equal(above.screen, renderer.draw(1.0, complete=True).screen)


def test_the_smoke_of_a_folder_has_a_bound(scene, monkeypatch):
    monkeypatch.setattr(frame_module, "_SMOKE_BYTES", 2 * 8 * 8 * 8 * 2 - 1)
    assert "smoke: expected at most 0 MiB of six-way lightmaps, found 2 frames of" in error_of(Renderer, scene, 9, 16)


def test_an_original_is_shown_instead(renderer, scene):
    second = scene.second_at(12.0)
    frame = renderer.draw(second, original=renderer.original(12.0))
    expected, inner, _ = reference(scene, second, 12.0)
    assert frame.decoded == 0
    assert np.abs(frame.screen.cpu().numpy() - expected).max(-1)[inner].max() < 1.0 / 255.0


def test_the_display_is_that_of_the_window(renderer):
    frame = renderer.draw(1.1, complete=True)
    light = np.full((1, 1, 3), 0.3)
    pages = torch.full((day_scenes.HEIGHT, day_scenes.WIDTH, 3), 0.3 * np.pi / 0.5, device=frame.screen.device)
    frame = renderer.draw(1.1, original=pages)
    shown = Display(2.0 ** renderer.scene.sky_at(frame.hour)[1], "filmic").screen(light)
    floor = frame.screen.cpu().numpy()[-12, WIDTH // 2]
    np.testing.assert_allclose(floor, shown[0, 0], atol=2e-3)


def test_a_lamp_is_on_in_the_first_frame_after_its_switch(changed, tmp_path):
    day = {"first": 18, "last": 19, "seconds": 1}
    path = changed(day=day, probes=None, moving=None, smoke=None, originals=None)
    after = math.ceil(0.55 * FRAMES)  # the first frame after 18.55
    with wlm.scene.load(path) as scene:
        with Renderer(scene, 18, 32, samples=1, decodes=2) as few:
            drawn = [few.draw(i / FRAMES, complete=i == 0) for i in range(FRAMES)]
        run(scene, tmp_path / "out", hours=[], frames=FRAMES, height=18, width=32, samples=1)
    floor = [frame.screen[-3, 16, 0].item() for frame in drawn]
    lamp = floor[-1] - floor[0]
    assert lamp > 0.2 and max(floor[:after]) < floor[0] + 0.1 * lamp < floor[-1] - 0.1 * lamp < min(floor[after:])
    assert max(frame.decoded for frame in drawn[1:]) <= 2
    with Image.open(tmp_path / "out" / "film.webp") as film:
        shown = []  # the red of the floor, for each millisecond: equal frames are stored once
        for i in range(film.n_frames):
            film.seek(i)
            red = np.asarray(film.convert("RGB"))[-3, 16, 0] / 255.0
            shown += [red] * film.info["duration"]
    assert len(shown) == 1000
    dark, lit = shown[(1000 * after - 500) // FRAMES], shown[(1000 * after + 500) // FRAMES]
    assert abs(dark - floor[after - 1]) < 0.04 and abs(lit - floor[after]) < 0.04


def test_six_lights_are_integrals_of_the_weights():
    """Light from one direction, projected to SH and back, against the rule of `SixWay.shade` on many directions."""
    from wlm.probe.sphere import basis, fibonacci_sphere

    axes = np.linalg.qr(np.random.default_rng(0).standard_normal((3, 3)))[0]
    ways = fibonacci_sphere(20000)
    coefficients = np.zeros((9, 3))
    coefficients[:, 0], coefficients[0, 1:] = [3.0, 0.2, -0.5, 0.3, 0.1, 0.05, -0.1, 0.2, 0.15], 1.0
    radiance = basis(ways, 9) @ coefficients
    expected = 4.0 * np.pi / len(ways) * weights(ways @ axes.T).T @ radiance
    np.testing.assert_allclose(six_lights(coefficients, axes), expected, rtol=1e-3)
    assert VECTORS.shape == (6, 3)


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"height": 0}, "size: expected 1 to"),
        ({"hours": [48.0]}, "hours: expected 0 to 48, got 48"),
        ({"frames": 10**6, "height": 64, "width": 64}, "for an animated WebP"),
        ({"weights": {"lamp": 1.0}}, "expected a group among sky, sun"),
    ],
)
def test_wrong_options_are_one_line_and_leave_nothing(scene, tmp_path, options, line):
    with pytest.raises(WlmError, match=line):
        run(scene, tmp_path / "out", **{"frames": 1, "height": 16, "width": 16, "hours": []} | options)
    assert not any(tmp_path.iterdir())


FOLDER = Path(__file__).resolve().parents[2] / "demos" / "data" / "street"
MOST_BYTES = 6_000_000


@pytest.fixture(scope="module")
def street():
    with wlm.scene.load(FOLDER / "street.yaml") as scene:
        yield scene


def test_no_file_is_missing_or_left_over(street):
    files = {file for file in FOLDER.rglob("*") if file.is_file()}
    used = {street.path, *street.originals.values(), FOLDER / "README.md"}
    used |= {FOLDER / name for name in ("street.wlm", "probes.wlm", "street.glb", "car.glb", "van.glb")}
    used |= {file for puff in street.smoke for file in puff.files}
    assert files == used
    assert len(street.probe_hours) == 10
    assert sum(file.stat().st_size for file in files) <= MOST_BYTES


@pytest.mark.parametrize("hour", [12.0, 22.0])
def test_the_sum_of_the_groups_is_the_original(street, hour):
    assert street.light.groups == ("sky", "sun")
    mask = street.light.light.mask
    original = read_light(street.originals[hour])[0][mask]
    error = street.light.decoder().frame(hour)[mask] - original
    assert np.sqrt(np.mean(error**2)) < 0.01 * np.ptp(original)


def test_vehicles_stay_on_the_road(street):
    """Roads are the lines x = 0, x = 3, z = 0 and z = 3, 0.66 m wide; a vehicle is at most 0.21 m wide."""
    for moving in street.moving:
        assert moving.mesh.position[:, 1].min() == pytest.approx(0.0, abs=1e-3)
        assert np.ptp(moving.mesh.position[:, 0]) < 0.21
        for second in np.linspace(0.0, moving.seconds, 50):
            x, y, z = moving.pose(second)[:3, 3]
            assert y == 0.0
            assert min(abs(each - road) for each in (x, z) for road in (0.0, 3.0)) <= 0.33 - 0.105
