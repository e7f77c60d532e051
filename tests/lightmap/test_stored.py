"""Sets whose files leave something open: windows, primaries, layers, and the encoding of integers."""

import json

import numpy as np
import OpenEXR
import pytest
from builders.checks import error_of
from PIL import Image

import wlm.atlas
import wlm.lightmap
from wlm.formats.exr import write_exr
from wlm.inspection import inspect
from wlm.texels import doubts

LIGHT = np.random.default_rng(5).uniform(0.2, 0.9, (24, 32, 3)).astype(np.float32)


def _write(path, light, **header):
    planes = {name: np.ascontiguousarray(light[..., i]) for i, name in enumerate("RGB")}
    OpenEXR.File({"type": OpenEXR.scanlineimage, **header}, planes).write(str(path))


def _box(x, y, width, height):
    return np.array([x, y], np.int32), np.array([x + width - 1, y + height - 1], np.int32)


def test_windows_that_move_between_hours_stay_in_place(tmp_path):
    display = _box(0, 0, 32, 24)
    for hour, x in ((0, 0), (6, 4), (12, 8)):
        box, path = _box(x, 2, 20, 20), tmp_path / f"a_{hour:02d}h.exr"
        _write(path, LIGHT[2:22, x : x + 20], dataWindow=box, displayWindow=display)
    sheet = wlm.lightmap.load(tmp_path).light
    for frame, x in zip(sheet.frames, (0, 4, 8), strict=True):
        expected = np.zeros_like(LIGHT)
        expected[2:22, x : x + 20] = LIGHT[2:22, x : x + 20]
        np.testing.assert_array_equal(frame, expected)
    line = "a_06h.exr: the data window, 20x20 at (4, 2), is placed in the display window, 32x24: "
    line += "368 texels outside it are 0"
    assert line in sheet.warnings and line in inspect(tmp_path)[0].problems


def test_a_line_that_all_files_share_is_printed_once(tmp_path):
    for hour in (0, 6, 12):
        wide = (0.708, 0.292, 0.17, 0.797, 0.131, 0.046, 0.3127, 0.329)
        _write(tmp_path / f"a_{hour:02d}h.exr", LIGHT, chromaticities=wide)
    line = "a_00h.exr and 2 more: converted to Rec. 709 from Rec. 2020"
    assert line in wlm.lightmap.load(tmp_path).warnings
    assert line in inspect(tmp_path)[0].problems
    red = wlm.lightmap.load(tmp_path).light.frames[0] - LIGHT
    assert abs(red).max() > 0.05


@pytest.mark.parametrize("suffix", [".png", ".tga"])
def test_integers_with_an_encoding(tmp_path, suffix):
    levels = np.rint(LIGHT * 255).astype(np.uint8)
    for hour in (0, 6):
        Image.fromarray(levels).save(tmp_path / f"a_{hour:02d}h{suffix}")
    assert "expected a set.json or lightmaps" in error_of(wlm.lightmap.load, tmp_path)
    assert "encoding: expected linear, srgb" in error_of(wlm.lightmap.load, tmp_path, encoding="rec709")
    sheet = wlm.lightmap.load(tmp_path, encoding="linear").light
    np.testing.assert_allclose(sheet.frames[1], levels / np.float32(255), rtol=1e-6)
    files = [{"time_hours": hour, "file": f"a_{hour:02d}h{suffix}"} for hour in (0, 6)]
    plain = {"width": 32, "height": 24, "lightmaps": files, "stored": "linear"}
    layer = {"encoding": "radiance", "stored": "linear"}
    states = [{"time_hours": each["time_hours"], "files": {"0": {"light": each["file"]}}} for each in files]
    for content in (plain, {"layers": {"light": layer}, "atlases": {"0": {}}, "lightmaps": states}):
        (tmp_path / "set.json").write_text(json.dumps(content))
        np.testing.assert_array_equal(wlm.lightmap.load(tmp_path).light.frames, sheet.frames)
    (tmp_path / "set.json").write_text(json.dumps(plain))
    assert "stored as linear" in inspect(tmp_path)[0].what
    (tmp_path / "set.json").write_text(json.dumps({key: value for key, value in plain.items() if key != "stored"}))
    assert "state what light its numbers stand for with --encoding" in error_of(wlm.lightmap.load, tmp_path)
    (tmp_path / "set.json").write_text(json.dumps(plain | {"stored": 5}))
    assert "stored: expected a valid string, got 5" in error_of(wlm.lightmap.load, tmp_path)


def test_a_layer_is_chosen_by_name_in_a_set_and_for_a_mesh(tmp_path):
    names = [(name, i) for name in ("Diff", "Gloss") for i in range(3)]
    planes = {f"{name}.{'RGB'[i]}": LIGHT[..., i] * (1 + (name == "Gloss")) for name, i in names}
    planes = {name: np.ascontiguousarray(plane) for name, plane in planes.items()}
    for hour in (0, 6):
        OpenEXR.File({"type": OpenEXR.scanlineimage}, dict(planes)).write(str(tmp_path / f"a_{hour:02d}h.exr"))
    assert "choose one with --encoding layer:NAME" in error_of(wlm.lightmap.load, tmp_path)
    np.testing.assert_array_equal(wlm.lightmap.load(tmp_path, encoding="layer:Gloss").light.frames[0], 2 * LIGHT)
    np.testing.assert_array_equal(wlm.lightmap.load(tmp_path, encoding="layer:Diff").light.frames[0], LIGHT)
    (tmp_path / "quad.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nf 1/1 2/2 3/3\n")
    scene = wlm.atlas.load(tmp_path / "quad.obj", tmp_path / "a_00h.exr", encoding="layer:Diff")
    np.testing.assert_array_equal(scene.sheets[0].lightmap[20, 3], LIGHT[20, 3])
    OpenEXR.File({"type": OpenEXR.scanlineimage}, {name: planes[name] for name in planes if "Diff" in name}).write(
        str(tmp_path / "one.exr")
    )
    scene = wlm.atlas.load(tmp_path / "quad.obj", tmp_path / "one.exr")
    assert f"{tmp_path / 'one.exr'}: the light is taken from 'Diff', its only layer of colour" in scene.warnings


def test_a_pointer_of_git_lfs_is_named_for_every_kind_of_file(tmp_path):
    write_exr(tmp_path / "a.exr", LIGHT)
    for name in ("b.exr", "b.glb", "b.obj", "b.npz", "b.wlm", "b.vdb", "b.png"):
        (tmp_path / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 9\n")
        assert any("found a pointer of Git LFS" in text for text in inspect(tmp_path / name)[0].problems), name
    assert "found a pointer of Git LFS" in error_of(wlm.atlas.load, tmp_path / "b.glb", tmp_path / "a.exr")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda light: 1e5 * light, "half of the texels exceed 1,000: are they in lux"),
        (lambda light: 1e-5 * light, "no texel exceeds 0.0001"),
        (lambda light: np.minimum(2 * light, 1), "values are clamped at 1"),
        (lambda light: np.rint(light * 255) / 255, "values have 256 levels"),
        (lambda light: light, None),
        (lambda light: 0 * light, None),
        (lambda light: 0 * light + 1, None),
        (lambda light: np.where(light > 0.5, np.nan, light), None),
    ],
)
def test_doubts_about_the_range(change, said):
    found = doubts(change(np.tile(LIGHT, (2, 2, 1))))
    assert any(said in line for line in found) if said else not found
