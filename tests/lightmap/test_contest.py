"""Sets of the contest HPRC: what is read of them, and in what line a bad one ends."""

import json
import shutil

import numpy as np
import pytest
from builders.checks import error_of
from builders.contest_sets import SIZES, contest_light, contest_mask, write_contest
from builders.small_sets import tiny_profile

from wlm.formats.exr import write_exr
from wlm.lightmap.data import load
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import contest_score, memory_bytes
from wlm.lightmap.fit import compress
from wlm.metrics.contest import block_scores

LIGHT = "Original/lightmapRawData_Dilate_VirtualTexture0_1_HQ_6_4_18.00.bin_0"
MASK = "Mask/lightmapCoverage_Dilate_VirtualTexture0_1_HQ_6_4_1.00.bin_0"


@pytest.fixture
def folder(tmp_path):
    return write_contest(tmp_path)


def _change(folder, **changes):
    """Changes the entry of map 1."""
    config = json.loads((folder / "config.json").read_text())
    config["lightmap_list"][0] |= changes
    (folder / "config.json").write_text(json.dumps(config))


@pytest.mark.parametrize("parts", [1, 2])
@pytest.mark.parametrize("which", SIZES)
def test_each_map_is_a_set_of_its_own(tmp_path, which, parts):
    lightmaps = load(write_contest(tmp_path, parts), map_id=which)
    assert lightmaps.name == f"{tmp_path.name}-{which}" and lightmaps.period == 24.0 and lightmaps.warnings == ()
    # Hour 24 is hour 0, and the first.
    np.testing.assert_array_equal(lightmaps.times, [0.0, 1.0, 18.0])
    np.testing.assert_array_equal(lightmaps.frames, contest_light(which)[[2, 0, 1]])
    np.testing.assert_array_equal(lightmaps.mask, contest_mask(which))
    assert lightmaps.covered is None


def test_files_may_be_named_by_the_config(folder):
    """The contest's second layout: names by 100 times the hour, in a folder `Data`, masks of each hour."""
    (folder / "Data").mkdir()
    light, masks = {}, {}
    for i, hour in enumerate((0.0, 5.9)):
        key = str(round(100 * hour))
        light[key], masks[key] = f"light_{i}.bin_0", f"mask_{i}.bin_0"
        contest_light("1")[i].tofile(folder / "Data" / light[key])
        coverage = np.full(SIZES["1"], -1, np.int8)
        coverage[i:] = 127
        coverage.tofile(folder / "Data" / masks[key])
    _change(folder, level="L_Hall", id=0, lightmaps=light, masks=masks)
    for which in ("0", "L_Hall/0"):
        lightmaps = load(folder, map_id=which)
        np.testing.assert_array_equal(lightmaps.times, [0.0, 5.9])
        np.testing.assert_array_equal(lightmaps.valid(0).all(axis=1), [True] * 4)
        np.testing.assert_array_equal(lightmaps.valid(1).all(axis=1), [False, True, True, True])
    del masks["590"], light["590"]
    _change(folder, lightmaps=light | {"100": "light_1.bin_0"}, masks=masks | {"200": "mask_1.bin_0"})
    assert "no coverage (lightmapCoverage) of hour 1" in error_of(load, folder, map_id="0")
    _change(folder, lightmaps={"0": "../../a.bin_0"})
    assert "expected a file within" in error_of(load, folder, map_id="0")


def test_the_map_has_to_be_chosen_where_there_are_several(folder):
    line = error_of(load, folder)
    assert "holds 2 lightmaps, choose one with --map" in line and "1 (6x4), 17 (20x300)" in line
    assert "0 are called '3'" in error_of(load, folder, map_id="3")
    config = json.loads((folder / "config.json").read_text())
    (folder / "config.json").write_text(json.dumps({"lightmap_list": config["lightmap_list"][:1]}))
    assert load(folder).name.endswith("-1")


