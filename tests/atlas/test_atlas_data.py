"""Input: meshes, lists of lightmaps, which mesh a lightmap belongs to, the coverage of texels, and new UVs."""

import json
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.gltf_scene import Thing, box, write_scene
from builders.rooms import write_room
from PIL import Image

from wlm.atlas.coverage import covered_texels, touched_texels
from wlm.atlas.data import LightmappedScene, from_arrays, join, load
from wlm.atlas.evaluation import compare
from wlm.atlas.listing import read_listing
from wlm.atlas.stored import with_uvs
from wlm.formats.exr import HALF_MAX, write_exr
from wlm.formats.gltf import document_from_meshes, read_gltf
from wlm.formats.gltf_writer import Replacement, write_glb
from wlm.inspection import inspect

HEIGHT, WIDTH = 6, 8
POSITION = np.array([[0, 0, 0], [2, 0, 0], [0, 3, 0], [2, 3, 0]], np.float64)
TRIANGLE = np.array([[0, 1, 2], [2, 1, 3]])
# Columns 2 to 5 and rows 0 to 2.
UV = np.array([[0.25, 0], [0.75, 0], [0.25, 0.5], [0.75, 0.5]], np.float64)
OBJ = """v 0 0 0\nv 2 0 0\nv 0 3 0\nv 2 3 0
vt 0.25 1\nvt 0.75 1\nvt 0.25 0.5\nvt 0.75 0.5
f 1/1 2/2 3/3\nf 3/3 2/2 4/4\n"""


def _lightmap() -> np.ndarray:
    """Texels that half floats hold exactly, no two alike."""
    return np.arange(1, HEIGHT * WIDTH * 3 + 1, dtype=np.float32).reshape(HEIGHT, WIDTH, 3) / 64


def _chart() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[0:3, 2:6] = True
    return mask


def _files(folder: Path, second: np.ndarray | None = None) -> tuple[Path, Path]:
    """Writes a mesh, with a second UV set if one is given, and its lightmap."""
    document, (primitive,) = document_from_meshes([("square", POSITION, TRIANGLE, UV)], "square")
    new = [] if second is None else [Replacement(primitive, np.arange(4), TRIANGLE, second)]
    write_glb(folder / "square.glb", document, new, 1)
    write_exr(folder / "light.exr", _lightmap())
    return folder / "square.glb", folder / "light.exr"


def _write_mesh(path: Path, scene: LightmappedScene, corner_uv: np.ndarray) -> int:
    """Writes a scene with one more UV set; gives its number."""
    glb, number = with_uvs(scene, corner_uv)
    path.write_bytes(glb)
    return number


def _with(array: np.ndarray, at: object, value: object) -> np.ndarray:
    changed = array.copy()
    changed[at] = value
    return changed


@pytest.mark.parametrize("kind", ["glb", "obj", "arrays"])
def test_a_mesh_from_files_and_arrays(tmp_path, kind):
    glb, light = _files(tmp_path)
    (tmp_path / "square.obj").write_text(OBJ)
    if kind == "arrays":
        mesh = from_arrays(POSITION, TRIANGLE, UV, _lightmap(), name="square")
    else:
        mesh = load(glb.with_suffix(f".{kind}"), light)
    assert (mesh.name, mesh.uv_set, mesh.warnings) == ("square", 0, ())
    np.testing.assert_array_equal(mesh.sheets[0].position, POSITION)
    np.testing.assert_array_equal(mesh.sheets[0].triangle, TRIANGLE)
    np.testing.assert_array_equal(mesh.sheets[0].uv, UV)
    np.testing.assert_array_equal(mesh.sheets[0].lightmap[_chart()], _lightmap()[_chart()])
    np.testing.assert_array_equal(mesh.sheets[0].mask, _chart())
    (sheet,) = mesh.sheets
    assert sheet.active.all() and [sheet.position.dtype, sheet.uv.dtype] == [np.float64] * 2
    assert [sheet.triangle.dtype, sheet.lightmap.dtype, sheet.mask.dtype] == [np.int32, np.float32, bool]
    assert mesh.source == from_arrays(POSITION, TRIANGLE, UV, _lightmap()).source


