"""`wlm smoke light`: pictures by marches and by path tracing."""

import numpy as np
import pytest
from builders.running import call, fails, png
from builders.smoke_plumes import SPHERE, write_frames

from wlm.fluid.volume import load_volume
from wlm.formats.exr import read_exr
from wlm.smoke.camera import Camera
from wlm.smoke.scene import CameraSettings, make_camera
from wlm.smoke.shading import Light, PointLight
from wlm.smoke.transport.tracing import trace

SMALL = ("--resolution", 16)


def camera_of(volume) -> Camera:
    size = volume.voxel * np.array(volume.shape)
    return make_camera(CameraSettings(resolution=16), volume.origin, size)


def test_marched_and_traced_pictures_agree(volume, tmp_path):
    """All orders are brighter than single scattering and near the traced picture; albedo 0 is black without fire."""
    lamp = ("--light", "1,0.5,0.6:9", "--volume", "extinction=8", "--volume", "emission=0")
    for name, words in (
        ("all", ("--albedo", "0.95")),
        ("single", ("--orders", "single", "--albedo", "0.95")),
        ("black", ("--albedo", "0")),
        ("traced", ("--albedo", "0.95", "--samples", 512)),
    ):
        call("smoke", "light", volume, "-o", tmp_path / f"{name}.png", *SMALL, *words, *lamp)
    seen = {name: png(tmp_path / f"{name}.png").astype(float) for name in ("all", "single", "black", "traced")}
    assert not seen["black"].any()
    off = {name: np.abs(seen[name] - seen["traced"]).mean() for name in ("all", "single")}
    assert off["all"] < 0.5 * off["single"] and seen["all"].mean() > 1.1 * seen["single"].mean()


def test_a_traced_picture_is_that_of_python(volume, tmp_path):
    path = tmp_path / "a.exr"
    words = ("--light", "1,1,0:3,2,1", "--point", "0.3,0.5,0.6:1", "--samples", 8, "--albedo", "1,0.5,0.2")
    out = call("smoke", "light", volume, "-o", path, *SMALL, *words)
    smoke = load_volume(volume)
    lights = [Light((1, 1, 0), (3, 2, 1)), PointLight((0.3, 0.5, 0.6))]
    wanted = trace(smoke, camera_of(smoke), lights, albedo=(1.0, 0.5, 0.2), samples=8, orders=0)
    np.testing.assert_allclose(read_exr(path)[0], wanted.total.numpy(), rtol=1e-3, atol=1e-6)
    assert f"{wanted.error:.2%}" in out


def test_smoke_too_dense_to_trace_is_named(volume, tmp_path):
    words = ("--samples", 4, "--volume", "extinction=1e9")
    line = fails("smoke", "light", volume, "-o", tmp_path / "a.png", *SMALL, *words)
    assert str(volume) in line and "optical depth" in line


def test_frames_keep_their_obstacles_and_lights(tmp_path):
    folder = write_frames(tmp_path / "a", obstacles=[SPHERE], frames=2).path
    call("smoke", "light", folder, "-o", tmp_path / "lit", "--resolution", 24)
    call("smoke", "light", folder, "-o", tmp_path / "traced", "--resolution", 24, "--samples", 4, "--sky", "1,1,1")
    for name in ("lit", "traced"):
        pictures = [png(tmp_path / name / f"light_000{n}.png") for n in (1, 2)]
        assert not np.array_equal(*pictures)
    # In front of an even sky the sphere is black, and the corner is not.
    assert not pictures[1].all() and pictures[1][0, 0].all()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--light", "0,0,0"), "--light"),
        (("--point", "0,0,0:-1"), "--point"),
        (("--samples", "4", "--background", "1,1,1"), "--background cannot be used with --samples"),
    ],
)
def test_wrong_options_are_one_line(volume, tmp_path, words, message):
    output = tmp_path / "out.png"
    assert message in fails("smoke", "light", volume, "-o", output, *SMALL, *words)
    assert not output.exists()
