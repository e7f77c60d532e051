"""`wlm smoke light`: pictures by marches, beside the path tracer."""

import numpy as np
import pytest
from builders.running import call, fails, png
from builders.smoke_plumes import SPHERE, write_frames

from benchmarks.smoke_tracing import trace
from wlm.fluid.volume import load_volume
from wlm.formats.exr import read_exr
from wlm.smoke.camera import Camera
from wlm.smoke.scene import CameraSettings, make_camera
from wlm.smoke.shading import Light, PointLight, sky_lights
from wlm.smoke.transport.orders import scatter
from wlm.view.pictures import to_bytes

SMALL = ("--resolution", 16)


def camera_of(volume) -> Camera:
    size = volume.voxel * np.array(volume.shape)
    return make_camera(CameraSettings(resolution=16), volume.origin, size)


def test_pictures_of_all_orders_agree_with_the_path_tracer(volume, tmp_path):
    """All orders are brighter than single scattering and near the path tracer; albedo 0 is black without fire."""
    lamp = ("--light", "1,0.5,0.6:9", "--volume", "extinction=8", "--volume", "emission=0")
    albedo = "--albedo", "0.95"
    for name, words in (("all", albedo), ("single", ("--orders", "single", *albedo)), ("black", ("--albedo", "0"))):
        call("smoke", "light", volume, "-o", tmp_path / f"{name}.png", *SMALL, *words, *lamp)
    seen = {name: png(tmp_path / f"{name}.png").astype(float) for name in ("all", "single", "black")}
    assert not seen["black"].any()
    smoke = load_volume(volume, extinction=8.0, emission=0.0)
    traced = trace(smoke, camera_of(smoke), [Light((1, 0.5, 0.6), (9, 9, 9))], albedo=(0.95,) * 3, samples=512)
    wanted = to_bytes(traced.total, 1.0).astype(float)
    off = {name: np.abs(seen[name] - wanted).mean() for name in ("all", "single")}
    assert off["all"] < 0.5 * off["single"] and seen["all"].mean() > 1.1 * seen["single"].mean()


def test_a_picture_is_that_of_python(volume, tmp_path):
    path = tmp_path / "a.exr"
    words = ("--light", "1,1,0:3,2,1", "--point", "0.3,0.5,0.6:1", "--sky", "0.2,0.3,0.4", "--albedo", "1,0.5,0.2")
    call("smoke", "light", volume, "-o", path, *SMALL, *words)
    smoke = load_volume(volume)
    sky = (0.2, 0.3, 0.4)
    lights = [Light((1, 1, 0), (3, 2, 1)), PointLight((0.3, 0.5, 0.6)), *sky_lights(sky)]
    wanted = scatter(smoke, camera_of(smoke), lights, (1.0, 0.5, 0.2)).shade(background=sky)
    np.testing.assert_allclose(read_exr(path)[0], wanted.numpy(), rtol=1e-3, atol=1e-6)


def test_frames_keep_their_obstacles_and_lights(tmp_path):
    folder = write_frames(tmp_path / "a", obstacles=[SPHERE], frames=2).path
    call("smoke", "light", folder, "-o", tmp_path / "lit", "--resolution", 24)
    assert not np.array_equal(*(png(tmp_path / "lit" / f"light_000{n}.png") for n in (1, 2)))


@pytest.mark.parametrize(
    "words, message",
    [
        (("--light", "0,0,0"), "--light"),
        (("--light", "0,0,1:1e13"), "--light: irradiance.0: expected less than or equal to"),
        (("--point", "0,0,0:-1"), "--point"),
        (("--camera", "turn=inf"), "--camera turn: expected a finite number, got 'inf'"),
        (("--camera", "distance=1e-18"), "the distance to the target is too short: 1e-18"),
    ],
)
def test_wrong_options_are_one_line(volume, tmp_path, words, message):
    output = tmp_path / "out.png"
    assert message in fails("smoke", "light", volume, "-o", output, *SMALL, *words)
    assert not output.exists()