def test_source_names_all_that_counts():
    base = (POSITION, TRIANGLE, UV, _lightmap(), _chart())
    sources = {from_arrays(*base).source}
    changes = ((0, (1, 1), 0.5), (1, 1, [2, 3, 1]), (2, (1, 0), 0.8), (3, (1, 3, 1), 7.0), (4, (5, 5), True))
    for which, at, value in changes:
        arrays = list(base)
        arrays[which] = _with(arrays[which], at, value)
        sources.add(from_arrays(*arrays).source)
    assert len(sources) == 6 and all(len(source) == 16 for source in sources)


def test_the_second_set_is_the_lightmaps_unless_told(tmp_path):
    files = _files(tmp_path, UV + 0.125)
    mesh = load(*files)
    assert mesh.uv_set == 1
    np.testing.assert_array_equal(mesh.sheets[0].uv, UV + 0.125)
    mesh = load(*files, uv_set=0)
    assert mesh.uv_set == 0
    np.testing.assert_array_equal(mesh.sheets[0].uv, UV)
    assert "expected the UV set TEXCOORD_2, found TEXCOORD_0, TEXCOORD_1" in error_of(load, *files, uv_set=2)
    _write_mesh(files[0], mesh, mesh.sheets[0].uv[mesh.sheets[0].triangle] * 0.5)
    assert sorted(load(*files).sheets[0].parts[0].primitive.uv) == [0, 1, 2] and load(*files).uv_set == 1


def test_several_primitives_nodes_and_one_without_the_set(tmp_path):
    glb, light = _files(tmp_path, UV)
    document, _ = read_gltf(glb)
    (primitive,) = document.content["meshes"][0]["primitives"]
    bare = {**primitive, "attributes": {"POSITION": primitive["attributes"]["POSITION"]}}
    document.content["meshes"][0]["primitives"] = [bare, primitive]
    document.content["nodes"].append({"mesh": 0, "translation": [5, 0, 0]})
    document.content["scenes"][0]["nodes"] = [0, 1]
    write_glb(glb, document, [], 1)
    mesh = load(glb, light)
    np.testing.assert_array_equal(mesh.sheets[0].position, np.concatenate([POSITION, POSITION + [5, 0, 0]]))
    np.testing.assert_array_equal(mesh.sheets[0].triangle, np.concatenate([TRIANGLE, TRIANGLE + 4]))
    (sheet,) = mesh.sheets
    assert [(part.vertex, part.triangle, part.primitive.node) for part in sheet.parts] == [(0, 0, 0), (4, 2, 1)]
    np.testing.assert_array_equal(mesh.sheets[0].mask, _chart())
    left_out, overlap = mesh.warnings
    assert "2 primitives of 4 without TEXCOORD_1, first node 0, mesh 0, primitive 0: left out" in left_out
    assert overlap == "square: 12 texels in several triangles: their UVs overlap"
    corner_uv = np.random.default_rng(2).integers(0, 64, (4, 3, 2)) / 64
    assert _write_mesh(tmp_path / "out.glb", mesh, corner_uv) == 2
    again = load(tmp_path / "out.glb", light, uv_set=2)
    np.testing.assert_array_equal(again.sheets[0].uv[again.sheets[0].triangle], corner_uv)
    np.testing.assert_array_equal(again.sheets[0].position[again.sheets[0].triangle], sheet.position[sheet.triangle])
    unchanged = read_gltf(tmp_path / "out.glb")[1][0]
    assert list(unchanged.uv) == [] and np.array_equal(unchanged.triangle, TRIANGLE)


