"""Light by Mitsuba against what theory says; without the extra `bake` and LLVM these are skipped.

WLM_BAKE_DEVICE=cuda runs them on the first GPU, which needs no LLVM.
"""

import math
import os
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from builders.bake_rooms import ROOM, quad
from builders.checks import error_of

from wlm.bake.backend import start
from wlm.bake.geometry import Geometry, Material
from wlm.bake.lightmaps import bake_lightmaps
from wlm.bake.probes import bake_probes
from wlm.bake.settings import BakeScene, Daylight, Lamp, ProbeSettings, Sky
from wlm.bake.texels import place_texels
from wlm.bake.work import open_checkpoint, open_task
from wlm.errors import WlmError

DEVICE = os.environ.get("WLM_BAKE_DEVICE", "cpu")

try:
    start(DEVICE)
except WlmError as error:
    pytest.skip(str(error), allow_module_level=True)

import mitsuba as mi  # noqa: E402

from wlm.bake import paths, world  # noqa: E402  (they need Mitsuba)

FLOOR = quad([-1, 0, 1], [2, 0, 0], [0, 0, -2])
SPOT = quad([-0.001, 0, 0.001], [0.002, 0, 0], [0, 0, -0.002])  # a point, nearly, that faces up


def lit(surfaces, samples=1024, bounces=2, picture=None, hour=12.0, **lights) -> np.ndarray:
    """Irradiance of the texels of the surfaces with UVs, [T, 3]."""
    scene = BakeScene(geometry="-", samples=samples, bounces=bounces, seed=1, **lights)
    now, tracing = world.make_hour(scene, Geometry(None, tuple(surfaces), ()), picture, hour)
    texels = place_texels("here", surfaces, 8, 2)
    return paths.irradiance(now, texels, tracing).mean


def harmonics(position, surfaces=(), samples=1024, picture=None, hour=12.0, **lights) -> np.ndarray:
    """[N, 9, 3]."""
    scene = BakeScene(geometry="-", samples=samples, bounces=2, seed=1, **lights)
    far = quad([1000, 1000, 1000], [1, 0, 0], [0, 0, 1], uv=None)
    now, tracing = world.make_hour(scene, Geometry(None, (*surfaces, far), ()), picture, hour)
    gathered = paths.harmonics(now, np.array(position, float), tracing)
    return gathered.mean.reshape(-1, 9, 3)


def box(half: float, material: Material) -> list:
    """Six walls that face the middle, without lightmap UVs."""
    walls = []
    for axis in range(3):
        for side in (-1, 1):
            corner, along, up = np.full(3, -half), np.zeros(3), np.zeros(3)
            corner[axis], along[(axis + 1) % 3], up[(axis + 2) % 3] = side * half, 2 * half, 2 * half
            along, up = (along, up) if side < 0 else (up, along)
            walls.append(quad(corner, along, up, uv=None, material=material))
    return walls


def test_a_plane_under_an_even_sky():
    assert lit([FLOOR], sky=Sky(radiance=(1, 2, 3)), samples=64) / math.pi == pytest.approx(
        np.tile([1.0, 2.0, 3.0], (64, 1)), rel=1e-5
    )


def test_few_samples():
    assert lit([FLOOR], sky=Sky(), samples=4) == pytest.approx(np.full((64, 3), math.pi), rel=1e-5)


def test_a_white_furnace():
    # Every wall glows with 1 and reflects half: 1 + 1/2 + 1/4 and so on is 2 from everywhere.
    walls = box(3.0, Material(colour=(0.5, 0.5, 0.5), emission=(1, 1, 1)))
    black = replace(SPOT, material=Material(colour=(0, 0, 0), double=True))
    assert lit([*walls, black], bounces=1000).mean(0) == pytest.approx([2 * math.pi] * 3, rel=0.01)
    # Three bounces alone leave 1/16 of it out.
    assert lit([*walls, black], bounces=3).mean(0) == pytest.approx([2 * math.pi * 15 / 16] * 3, rel=0.01)


