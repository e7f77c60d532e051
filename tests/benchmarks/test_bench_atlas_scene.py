"""Scenes against their parts: what a lightmap set is cut into, and rows that are of what they name."""

import json

import numpy as np
import pytest
import torch
from builders.bench_rows import check_outputs, keys
from builders.checks import error_of
from builders.gltf_scene import box

from benchmarks import Panel
from benchmarks.atlas_scene import LEAST_TEXELS, cut, read_scene, run_rows
from benchmarks.rivals.scene_parts import scene_parts
from wlm.atlas.evaluation import compare
from wlm.atlas.model import SOURCE_BITS
from wlm.formats.exr import write_exr
from wlm.formats.gltf import document_from_meshes
from wlm.formats.gltf_writer import write_glb
from wlm.lightmap.data import from_arrays
from wlm.ops.raster import texture

SIDE = 96
PLACES = {"room": (0.48, 0.0, 0.0), "crate": (0.24, 0.5, 0.0), "screw": (0.02, 0.9, 0.9)}  # side, u, v
BOXES = {"room": ((0, 0, 0), (6, 3, 5)), "crate": ((1, 0, 1), (2, 1, 2)), "screw": ((1.4, 1.01, 1.4), (1.5, 1.1, 1.5))}


def arrays():
    """Three boxes and their UVs in one lightmap, of which the screw's charts have hardly a texel."""
    positions, triangles, uvs, first = [], [], [], 0
    for name, (side, u, v) in PLACES.items():
        position, triangle, uv = box(*BOXES[name], inward=name == "room")
        positions.append(np.asarray(position, float))
        triangles.append(np.asarray(triangle) + first)
        uvs.append(np.asarray(uv, float) * side + [u, v])
        first += len(position)
    return np.concatenate(positions), np.concatenate(triangles), np.concatenate(uvs)


def lights():
    row, column = np.mgrid[:SIDE, :SIDE] / SIDE
    sky = (1.2 + np.sin(30 * column) * np.cos(20 * row))[..., None] * [0.6, 0.8, 1.0]
    lamp = np.exp(-20 * ((row - 0.2) ** 2 + (column - 0.3) ** 2))[..., None] * [2.0, 1.2, 0.5]
    return np.stack([0.1 * sky + lamp, sky]).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    return cut(from_arrays(lights(), [6.0, 12.0], name="boxes").light, *arrays(), factor=2)


@pytest.fixture(scope="module")
def few(tmp_path_factory):
    """The standard profile with few views."""
    path = tmp_path_factory.mktemp("profile") / "few.yaml"
    path.write_text("name: few\ncolour: mixed\ntile: 11\nviews: 1\n")
    return path


@pytest.fixture(scope="module")
def rows(scene, few):
    return run_rows(scene, [few], budget=0.12, device="cpu", views=2, resolution=48)


def test_objects_keep_their_light(scene):
    """Whole: the same light where the same point is read. Smaller: means of squares of a chart's own texels."""
    position, triangle, uv = arrays()
    whole = cut(from_arrays(lights(), [6.0, 12.0], name="boxes").light, position, triangle, uv)
    assert len(whole.sheets) == len(scene.sheets) == 2  # the screw belongs to the crate
    room, crate = whole.sheets
    assert len(room.triangle) == 12 and len(crate.triangle) == 24 and whole.metres
    random = np.random.default_rng(0)
    share = random.dirichlet([2.0] * 3, 12)[:, :, None]
    before = (uv[triangle[:12]] * share).sum(1)
    for state, frame in enumerate(lights()):
        own = (room.uv[room.triangle] * share).sum(1)
        light = texture(torch.from_numpy(whole.sheets[0].lightmaps[state]), torch.from_numpy(own).float())
        expected = texture(torch.from_numpy(frame), torch.from_numpy(before).float())
        torch.testing.assert_close(light, expected, rtol=0, atol=2e-3)
    sizes = [sum(sheet.mask.sum() for sheet in each.sheets) for each in (whole, scene)]
    assert 0.2 < sizes[1] / sizes[0] < 0.4 and scene.sheets[1].mask.sum() >= LEAST_TEXELS
    means = [each.sheets[0].lightmaps[:, each.sheets[0].mask].mean() for each in (scene, whole)]
    assert means[0] == pytest.approx(means[1], rel=0.05)


def test_a_set_is_read_and_what_is_wrong_is_said(tmp_path):
    document, _ = document_from_meshes([("boxes", *arrays())], "boxes")
    write_glb(tmp_path / "scene.glb", document, [], 1)
    for name, light in zip("ab", lights(), strict=True):
        write_exr(tmp_path / f"{name}.exr", light)
    text = {"name": "boxes", "width": SIDE, "height": SIDE, "mesh": "scene.glb"}
    text["lightmaps"] = [{"time_hours": 6.0, "file": "a.exr"}, {"time_hours": 12.0, "file": "b.exr"}]
    (tmp_path / "set.json").write_text(json.dumps(text))
    scene = read_scene(tmp_path, [12.0], 48)
    assert scene.name == "boxes 48" and scene.states == ("12 h",) and len(scene.sheets) == 2
    assert "no lightmap of 7 h; it has 6, 12" in error_of(read_scene, tmp_path, [7.0])
    assert "side: expected a divisor of the longer side, 96 texels, got 50" in error_of(read_scene, tmp_path, (), 50)
    (tmp_path / "set.json").write_text(json.dumps({k: v for k, v in text.items() if k != "mesh"}))
    assert "expected a lightmap set that names its mesh" in error_of(read_scene, tmp_path)


def test_rows(scene, rows, tmp_path):
    check_outputs(rows, tmp_path, (Panel("bpp"),))
    assert keys(rows) == [("scene", "few"), ("parts", "bits of few"), ("copies", "gain and offset, bits of few")]
    whole, parts, _copies = rows
    assert whole.scene == "boxes, 2 objects, 2 states" and whole["lightmaps"] == 4
    # Four parts have few sizes.
    assert 0.85 <= parts["bpp"] / whole["bpp"] <= 1.2
    assert whole["gain"] == pytest.approx(whole["psnr"] - parts["psnr"]) and whole["gain_min"] <= whole["gain"]
    assert whole["curves_seconds"] > 0.0 and whole["separate_seconds"] > 0.0
    assert min(whole["psnr"], parts["psnr"]) > 30.0


def test_parts_are_lightmaps_of_their_own(scene):
    """Each part is read by its sheet and state, those that tiles don't fit are plain, and more bits are less error."""
    ones = [np.ones([2 * side for side in sheet.mask.shape]) for sheet in scene.sheets]
    source_bits = scene.texels * SOURCE_BITS
    few, many = (scene_parts(scene, ones, share * source_bits) for share in (0.01, 0.12))
    assert [len(each) for each in many.models] == [2, 2] and {m.method for s in few.models for m in s} == {"plain"}
    assert many.bits == pytest.approx(0.12 * source_bits, rel=0.15)
    scores = compare(scene, {"few": few, "many": many}, views=2, resolution=48)
    assert scores["many"].psnr > scores["few"].psnr + 10.0 and min(scores["many"].psnr_by_state) > 30.0