def test_no_uvs_no_triangles_and_other_names(tmp_path):
    glb, light = _files(tmp_path)
    document, _ = read_gltf(glb)
    del document.content["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_0"]
    write_glb(glb, document, [], 1)
    assert "expected the UV set TEXCOORD_0, found a mesh without UVs" in error_of(load, glb, light)
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3")
    assert "the mesh has no UVs, or some" in error_of(load, tmp_path / "a.obj", light)
    (tmp_path / "a.gltf").write_text(json.dumps({"asset": {"version": "2.0"}}))
    assert "a.gltf: has no triangles" in error_of(load, tmp_path / "a.gltf", light)
    assert "expected a name that ends in one of .glb" in error_of(load, tmp_path / "a.fbx", light)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"position": POSITION[:, :2]}, "position: expected numbers [N, 3], got float64 (4, 2)"),
        ({"triangle": TRIANGLE + 1}, "triangle: expected vertex numbers 0 to 3, found 1 to 4"),
        ({"mask": np.zeros((HEIGHT, WIDTH))}, "thing: mask: the mask is empty"),
        ({"position": _with(POSITION, (3, 1), np.nan)}, "POSITION of vertex 3: expected finite numbers, got (2, nan"),
        ({"uv": _with(UV, (2, 0), np.nan)}, "TEXCOORD_0 of vertex 2: expected finite numbers, got (nan, "),
        ({"lightmap": _with(_lightmap(), np.s_[:3], np.nan)}, "lightmap: expected a finite texel inside the mask"),
    ],
)
def test_what_is_refused(change, words):
    arrays = {"position": POSITION, "triangle": TRIANGLE, "uv": UV, "lightmap": _lightmap(), **change}
    text = error_of(from_arrays, **arrays, name="thing")
    assert words in text and text.startswith("thing")


def test_a_reflection_probe_is_asked_about():
    assert "6 x 1, as a cube's six faces" in from_arrays(POSITION, TRIANGLE, UV, np.ones((1, 6, 3))).warnings[0]


def test_uvs_outside_are_clamped():
    uv = UV.copy()
    uv[[1, 3], 0] = 1.5
    uv[0, 1] = -1e-3
    mesh = from_arrays(POSITION, TRIANGLE, uv, _lightmap())
    np.testing.assert_array_equal(mesh.sheets[0].uv, np.clip(uv, 0, 1))
    assert mesh.warnings == ("array: 3 vertices with UVs outside [0, 1], by up to 0.5: clamped",)
    assert np.array_equal(mesh.sheets[0].mask, np.pad(np.ones((3, 6), bool), ((0, 3), (2, 0))))


def test_triangles_without_area_are_kept_and_take_no_part():
    position = np.concatenate([POSITION, POSITION[:1], [[1, 0, 0]]])
    uv = np.concatenate([UV, [[1, 1], [1, 0]]])
    # None in space (one point twice, three in a line); none in UV; one whose corners are one vertex.
    triangle = np.concatenate([TRIANGLE, [[0, 4, 1], [0, 5, 1], [1, 1, 1]]])
    mesh = from_arrays(position, triangle, uv, _lightmap())
    assert mesh.sheets[0].active.tolist() == [True, True, False, False, False] and len(mesh.sheets[0].triangle) == 5
    assert mesh.warnings == ("array: 3 triangles without area in space or in UV: left out",)
    np.testing.assert_array_equal(mesh.sheets[0].mask, _chart())
    flat = from_arrays(POSITION, np.array([[0, 1, 2], [0, 1, 3]]), _with(UV, 3, [0.5, 0]), _lightmap())
    assert flat.sheets[0].active.tolist() == [True, False]
    assert "no triangle has an area" in error_of(from_arrays, POSITION, TRIANGLE, UV * 0, _lightmap())


@pytest.mark.parametrize("scale", [1e-30, 1e-12, 1e30])
def test_small_and_huge_triangles_have_area(scale):
    mesh = from_arrays(POSITION * scale, TRIANGLE, UV * min(scale, 1.0), _lightmap())
    assert mesh.sheets[0].active.all() and len(mesh.warnings) == (scale < 1)
    assert mesh.sheets[0].mask[0, 2 if scale > 1 else 0]


def test_one_triangle_within_a_texel():
    uv = np.array([[0.51, 0.52], [0.52, 0.52], [0.51, 0.53]])
    mesh = from_arrays(POSITION[:3], TRIANGLE[:1], uv, _lightmap())
    assert np.argwhere(mesh.sheets[0].mask).tolist() == [[3, 4]]
    assert mesh.warnings[0].startswith("array: all triangles together have 0.0024 texels of 8 x 6 in TEXCOORD_0: are")