def test_lamps():
    point = Lamp(position=(0, 2, 0), intensity=(4, 8, 12))
    assert lit([SPOT], lamps=[point]).mean(0) == pytest.approx([1, 2, 3], rel=0.01)
    # A square of side 1 at height 1: the form factor of a parallel rectangle above its corner, four times.
    glow = Material(name="glow", emission=(1, 1, 1), colour=(0, 0, 0))
    square = quad([-0.5, 1, -0.5], [1, 0, 0], [0, 0, 1], uv=None, material=glow)
    factor = 4 * 2 * 0.5 / math.sqrt(1.25) * math.atan(0.5 / math.sqrt(1.25)) / (2 * math.pi)
    assert lit([SPOT, square]).mean(0) == pytest.approx([math.pi * factor] * 3, rel=0.01)
    late = Lamp(material="glow", radiance=(3, 3, 3), lit=(18, 20))
    both = [late, Lamp(material="glow", radiance=(1, 1, 1), lit=(20, 6))]
    assert not lit([SPOT, square], lamps=both, hour=12.0).any()
    assert lit([SPOT, square], lamps=both, hour=19.0).mean(0) == pytest.approx([3 * math.pi * factor] * 3, rel=0.01)


def test_the_sun_by_itself_and_in_a_shadow():
    day = Daylight(latitude=0.0, day=81)
    sun = world.daylight(day, 15.0, 24.0)[0]
    both, sky = (lit([FLOOR], daylight=one, hour=15.0).mean(0) for one in (day, replace_direct(day)))
    assert both - sky == pytest.approx(np.array(sun.irradiance) * math.sqrt(0.5), rel=0.01)
    lid = quad([-50, 1, -50], [100, 0, 0], [0, 0, 100], uv=None, material=Material(colour=(0, 0, 0)))
    assert lit([FLOOR, lid], daylight=day, hour=12.0).max() < 0.02 * both.max()
    assert not lit([FLOOR], daylight=day, hour=0.0).any()
    # What the sun lights lights others, whether its own light is in the result or not.
    wall = quad([-1, 0, -1], [2, 0, 0], [0, 2, 0], uv=None, material=Material(colour=(0.9, 0.9, 0.9)))
    facing = replace_direct(Daylight(latitude=60.0, day=81))
    bounced, alone = (lit([SPOT, *walls], daylight=facing, hour=12.0).mean(0) for walls in ([wall], []))
    assert bounced[0] > 1.5 * alone[0]


def replace_direct(day: Daylight) -> Daylight:
    return day.model_copy(update={"direct": False})


def test_a_sky_picture_is_the_right_way_round():
    # Middle column -z, the right quarter +x, the top row +y.
    picture = np.zeros((16, 32, 3), np.float32)
    picture[6:10, 15:17, 0] = picture[6:10, 23:25, 1] = picture[:3, :, 2] = 1.0
    y, z, x = harmonics([[0, 0, 0]], picture=picture, sky=Sky(file="-"))[0, 1:4]
    assert z[0] < -0.9 * np.linalg.norm([x[0], y[0], z[0]])
    assert x[1] > 0.9 * np.linalg.norm([x[1], y[1], z[1]])
    assert y[2] > 0.9 * np.linalg.norm([x[2], y[2], z[2]])
    morning = harmonics([[0, 0, 0]], daylight=replace_direct(Daylight(latitude=0.0, day=81)), hour=7.0)[0]
    assert morning[3].min() > 0.2 * morning[1].min() > 0  # the sky is brighter around the sun, in the east


def test_harmonics_of_an_even_sky_are_one_number():
    light = harmonics([[0, 0, 0], [3, 4, 5]], sky=Sky(radiance=(1, 2, 3)))
    assert light[:, 0] == pytest.approx(np.tile(2 * math.sqrt(math.pi) * np.array([1.0, 2, 3]), (2, 1)), rel=1e-5)
    assert np.abs(light[:, 1:]).max() < 0.01 * light[:, 0].max()


