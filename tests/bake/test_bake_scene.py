"""The inputs of a bake: scene files, surfaces, places and the sun, and those of a demo. Mitsuba is not needed."""

import io
import json
import math
import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
from builders.bake_rooms import ROOM, quad
from builders.checks import error_of
from builders.gltf_scene import Thing, write_scene
from builders.running import report_always
from builders.worker_pools import ToyBaker
from PIL import Image
from typer.testing import CliRunner

from wlm.bake import work
from wlm.bake.daylight import sun_direction
from wlm.bake.geometry import Geometry, read_geometry
from wlm.bake.lightmaps import BakedLightmaps, write_lightmaps
from wlm.bake.probes import BakedProbes, place_probes, write_probes
from wlm.bake.settings import Lamp, LightmapSettings, ProbeSettings
from wlm.bake.texels import place_texels
from wlm.bake.work import each_hour, open_checkpoint, open_task
from wlm.cli import app
from wlm.dispatch import Place
from wlm.errors import WlmError
from wlm.formats.gltf import read_gltf, vertex_normals
from wlm.inspection import inspect
from wlm.lightmap import load
from wlm.probe.data import load as load_probes


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"hours": [3, 3.0000000001]}, "hours: expected different hours"),
        ({"hours": [24], "period": 24}, "below the period of 24"),
        ({"lamps": [{"material": "a", "lit": [18, 30]}], "period": 24}, "lamps: lit: expected hours from 0 to"),
        ({"daylight": {}, "sky": {}}, "found both"),
        ({"lamps": [{"material": "a", "position": [0, 0, 0]}]}, "either a position or a material"),
        ({"lamps": [{"material": "a", "intensity": [1, 1, 1]}]}, "an intensity for a lamp with a position"),
        ({"bounce": 3}, "did you mean 'bounces'"),
        ({"geometry": "../room.gltf"}, "expected a file within"),
    ],
)
def test_a_wrong_scene_is_refused_in_a_line(tmp_path, change, said):
    (tmp_path / "a").mkdir()
    path = tmp_path / "a" / "scene.yaml"
    path.write_text(json.dumps({"geometry": "room.gltf"} | change))
    assert re.search("scene.yaml: (?!.*[Vv]alue.error).*" + said.replace("[", r"\["), error_of(open_task, path))


def test_lamps_are_lit_past_midnight():
    late, day = (Lamp(material="a", lit=lit) for lit in ((18.0, 5.5), (6.0, 18.0)))
    assert [late.is_lit(hour) for hour in (17.9, 18.0, 23.0, 0.0, 5.4, 5.5)] == [False, True, True, True, True, False]
    assert [day.is_lit(hour) for hour in (5.9, 6.0, 17.9, 18.0)] == [False, True, True, False]


def test_the_sun_rises_in_the_east_and_is_highest_at_noon():
    equinox = 81
    assert sun_direction(6.0, 40.0, equinox) == pytest.approx([1, 0, 0], abs=0.02)
    noon = sun_direction(12.0, 40.0, equinox)
    assert noon == pytest.approx([0, math.cos(math.radians(40)), math.sin(math.radians(40))], abs=0.02)
    assert sun_direction(0.0, 40.0, equinox)[1] < 0
    # In summer it is 23.44 degrees higher; north turned by 90 degrees from -z lies at -x, and east at -z.
    assert math.degrees(math.asin(sun_direction(12.0, 40.0, 172)[1])) == pytest.approx(50 + 23.44, abs=0.1)
    assert sun_direction(6.0, 40.0, equinox, north=90.0) == pytest.approx([0, 0, -1], abs=0.02)
    assert sun_direction(5.0, 40.0, equinox, period=10.0) == pytest.approx(noon)