def test_broken_texels_are_repaired_as_stated():
    lightmap = _lightmap()
    lightmap[0, 2, 1], lightmap[2, 5, 0] = np.nan, np.inf  # inside
    lightmap[1, 3], lightmap[1, 4, 2] = -1, 1e6
    lightmap[5, 0], lightmap[5, 1], lightmap[5, 2] = np.nan, -1, 1e6  # outside
    before = lightmap.copy()
    mesh = from_arrays(POSITION, TRIANGLE, UV, lightmap)
    np.testing.assert_array_equal(lightmap, before)
    assert any(np.array_equal(mesh.sheets[0].lightmap[0, 2], before[at]) for at in ((0, 3), (1, 2)))
    assert any(np.array_equal(mesh.sheets[0].lightmap[2, 5], before[at]) for at in ((2, 4), (1, 5)))
    assert (mesh.sheets[0].lightmap[1, 3] == 0).all() and mesh.sheets[0].lightmap[1, 4, 2] == HALF_MAX
    inside = {tuple(texel) for texel in mesh.sheets[0].lightmap[_chart()].tolist()}
    assert all(tuple(mesh.sheets[0].lightmap[5, i].tolist()) in inside for i in range(3))  # filled
    assert mesh.warnings == (
        "array: lightmap: 2 texels NaN or infinite: replaced by the nearest finite one in the mask",
        "array: lightmap: 1 texel negative: clamped to 0",
        "array: lightmap: 1 texel above 65,504: clamped to it",
    )


def test_a_mask_that_is_given(tmp_path):
    files = _files(tmp_path)
    mask = _with(_chart(), (5, 5), True)
    path = tmp_path / "mask.png"
    Image.fromarray(mask.astype(np.uint8)).save(path)
    mesh = load(*files, mask_path=path)
    np.testing.assert_array_equal(mesh.sheets[0].mask, mask)
    assert mesh.warnings == ()
    Image.fromarray(mask[::-1].astype(np.uint8)).save(path)
    (warning,) = load(*files, mask_path=path).warnings
    assert "square: 11 texels of 12 that triangles cover are outside the mask: does it belong to another" in warning


def test_a_mask_that_is_derived_leaves_out_what_was_never_baked():
    # Columns 1.75 to 6.25: of columns 1 and 6 no centre is covered.
    uv = np.where(UV == 0.25, 1.75 / WIDTH, np.where(UV == 0.75, 6.25 / WIDTH, UV))
    uv[:, 1] = UV[:, 1]
    lightmap = _lightmap()
    lightmap[:, 0:3] = 0
    lightmap[1, 1] = np.nan
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[0:3, 2:7] = expected[1, 1] = True
    np.testing.assert_array_equal(from_arrays(POSITION, TRIANGLE, uv, lightmap).sheets[0].mask, expected)
    tiny = np.array([[0.51, 0.52], [0.52, 0.52], [0.51, 0.53]])
    dark = from_arrays(POSITION[:3], TRIANGLE[:1], tiny, lightmap * 0)
    assert np.argwhere(dark.sheets[0].mask).tolist() == [[3, 4]]


def test_texels_touched_and_covered_as_by_cutting_polygons():
    generator = np.random.default_rng(5)
    # Corners on texel corners, on centres, and anywhere.
    for step, count in ((1.0, 40), (0.5, 40), (1e-6, 40)):
        for _ in range(count):
            corner = np.round(generator.random((3, 2)) * (WIDTH, HEIGHT) / step) * step
            if abs(_twice_area(corner)) < 1e-3:
                continue
            uv, triangle = corner / (WIDTH, HEIGHT), np.array([[0, 1, 2]])
            texel = uv * (WIDTH, HEIGHT)
            area = np.array([[_area_within(texel, x, y) for x in range(WIDTH)] for y in range(HEIGHT)])
            touched = touched_texels(uv, triangle, HEIGHT, WIDTH)
            assert touched[area > 1e-9].all() and not touched[area <= 0].any()
            strict, loose = (_holds_centres(texel, margin) for margin in (1e-9, -1e-9))
            covered = covered_texels(uv, triangle, HEIGHT, WIDTH)
            assert (covered[strict] == 1).all() and (covered[~loose] == 0).all()