def test_harmonics_of_a_lamp_have_its_direction():
    light = harmonics([[1, 2, 3]], lamps=[Lamp(position=(1, 4, 3), intensity=(4, 4, 4))])[0, :, 0]
    up = np.array(
        [math.sqrt(1 / (4 * math.pi)), math.sqrt(3 / (4 * math.pi)), 0, 0, 0, 0, -0.5 * math.sqrt(5 / (4 * math.pi)), 0]
    )
    assert light[:8] == pytest.approx(up, abs=1e-4)


def test_a_bake_goes_on_where_it_was_stopped(tmp_path):
    pytest.importorskip("uvunwrap")
    shutil.copytree(ROOM, tmp_path / "room")
    path = tmp_path / "room" / "room.yaml"
    path.write_text(
        "{geometry: room.gltf, hours: [7, 20], samples: 16, bounces: 2, daylight: {}, probes: {spacing: 2},"
        " lightmap: {resolution: 64, unwrap: true, padding: 1, supersample: 2},"
        " lamps: [{material: lamp, radiance: [9, 9, 9], lit: [18, 23]}]}"
    )
    task, output = open_task(path), tmp_path / "set"
    whole = bake_lightmaps(task, device=DEVICE)

    def stop(progress):
        if progress.done > 100:  # the first hour is kept by now
            raise KeyboardInterrupt

    checkpoint = open_checkpoint(output, task, "lightmaps", DEVICE)
    with pytest.raises(KeyboardInterrupt):
        bake_lightmaps(task, device=DEVICE, checkpoint=checkpoint, progress=stop)
    again = open_checkpoint(output, task, "lightmaps", DEVICE, resume=True)
    assert again.resumed
    resumed = bake_lightmaps(task, device=DEVICE, checkpoint=again)
    assert (resumed.light == whole.light).all() and (resumed.noise == whole.noise).all()
    # What lies under the boxes is within them, and has its neighbours' light.
    hidden = whole.back > 0.5
    assert hidden.any() and not whole.mask[hidden].any() and (whole.light[1, hidden].max(-1) > 0).all()
    probes = bake_probes(task, device=DEVICE)
    inside = (np.abs(probes.position - [0.8, 0.4, 0.4]) < [0.2, 0.3, 0.2]).all(1)
    assert probes.values[1][~inside].any() and probes.values.shape == (2, len(probes.position), 9, 3)


def test_a_lamp_of_no_material_is_refused(tmp_path):
    shutil.copytree(ROOM, tmp_path / "room")
    path = tmp_path / "room" / "room.yaml"
    path.write_text("{geometry: room.gltf, lamps: [{material: bulb}]}")
    task = open_task(path)
    task = replace(task, scene=task.scene.model_copy(update={"probes": ProbeSettings()}))
    with pytest.raises(WlmError, match="room.yaml: lamps.0.material: expected one of box, green, lamp, red, white"):
        bake_probes(task, device=DEVICE)


def test_a_texture_lies_as_gltf_says():
    # Row 0 is v = 0, which is at the quad's first edge; red there, green at the other, blue on the right of both.
    texture = np.zeros((8, 8, 3), np.float32)
    texture[:4, :4, 0] = texture[4:, :4, 1] = texture[:, 4:, 2] = 0.9
    wall = quad([0, 0, 0], [1, 0, 0], [0, 1, 0], uv=None, material=Material(colour=(1, 1, 1), texture=texture))
    wall = replace(wall, texture_uv=np.array([(0, 0), (1, 0), (1, 1), (0, 1)], np.float32))
    scene = mi.load_dict({"type": "scene", "wall": world._mesh(wall, (0.0, 0.0, 0.0), "wall")})
    places = np.array([[0.25, 0.25, 1], [0.25, 0.75, 1], [0.75, 0.25, 1], [0.75, 0.75, 1]], np.float32)
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(places.T), mi.Vector3f(0, 0, -1)))
    colour = np.array(si.bsdf().eval_diffuse_reflectance(si)).T
    assert colour == pytest.approx(0.9 * np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 1]]), abs=0.01)


def test_the_filter_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    task = open_task(ROOM / "room.yaml")
    assert task.scene.denoise
    assert "pyoidn is missing" in error_of(bake_lightmaps, task, device=DEVICE)