def test_texels_lie_on_their_surface():
    floor = quad([1, 2, 3], [4, 0, 0], [0, 0, -2], uv=[(0.25, 0.25), (1, 0.25), (1, 0.75), (0.25, 0.75)])
    texels = place_texels("here", [floor], 8, 4)
    assert len(texels.index) == 6 * 4 and (texels.coverage == 1).all() and (np.diff(texels.first) == 16).all()
    row, column = np.divmod(texels.index, 8)
    middle = np.add.reduceat(texels.position, texels.first[:-1]) / 16
    u, v = (column + 0.5) / 8, (row + 0.5) / 8
    assert middle == pytest.approx(
        np.stack([1 + (u - 0.25) / 0.75 * 4, 2 + 0 * u, 3 - (v - 0.25) / 0.5 * 2], 1), abs=1e-5
    )
    assert (texels.normal == [0, 1, 0]).all() and (texels.face == [0, 1, 0]).all()
    assert (texels.image(texels.coverage) > 0).sum() == 24
    # A chart that ends within a texel covers a part of it.
    part = place_texels("here", [replace(floor, uv=np.array([(0, 0), (0.1875, 0), (0.1875, 1), (0, 1)]))], 8, 4)
    assert part.coverage.reshape(8, 2) == pytest.approx(np.tile([1.0, 0.5], (8, 1)))


def test_normals_on_the_wrong_side_are_the_triangles_own():
    floor = quad([0, 0, 0], [1, 0, 0], [0, 0, -1])
    turned = replace(floor, normal=np.array([[0, 1, 0], [0, -1, 0], [0, 0, 0], [0.6, 0.8, 0]]))
    normal = place_texels("here", [turned], 8, 1).normal
    assert (normal[:, 1] > 0.7).all() and np.linalg.norm(normal, axis=1) == pytest.approx(1, abs=1e-5)


def test_charts_on_each_other_are_refused():
    floor = quad([0, 0, 0], [1, 0, 0], [0, 0, -1])
    with pytest.raises(WlmError, match="room: lightmap UVs: 100% .* lightmap.unwrap: true"):
        place_texels("room", [floor, quad([0, 1, 0], [1, 0, 0], [0, 0, -1])], 16, 2)
    with pytest.raises(WlmError, match="room: expected surfaces with lightmap UVs"):
        place_texels("room", [replace(floor, uv=None)], 16, 2)


def test_new_uvs_are_even_and_apart(tmp_path):
    pytest.importorskip("uvunwrap")
    settings = LightmapSettings(resolution=128, unwrap=True)
    geometry = read_geometry(ROOM / "room.gltf", settings)
    texels = place_texels("room", geometry.surfaces, 128, 4)
    scale = []
    for surface in geometry.surfaces:
        a, b, c = surface.position[surface.triangle].transpose(1, 0, 2)
        world = np.linalg.norm(np.cross(b - a, c - a), axis=1)
        p, q, r = surface.uv[surface.triangle].transpose(1, 0, 2)
        chart = np.abs((q - p)[:, 0] * (r - p)[:, 1] - (q - p)[:, 1] * (r - p)[:, 0])
        scale += (chart / world).tolist()
    assert max(scale) < 1.3 * min(scale) and texels.coverage.sum() > 0.3 * 128**2
    with pytest.raises(WlmError, match="room.gltf: no lightmap UVs in TEXCOORD_[01]"):
        read_geometry(ROOM / "room.gltf", LightmapSettings())


@pytest.mark.parametrize(
    "what, number, change, said",
    [
        ("nodes", 0, {"translation": [1e7, 0, 0]}, "farthest coordinate, 1e.07"),
        ("nodes", 0, {"scale": [1e-5] * 3}, "float32 rays are too coarse"),
        ("nodes", 0, {"scale": [1e30] * 3}, "scene diagonal from .* to 1e.09"),
        ("materials", 1, {"emissiveFactor": [1e39] * 3}, r"materials\[1\]: expected an emission"),
        ("materials", 1, {"pbrMetallicRoughness": {"baseColorFactor": [math.nan] * 4}}, "base colour .* none NaN"),
    ],
)
def test_what_float32_would_lose_is_refused_in_a_line(tmp_path, what, number, change, said):
    content = json.loads((ROOM / "room.gltf").read_text())
    content[what][number] |= change
    path = tmp_path / "room.gltf"
    path.write_text(json.dumps(content))
    assert re.search(said, error_of(read_geometry, path, None))