def test_every_centre_of_a_cut_square_is_covered_once():
    generator = np.random.default_rng(6)
    for shift in (0.0, 0.5, 0.25, 1 / 3):
        # A grid of vertices on texel corners, centres or between; half of the inner ones moved; diagonals at random.
        y, x = np.mgrid[0:7, 0:9].astype(np.float64)
        moved = (generator.random(x.shape) < 0.5) & (x > 0) & (x < 8) & (y > 0) & (y < 6)
        x[moved] += shift * generator.choice([-1, 1], moved.sum()) * 0.5
        uv = np.stack([x.ravel() / 8, y.ravel() / 6], axis=1)
        triangle = []
        for row in range(6):
            for column in range(8):
                a = row * 9 + column
                b, c, d = a + 1, a + 9, a + 10
                triangle += [[a, b, c], [c, b, d]] if generator.random() < 0.5 else [[a, b, d], [d, c, a]]
        for height, width in ((6, 8), (12, 16), (7, 5), (1, 1), (30, 40)):
            assert (covered_texels(uv, np.array(triangle), height, width) == 1).all()
            assert touched_texels(uv, np.array(triangle), height, width).all()


def test_many_rows_are_worked_on_in_pieces(monkeypatch):
    generator = np.random.default_rng(7)
    uv, triangle = generator.random((60, 2)), np.arange(60).reshape(-1, 3)
    whole = touched_texels(uv, triangle, 37, 41), covered_texels(uv, triangle, 37, 41)
    monkeypatch.setattr("wlm.atlas.coverage._SPANS_AT_ONCE", 7)
    np.testing.assert_array_equal(touched_texels(uv, triangle, 37, 41), whole[0])
    np.testing.assert_array_equal(covered_texels(uv, triangle, 37, 41), whole[1])
    # Between 1 - 1e-16 and 1, which times 37 are one number.
    thin = np.array([[0.2, 1.0], [0.4, 1.0], [0.2, 1.0 - 2**-53]])
    assert np.argwhere(touched_texels(thin, triangle[:1], 37, 10)).tolist() == [[36, 2], [36, 3]]
    assert not touched_texels(uv, triangle[:0], 3, 4).any() and not covered_texels(uv, triangle[:0], 3, 4).any()


def _twice_area(corner: np.ndarray) -> float:
    (ax, ay), (bx, by) = corner[1:] - corner[0]
    return ax * by - ay * bx


def _area_within(corner: np.ndarray, x: int, y: int) -> float:
    """Area of a triangle within the unit square at (x, y), by cutting it along the square's four sides."""
    polygon = list(corner)
    for axis, sign, limit in ((0, 1, x), (0, -1, -x - 1), (1, 1, y), (1, -1, -y - 1)):
        clipped = []
        for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
            inside_a, inside_b = sign * a[axis] - limit, sign * b[axis] - limit
            if inside_a >= 0:
                clipped.append(a)
            if inside_a * inside_b < 0:
                clipped.append(a + (b - a) * inside_a / (inside_a - inside_b))
        polygon = clipped
        if not polygon:
            return 0.0
    px, py = np.array(polygon).T
    return abs(np.dot(px, np.roll(py, -1)) - np.dot(py, np.roll(px, -1))) / 2


def _holds_centres(corner: np.ndarray, margin: float) -> np.ndarray:
    """Which centres lie further within a triangle than the margin, bool [HEIGHT, WIDTH]."""
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    (ax, ay), (bx, by), (cx, cy) = corner if _twice_area(corner) > 0 else corner[::-1]
    corners = ((ax, ay), (bx, by), (cx, cy), (ax, ay))
    sides = [(qx - px) * (y - py) - (qy - py) * (x - px) for (px, py), (qx, qy) in pairwise(corners)]
    return np.min(sides, axis=0) > margin