def test_options_of_other_sets(folder, tmp_path):
    assert load(folder, map_id="1", mask="all").mask.all()
    np.testing.assert_array_equal(load(folder, map_id="1", times=[2, 3, 4]).times, [2, 3, 4])
    assert "2 times for 3" in error_of(load, folder, map_id="1", times=[2, 3])
    assert "found raw lightmaps" in error_of(load, folder, map_id="1", mask="alpha")
    # Another program's config.json beside EXR files means nothing.
    write_exr(folder / "light_3h.exr", contest_light("1")[0])
    np.testing.assert_array_equal(load(folder).times, [3.0])
    assert "expected a contest's folder" in error_of(load, folder, map_id="1")


@pytest.mark.parametrize(
    ("name", "says"),
    [(LIGHT, "expected 288 bytes (6x4 texels of 12 bytes), found 284"), (MASK, "expected 24 bytes (6x4 texels of 1")],
)
def test_files_of_another_length_are_refused(folder, name, says):
    path = folder / name
    data = path.read_bytes()
    path.write_bytes(data[:-4])
    line = error_of(load, folder, map_id="1")
    assert str(path) in line and says in line
    path.write_bytes(data + b"\0")
    assert f"found {len(data) + 1}" in error_of(load, folder, map_id="1")


def test_missing_files_are_named(folder):
    _change(folder, parts=2)
    first = folder / LIGHT.replace("18.00", "1.00")
    first.write_bytes(first.read_bytes()[:144])
    assert "1.00.bin_1: cannot read" in error_of(load, folder, map_id="1")
    _change(folder, parts=3)
    assert "expected parts of equal height, got 3 of 4" in error_of(load, folder, map_id="1")
    _change(folder, parts=1, resolution={"width": 5, "height": 4})
    assert "no lightmapRawData file of map 1 with 5x4 texels" in error_of(load, folder, map_id="1")
    shutil.rmtree(folder / "Mask")
    assert f"{folder / 'Mask'}: cannot read" in error_of(load, folder, map_id="17")


def test_bad_light_and_masks_follow_the_table(folder):
    frame = contest_light("1")[1]
    frame[2, 3] = np.nan
    frame.tofile(folder / LIGHT)
    (warning,) = load(folder, map_id="1").warnings
    assert LIGHT.partition("/")[2] in warning and "1 texel NaN" in warning
    np.full(SIZES["1"], -1, np.int8).tofile(folder / MASK)
    assert "the mask is empty" in error_of(load, folder, map_id="1")


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"resolution": {"width": 0, "height": 4}}, "lightmap_list[0].resolution.width: expected"),
        ({"resolution": {"width": 65_536, "height": 65_536}}, "texels, got 65536x65536"),
        ({"resolution": None}, "lightmap_list[0].resolution: expected"),
        ({"id": [1]}, "lightmap_list[0].id"),
        ({"parts": 0}, "lightmap_list[0].parts: expected"),
        ({"lightmaps": {"noon": "a"}}, "lightmap_list[0].lightmaps"),
        ({"lightmaps": {}}, "lightmap_list[0].lightmaps"),
        ({"lightmaps": {"2500": LIGHT}}, "is 25; expected 0 to below 24"),
    ],
)
def test_a_bad_config_ends_in_one_line(folder, changes, says):
    _change(folder, **changes)
    assert says in error_of(load, folder, map_id="1")


@pytest.mark.parametrize("text", ["[]", "{}", '{"lightmap_list": []}', '{"lightmap_list": 3}', "{"])
def test_a_config_without_lightmaps(folder, text):
    (folder / "config.json").write_text(text)
    assert "config.json: " in error_of(load, folder)


def test_a_model_is_scored_by_what_it_decodes_to(folder):
    lightmaps = load(folder, map_id="17")
    model = compress(lightmaps, tiny_profile(steps=20))
    score = contest_score(model, lightmaps)
    decoder = Decoder(model)
    pairs = zip(lightmaps.frames, lightmaps.times, strict=True)
    psnrs, ssims = zip(*(block_scores(frame, decoder.frame(t), lightmaps.mask) for frame, t in pairs), strict=True)
    # Two blocks of 256 rows and 44.
    assert np.shape(psnrs) == (3, 2)
    assert score.psnr == pytest.approx(np.mean(psnrs)) and score.ssim == pytest.approx(np.mean(ssims))
    assert score.ratio == pytest.approx(memory_bytes(model) / (300 * 20 * 12 * 3))
    assert (score.times, score.device) == (3, "cpu") and score.seconds > 0