def test_normals_turn_with_their_node(tmp_path):
    content = json.loads((ROOM / "room.gltf").read_text())
    content["nodes"][0] |= {"scale": [-1, 2, 0.5], "rotation": [0, math.sin(0.4), 0, math.cos(0.4)]}
    path = tmp_path / "room.gltf"
    path.write_text(json.dumps(content))
    document, primitives = read_gltf(path)
    for primitive, normal in zip(primitives, vertex_normals(document, primitives), strict=True):
        a, b, c = primitive.position[primitive.triangle].transpose(1, 0, 2)
        face = np.cross(b - a, c - a)
        face /= np.linalg.norm(face, axis=1, keepdims=True)
        # The node mirrors, and the triangles keep their front.
        assert np.einsum("fk,fck->fc", face, normal[primitive.triangle]) == pytest.approx(1, abs=1e-4)
    surfaces = read_geometry(path, None).surfaces
    a, b, c = surfaces[0].position[surfaces[0].triangle].transpose(1, 0, 2)
    assert (np.einsum("fk,fk->f", np.cross(b - a, c - a), surfaces[0].normal[surfaces[0].triangle[:, 0]]) > 0).all()


def test_probes_are_in_a_lattice():
    geometry = Geometry(None, (quad([0, 0, 0], [4, 0, 0], [0, 0, -2]), quad([0, 3, 0], [1, 0, 0], [0, 0, -1])), ())
    lattice = place_probes(ProbeSettings(spacing=1.0), geometry)
    assert len(lattice) == 4 * 3 * 2 and lattice.min(0).tolist() == [0.5, 0.5, -1.5]
    with pytest.raises(WlmError, match="probes.spacing: expected at most 1,048,576"):
        place_probes(ProbeSettings(spacing=0.001), geometry)


def test_finished_hours_are_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(work, "HourBaker", ToyBaker)
    report_always(monkeypatch)
    shutil.copytree(ROOM, tmp_path / "room")
    task = open_task(tmp_path / "room" / "room.yaml")
    geometry, output, reports = read_geometry(task.geometry, None), tmp_path / "set", []

    def stop(progress):
        reports.append(progress.done)
        if progress.done > 200:
            raise KeyboardInterrupt

    def bake(progress=None, workers=None, device="cpu", **options):
        checkpoint = open_checkpoint(output, task, "lightmaps", "cpu", **options)
        place = Place(device, workers)
        return each_hour(task, geometry, "irradiance", np.zeros(2), (2, 3), place, checkpoint, progress)

    with pytest.raises(KeyboardInterrupt):
        bake(stop)
    assert reports == [50, 100, 100, 150, 200, 200, 250]
    reports.clear()
    results = bake(lambda progress: reports.append(progress.done), resume=True)
    assert reports[0] == 250 and [float(each["mean"][1, 2]) for each in results] == sorted(task.scene.hours)
    assert "workers: expected 1 on a GPU of this machine" in error_of(bake, workers=2, device="cuda")
    changed = replace(task, scene=task.scene.model_copy(update={"samples": 8}))
    said = "set.partial: the checkpoint is of another fit: it was made with scene samples=256, not 8"
    assert re.search(said, error_of(open_checkpoint, output, changed, "lightmaps", "cpu", resume=True))


def test_what_is_written_is_a_set(tmp_path):
    shutil.copytree(ROOM, tmp_path / "room")
    task = open_task(tmp_path / "room" / "room.yaml")
    geometry = read_geometry(task.geometry, None)
    generator, mask = np.random.default_rng(0), np.zeros((16, 16), bool)
    mask[:8] = True
    light = generator.random((2, 16, 16, 3)).astype(np.float16)
    baked = BakedLightmaps((6.5, 18.0), light, light * 0.01, mask, mask * 1.0, mask * 0.0, geometry)
    files = write_lightmaps(tmp_path / "set", task, baked)
    assert {path.name for path in files} == {path.name for path in (tmp_path / "set").iterdir()}
    lightmaps = load(tmp_path / "set").light
    assert lightmaps.times.tolist() == [6.5, 18.0] and lightmaps.period == 24.0 and (lightmaps.mask == mask).all()
    assert (lightmaps.frames == light).all() and lightmaps.mesh.is_file()
    assert baked.error == pytest.approx([0.01, 0.01], rel=0.01)
    told = inspect(tmp_path / "set")
    assert len(told) == 1 and told[0].command.startswith("wlm compress")
    # A second bake of one hour replaces it all.
    write_lightmaps(tmp_path / "set", task, replace(baked, hours=(7.0,), light=light[:1], noise=light[:1]))
    assert not (tmp_path / "set" / "light_18h.exr").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "mine").write_text("")
    assert "found other files" in error_of(write_lightmaps, tmp_path / "other", task, baked)