def test_one_mesh_and_many_are_one_class():
    """Lightmaps of several states share a mask and are repaired one by one; scenes are joined sheet by sheet."""
    dark = np.zeros_like(_lightmap())
    dark[1, 3] = -1.0
    scene = from_arrays(POSITION, TRIANGLE, UV, np.stack([dark, _lightmap()]), name="square")
    assert scene.states == ("0", "1") and scene.texels == 2 * HEIGHT * WIDTH
    np.testing.assert_array_equal(scene.sheets[0].mask, _chart())
    assert scene.warnings == ("square: lightmap 0: 1 texel negative: clamped to 0",)
    other = from_arrays(POSITION + 5.0, TRIANGLE, UV, np.ones((2, 4, 4, 3)), name="other", metres=True)
    both = join([scene, other], "both")
    assert [sheet.name for sheet in both.sheets] == ["square", "other"] and not both.metres
    assert both.triangles.sheet.tolist() == [0, 0, 1, 1] and both.triangles.triangle.max() == 7
    np.testing.assert_array_equal(both.triangles.position[4:], POSITION + 5.0)
    assert both.source != scene.source
    single = from_arrays(POSITION, TRIANGLE, UV, _lightmap())
    assert "expected scenes with the same number of states" in error_of(join, [scene, single])