def test_probes_of_several_hours_have_their_keys(tmp_path):
    values = np.random.default_rng(0).random((2, 5, 9, 3)).astype(np.float32)
    position = np.random.default_rng(1).random((5, 3)).astype(np.float32)
    write_probes(tmp_path / "p.npz", BakedProbes((6.0, 18.5), position, values, values))
    assert (load_probes(tmp_path / "p.npz", key="18.5h").values == values[1].reshape(5, 27)).all()
    assert load_probes(tmp_path / "p.npz").times.tolist() == [6.0, 18.5]


def test_without_the_extra_a_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mitsuba", None)
    shutil.copytree(ROOM, tmp_path / "room")
    for what, output in (("lightmaps", "set"), ("probes", "p.npz")):
        run = CliRunner().invoke(
            app, ["bake", what, str(tmp_path / "room" / "room.yaml"), "-o", str(tmp_path / output)]
        )
        assert run.exit_code == 2 and "mitsuba is missing" in run.stderr and "pip install 'wlm[bake]'" in run.stderr
        assert run.stderr.count("\n") == 1 and not (tmp_path / output).exists()


def textured(folder, transform, data=None):
    """A square with a texture of one white pixel, in a glTF file."""
    picture = io.BytesIO()
    Image.new("RGB", (1, 1), "white").save(picture, "PNG")
    used = {"index": 0, "extensions": {"KHR_texture_transform": transform}}
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    square = Thing(
        "square",
        np.column_stack([corners, np.zeros(4)]),
        [[0, 1, 2], [0, 2, 3]],
        [corners * 0.5, corners],
        material={"pbrMetallicRoughness": {"baseColorTexture": used}},
    )
    (folder / "a.png").write_bytes(picture.getvalue() if data is None else data)
    extra = {"textures": [{"source": 0}], "images": [{"uri": "a.png"}]}
    return write_scene(folder / "square.gltf", [square], extra)


def test_a_textures_place_is_read(tmp_path):
    """Scale, then a quarter turn, then offset, of the set that the extension names."""
    given = {"scale": [2.0, 0.5], "rotation": math.pi / 2, "offset": [0.25, 0.0], "texCoord": 1}
    (surface,) = read_geometry(textured(tmp_path, given), None).surfaces
    u, v = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float).T
    assert surface.texture_uv == pytest.approx(np.column_stack([0.5 * v + 0.25, -2.0 * u]), abs=1e-6)
    (surface,) = read_geometry(textured(tmp_path, {}), None).surfaces
    assert surface.texture_uv == pytest.approx(0.5 * np.column_stack([u, v]), abs=1e-6)
    wrongs = {"scale": 2.0}, {"offset": [0, math.nan]}, {"rotation": [1]}, {"scale": ["x", 1]}, {"texCoord": [1]}
    for wrong in (*wrongs, {"texCoord": {}}):
        assert "square.gltf: " in error_of(read_geometry, textured(tmp_path, wrong), None)


def test_what_is_no_picture_is_refused_without_pythons_words(tmp_path):
    with pytest.raises(WlmError, match=r"textures\[0\]: expected a PNG, JPEG or WebP image$"):
        read_geometry(textured(tmp_path, {}, b"not a picture"), None)


BAKED = ROOM.parent / "data" / "cornell"


def test_lightmaps_are_of_the_scenes_hours():
    scene = open_task(ROOM / "room.yaml").scene
    lightmaps = load(BAKED).light
    assert lightmaps.times.tolist() == list(scene.hours) and lightmaps.period == scene.period
    assert lightmaps.mask.shape == (scene.lightmap.resolution, scene.lightmap.resolution)
    means = (float(frame[lightmaps.mask].mean()) for frame in lightmaps.frames)
    light = dict(zip(scene.hours, means, strict=True))
    # The sun is low in the window at eight, and has left it at noon; at 20 h the lamp is lit.
    assert light[8] > 3 * light[12] and light[20] > 3 * light[17]


def test_probes_are_where_the_scene_has_them():
    task = open_task(ROOM / "room.yaml")
    scene, path = task.scene, task.geometry
    places = place_probes(scene.probes, read_geometry(path, None))
    for hour in scene.hours:
        probes = load_probes(BAKED / "probes.npz", key=f"{hour:g}h")
        np.testing.assert_allclose(probes.position, places, atol=1e-6)
        assert probes.live.any()