def picture(path, size):
    values = np.random.default_rng(size).random((size, size, 3)).astype(np.float32)
    values[:, size // 2 :] = 0
    write_exr(path, values)


def test_each_picture_of_a_folder_is_a_sheet(tmp_path):
    assert f"{tmp_path}: expected lightmaps" in error_of(read_listing, tmp_path)
    for name, size in (("wall.exr", 16), ("box.exr", 32)):
        picture(tmp_path / name, size)
    (tmp_path / "notes.txt").write_text("none")
    scene = read_listing(tmp_path)
    assert [scene.file(each.files[0], False).name for each in scene.sheets] == ["box.exr", "wall.exr"]
    assert all(scene.file(each.files[0], False).is_file() for each in scene.sheets) and scene.objects is None
    write_room(tmp_path / "room.glb")
    (found,) = inspect(tmp_path)
    assert "box.exr and wall.exr are both lightmaps of room" in found.problems[1] and not found.command


MAP_SIDE = 96


def baked(uv: np.ndarray, dilated: bool = False) -> np.ndarray:
    """A smooth light in each of a box's charts, by UV; the gaps are black, or hold the nearest."""
    mesh = from_arrays(*box((0, 0, 0), (1, 1, 1))[:2], uv, np.ones((MAP_SIDE, MAP_SIDE, 3)))
    row, column = np.mgrid[:MAP_SIDE, :MAP_SIDE] / MAP_SIDE
    level = 1.0 + np.floor(3 * column) + 3 * np.floor(2 * row)  # of the chart's cell
    light = (level * (1.0 + 0.2 * np.sin(9 * column) * np.cos(7 * row)))[..., None] * [1.0, 0.8, 0.6]
    return light if dilated else light * mesh.sheets[0].mask[..., None]


def shifted(uv: np.ndarray) -> np.ndarray:
    """Another layout of the charts."""
    return 0.5 * uv + [0.31, 0.17]


def test_a_lightmap_goes_to_the_mesh_that_it_fits(tmp_path):
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    things = [Thing("crate", position, triangle, [uv]), Thing("lamp", position, triangle, [shifted(uv)], (3, 0, 0))]
    scene = write_scene(tmp_path / "a.gltf", things)
    write_exr(tmp_path / "a.exr", baked(uv))
    mesh = load(scene, tmp_path / "a.exr")
    assert [part.primitive.label for part in mesh.sheets[0].parts] == ["crate"]
    assert mesh.warnings[0].startswith("a: 2 meshes lie on each other in TEXCOORD_0: the lightmap fits crate best")
    for name in ("lamp", "lamp-mesh", "1"):
        assert [part.primitive.node for part in load(scene, tmp_path / "a.exr", node=name).sheets[0].parts] == [1]
    assert "node: expected one of crate, lamp, found 'wall'" in error_of(load, scene, tmp_path / "a.exr", node="wall")
    write_exr(tmp_path / "grey.exr", np.ones((MAP_SIDE, MAP_SIDE, 3)))
    assert "expected the name of one as the node (--node): crate, lamp" in error_of(load, scene, tmp_path / "grey.exr")
    # Side by side in one atlas they share it, and so does a second node with the same mesh.
    side = [Thing("a", position, triangle, [uv * [0.5, 1]]), Thing("b", position, triangle, [uv * [0.5, 1] + [0.5, 0]])]
    write_scene(scene, [*side, Thing("c", like=0)])
    assert len(load(scene, tmp_path / "grey.exr").sheets[0].parts) == 3


TURNS = {
    "upside down (--flip)": lambda light: light[::-1],
    "mirrored left to right": lambda light: light[:, ::-1],
    "turned by 180 degrees": lambda light: light[::-1, ::-1],
    "transposed, rows as columns": lambda light: light.swapaxes(0, 1),
    "turned by 90 degrees counterclockwise": lambda light: np.rot90(light, -1),
    "turned by 90 degrees clockwise": np.rot90,
    "transposed and turned by 180 degrees": lambda light: np.rot90(light, 2).swapaxes(0, 1),
}


@pytest.mark.parametrize("size", [(1, 1), (1, 2), pytest.param((16, 16), marks=pytest.mark.slow)])
def test_a_turned_lightmap_is_noticed(tmp_path, size):
    """The warning names the turn that makes it fit; also for a lightmap of another aspect, and for a large one."""
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    uv = shifted(uv)
    light = baked(uv).repeat(size[0], 0).repeat(size[1], 1)
    scene = write_scene(tmp_path / "a.gltf", [Thing("a", position, triangle, [uv])])
    assert not any("smoother" in line for line in from_arrays(position, triangle, uv, light).warnings)
    for words, turn in TURNS.items() if size[0] == 1 else list(TURNS.items())[:1]:
        found = [line for line in from_arrays(position, triangle, uv, turn(light)).warnings if "smoother" in line]
        assert len(found) == 1 and f"of TEXCOORD_0 with the lightmap {words} than in those of TEXCOORD_0" in found[0]
    if size == (1, 1):
        write_exr(tmp_path / "a.exr", light[::-1])
        (sheet,) = load(scene, tmp_path / "a.exr", flip=True).sheets
        np.testing.assert_allclose(sheet.lightmap[sheet.mask], light[sheet.mask], rtol=1e-3)


def test_strays_in_gutters_change_nothing():
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    light = baked(uv, dilated=True)
    clean = from_arrays(position, triangle, uv, light)
    inside = from_arrays(position, triangle, uv, baked(uv)).sheets[0].mask  # charts without their fringe
    gap = np.argwhere(~inside)
    for value in (math.inf, 65024.0, math.nan):
        dirty = light.copy()
        dirty[tuple(gap[::5].T)] = value
        mesh = from_arrays(position, triangle, uv, dirty)
        np.testing.assert_array_equal(mesh.sheets[0].lightmap[inside], clean.sheets[0].lightmap[inside])
        assert mesh.sheets[0].lightmap.max() <= clean.sheets[0].lightmap.max() and mesh.warnings == ()


def test_specks_in_a_chart_are_replaced_and_lamps_are_not():
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    light = baked(uv)
    light[20, 10:14] = 60000.0  # thin
    light[60:63, 12:15] = 500.0  # a lamp
    mesh = from_arrays(position, triangle, uv, light)
    assert mesh.sheets[0].lightmap[20, 10:14].max() < 8.0 and mesh.sheets[0].lightmap[61, 13].min() == 500.0
    assert mesh.warnings == ("array: lightmap: 4 texels in specks far above all other light: replaced",)


def test_the_peak_is_not_one_bright_texel():
    """It is said, beside the brightest; as long as the brightest is below twice nearly all, it is the range."""
    position, triangle, uv = box((0, 0, 0), (1, 1, 1))
    light = baked(uv, dilated=True)
    plain = from_arrays(position, triangle, uv, light)
    light[70, 80] *= 12.0
    lit = from_arrays(position, triangle, uv, light)
    black = {"black": lambda points, state: points.uv.new_zeros((len(points.uv), 3))}
    first, second = (compare(mesh, black, views=8, resolution=64)["black"] for mesh in (plain, lit))
    darkest = plain.sheets[0].lightmap.min()
    assert first.brightest < 8.0 and first.peak == pytest.approx(first.brightest - darkest, rel=0.05)
    assert second.brightest > 30.0 and second.peak < 16.0
