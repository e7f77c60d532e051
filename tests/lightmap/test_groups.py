"""Light groups: the set, the fit, the file, and the sum against float64 NumPy."""

import json

import numpy as np
import pytest
from builders.checks import assert_same, error_of, psnr
from builders.light_groups import DARK, lit_sets, random_groups, sum64, write_groups
from builders.resigned import GONE, error_of_changed
from builders.small_sets import moving_light, tiny_profile, write_set

import wlm
from wlm.formats.artifact import read_artifact
from wlm.formats.exr import write_exr
from wlm.lightmap import Layer, from_arrays, from_groups, from_layers, load, reading
from wlm.lightmap.sheet import BASE

WEIGHTS = {"sun": (0.25, 1.5, 0.0), "lamp": (2.0, 1.0, 0.5)}


@pytest.fixture(scope="module")
def sets():
    return lit_sets()


@pytest.fixture(scope="module")
def model():
    mask = np.random.default_rng(6).random((236, 247)) < 0.8
    return random_groups(mask)


def test_the_decoder_adds_groups_by_their_weights(model):
    decoder = model.decoder()
    for time, weights in ((12.5, {}), (3.0, WEIGHTS), (3.0, dict.fromkeys(model.groups, (0.0, 0.0, 0.0)))):
        decoder.set_weights(dict.fromkeys(model.groups, 1.0) | weights)
        expected = sum64(model, time, weights)
        np.testing.assert_allclose(decoder.frame(time), expected, rtol=2e-5, atol=2e-5 * max(expected.max(), 1e-3))
    decoder.set_weights({"lamp": 0.5})
    assert decoder.weights["lamp"].tolist() == [0.5] * 3 and not decoder.weights["sky"].any(), "the others keep theirs"


def test_a_lamp_is_read_once_at_any_time(model):
    lamp = model.maps()["lamp"]
    assert lamp.axis.reads(17.25) == [(0.0, 1.0)] and lamp.axis.place(17.25) == 0.5


def test_wrong_weights_are_one_line_and_change_nothing(model):
    decoder = model.decoder()
    for weights, words in (
        ({"lamp": 0.5, "moon": 1.0}, "expected a group among sky, sun, lamp, unlit, got 'moon'"),
        ({"lamp": float("nan")}, "weight of lamp: expected one number or three, from 0 to 65504, got nan"),
        ({"lamp": (1.0, 2.0)}, "got (1.0, 2.0)"),
        ({"lamp": "red"}, "got 'red'"),
    ):
        assert words in error_of(decoder.set_weights, weights)
    assert all((weight == 1.0).all() for weight in decoder.weights.values())


def test_what_is_written_comes_back(model, tmp_path):
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    assert back.groups == ("sky", "sun", "lamp", DARK) and list(back.sheets) == list(model.sheets)
    for sheet, own in model.sheets.items():
        assert_same(back.sheets[sheet], own)
    assert len({id(own.mask) for own in back.sheets.values()}) == 1, "the mask is stored once"
    stored = read_artifact(tmp_path / "a.wlm").tensors
    assert [name for name in stored if name.endswith("mask")] == ["0.mask"]
    assert sorted(name for name in stored if name.endswith("times")) == ["1.times", "2.times", "3.times", "times"]
    sizes = back.group_sizes()
    times = {"sky": [0.0, 7.5, 13.0, 19.0], "sun": [6.0, 12.5, 18.0], "lamp": [0.0], DARK: [0.0]}
    assert {name: own.tolist() for name, (own, _) in sizes.items()} == times
    assert sum(each for _, each in sizes.values()) == back.memory_bytes and sizes[DARK][1] < sizes["sky"][1]
    # A lamp's only time is no time at which light changes.
    assert back.times.tolist() == [0.0, 6.0, 7.5, 12.5, 13.0, 18.0, 19.0]


def test_damaged_groups_are_one_line(model, tmp_path):
    path = tmp_path / "a.wlm"
    model.save(path)
    sheets = read_artifact(path).settings["sheets"]

    for values, tensors, words in (
        ({"group": "sky"}, {}, "found one twice"),
        ({"encoding": "unit"}, {}, "expected light with the same channels in the groups"),
        ({"size": [200, 200]}, {}, "texels, but others of its layer"),
        ({}, {"1.times": GONE}, "sheet 1: part times"),
        ({}, {"1.times": np.array([6.0, 18.0])}, "sheet 1: part"),
    ):
        settings = {"sheets": [sheets[0], sheets[1] | values, *sheets[2:]]}
        assert words in error_of_changed(model, path, settings, tensors)


@pytest.fixture(scope="module")
def fitted(sets):
    """A set of five groups and a model of it."""
    lit = from_groups(sets, "lit")
    return lit, wlm.lightmap.compress(lit, tiny_profile(steps=150, samples=256, follow_times=True))


def test_a_fit_of_sky_sun_and_lamps_adds_up(fitted, sets, tmp_path):
    lit, model = fitted
    assert lit.groups == tuple(sets) and lit.period == 24.0 and lit.times.tolist() == [0.0, 5.0, 11.0, 13.5, 20.0]
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm")
    for sheet, own in model.sheets.items():
        assert_same(back.sheets[sheet], own)
    decoder = back.decoder()
    whole = sets["sky"].light.frames[2] + sets["sun"].light.frames[0]
    whole += sum(sets[f"lamp {i}"].light.frames[0] for i in range(3))
    # The errors of the groups are independent: their squares add up.
    own = []
    for sheet, at in zip(model.sheets, (2, 0, 0, 0, 0), strict=True):
        decoder.set_weights(dict.fromkeys(model.groups, 0.0) | {sheet.group: 1.0})
        own.append(np.mean(np.square(decoder.frame(11.0) - lit.sheets[sheet].frames[at])))
    decoder.set_weights(dict.fromkeys(model.groups, 1.0))
    together = np.mean(np.square(decoder.frame(11.0) - whole))
    assert abs(10.0 * np.log10(together / sum(own))) < 1.0
    assert psnr(whole, decoder.frame(11.0)) > 25.0


def test_the_sum_is_scored_beside_the_groups(fitted, sets):
    lit, model = fitted
    # 5 h is 9 of the 15 hours from the sun's last time, 20 h, to its first, 11 h of the next day.
    sun = sets["sun"].light.frames
    early = sets["sky"].light.frames[1] + (6.0 * sun[2] + 9.0 * sun[0]) / 15.0
    noon = sets["sky"].light.frames[2] + sun[0]
    lamps = sum(sets[f"lamp {i}"].light.frames[0] for i in range(3))
    bake = from_arrays(np.stack([early, noon]) + lamps, [5.0, 11.0], period=24.0)
    report = wlm.lightmap.evaluate(model, lit, metrics=("psnr",), all_lights=bake)
    assert [sheet.group for sheet in report.sheets] == list(lit.groups)
    originals, baked = report.sums
    assert (originals.reference, baked.reference) == ("originals of the groups", "bake of all lights")
    assert originals.times.tolist() == [0.0, 5.0, 11.0, 13.5, 20.0] and baked.times.tolist() == [5.0, 11.0]
    # The bake has exactly the light of the groups, so its score is that of their errors.
    np.testing.assert_allclose(baked.psnr_by_time, originals.psnr_by_time[1:3], atol=0.01)
    assert baked.between_inputs > 100.0 and np.isnan(originals.between_inputs)
    assert report.to_json()["sums"][1]["psnr"] == pytest.approx(baked.psnr)
    decoded = model.decoder().frame(11.0)
    assert baked.psnr_by_time[1] == pytest.approx(psnr(noon + lamps, decoded), abs=0.01)

    unlit = from_arrays(np.stack([early, noon]), [5.0, 11.0], period=24.0)
    missed = wlm.lightmap.evaluate(model, lit, metrics=("psnr",), all_lights=unlit).sums[1]
    assert missed.psnr < baked.psnr - 3.0 and missed.between_inputs < 30.0, "a lamp that the bake lacks"
    small = from_arrays(np.ones((1, 64, 64, 3)), [0.0])
    assert "expected lightmaps of 128x128, got 64x64" in error_of(wlm.lightmap.evaluate, model, lit, all_lights=small)
    layers = from_layers([Layer(np.ones((1, 128, 128, 3)), "other")], [0.0])
    assert "found 0/other RGB" in error_of(wlm.lightmap.evaluate, model, lit, metrics=("psnr",), all_lights=layers)


def test_sets_are_joined_by_the_rules(sets):
    sky, lamp = sets["sky"], sets["lamp 0"]
    half = np.ones((128, 128), bool)
    half[:, 64:] = False
    masked = moving_light(mask=half)
    both = from_groups({"lamp": lamp, "sky": masked})
    assert all((own.mask == half).all() for own in both.sheets.values()), "the mask of the group that has one"
    alone = from_groups({"lamp": lamp})
    assert alone.groups == ("lamp",) and alone.period is None and alone.times.tolist() == [0.0]
    late = from_groups({"sky": sky, "lamp": from_arrays(lamp.light.frames, [30.0])})
    assert next(own for sheet, own in late.sheets.items() if sheet.group == "lamp").times.tolist() == [6.0]
    dark = from_groups({"sky": sky, "lamp": from_arrays(np.zeros((1, 128, 128, 3)), [0.0])})
    assert any("lamp: 0/light RGB: no light" in line for line in dark.warnings)
    assert from_groups({"sky": sky, "lamp": lamp}).source != from_groups({"sky": sky, "lamp b": lamp}).source
    assert from_groups({BASE: sky}).source == sky.source, "a set without groups keeps its hash"

    directions = from_layers([Layer(np.zeros((1, 128, 128, 3)), "dir", encoding="signed")], [0.0])
    for wrong, words in (
        ({}, "expected at least one group"),
        ({"a=b": sky}, "without '=', got 'a=b'"),
        ({"": sky}, "got ''"),
        ({"sky": sky, "lamp": lit_sets(64)["lamp 0"]}, "lamp: 0/light RGB has 64x64 texels, but others"),
        ({"sky": sky, "sun": moving_light(period=None)}, "expected one period in all groups with several times"),
        ({"sky": masked, "sun": moving_light(mask=~half)}, "its mask lacks 8192 texels of that of group sky"),
        ({"sky": directions, "sun": directions}, "expected light with the same channels in the groups sky, sun"),
        ({"sky": both}, "group sky: expected a set without groups"),
    ):
        assert words in error_of(from_groups, wrong)


def test_groups_are_read_from_a_list_and_from_options(sets, tmp_path):
    path = write_groups(tmp_path / "lit", sets)
    read = load(path)
    whole = from_groups(sets, "lit").sheets.items()
    for (sheet, own), (other, expected) in zip(read.sheets.items(), whole, strict=True):
        assert sheet == other
        np.testing.assert_array_equal(own.frames, expected.frames)
        assert own.times.tolist() == expected.times.tolist() and own.period == 24.0

    write_set(tmp_path / "sky", sets["sky"])
    lamp = tmp_path / "lamp.exr"
    write_exr(lamp, sets["lamp 0"].light.frames[0], half=False)
    both = load(tmp_path / "sky", groups={"lamp": lamp})
    assert both.groups == (BASE, "lamp") and both.times.tolist() == sets["sky"].times.tolist()
    assert load(path, groups={"lamp 3": lamp}).groups == (*sets, "lamp 3")

    for groups, words in (
        ({"sky": lamp}, "not taken, got 'sky'"),
        ({"lamp": tmp_path / "none.exr"}, "no such file"),
        ({"lamp": path}, "expected a set without groups, found one with 5"),
    ):
        assert words in error_of(load, path, groups=groups)
    assert "--times" in error_of(load, path, times=[1.0])


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"groups": []}, "groups: "),
        ({"groups": [{"name": "a=b", "lightmaps": []}]}, "groups.0.name"),
        ({"groups": [{"name": "a", "lightmaps": [{"file": "../b.exr"}]}]}, "groups.a: lightmaps.0.file"),
        ({"groups": [{"name": "a", "lightmaps": [{"file": "0_0.exr"}, {"file": "0_1.exr"}]}]}, "time_hours"),
        ({"groups": [{"name": "a", "lightmaps": [{"file": "0_0.exr"}]}] * 2}, "found a twice"),
    ],
)
def test_wrong_lists_of_groups_are_one_line(changes, words, sets, tmp_path):
    path = write_groups(tmp_path / "lit", sets, **changes)
    text = error_of(load, path)
    assert text.startswith(str(path)) and words in text


def test_groups_are_bounded_together(sets, tmp_path, monkeypatch):
    path = write_groups(tmp_path / "lit", {"sky": sets["sky"], "lamp": sets["lamp 0"]})
    monkeypatch.setattr(reading, "PICTURE_GROWTH", 0)
    # Each alone is within the bound.
    monkeypatch.setattr(reading, "FRAMES", sets["sky"].light.frames.nbytes)
    assert "set.json: lightmaps: expected at most" in error_of(load, path)
    assert load(path, trust=True).groups == ("sky", "lamp")


def test_a_group_of_a_layered_set_may_lack_atlases(tmp_path):
    files = {"a": {"light": "a.exr", "dir": "a.exr"}, "b": {"light": "b.exr"}}
    content = {
        "layers": {"light": "radiance", "dir": "unit"},
        "atlases": {"a": {}, "b": {}},
        "groups": [
            {"name": "sky", "lightmaps": [{"time_hours": 1.0, "files": files}, {"time_hours": 2.0, "files": files}]},
            {"name": "lamp", "lightmaps": [{"files": {"b": {"light": "b.exr"}}}]},
        ],
    }
    for name, size in (("a", 8), ("b", 16)):
        write_exr(tmp_path / f"{name}.exr", np.random.default_rng(size).random((size, size, 3)).astype(np.float32))
    path = tmp_path / "set.json"
    path.write_text(json.dumps(content))
    labels = [sheet.label for sheet in load(path).sheets]
    assert labels == ["sky: a/light RGB", "sky: a/dir RGB", "sky: b/light RGB", "lamp: b/light RGB"]
    del content["groups"][0]["lightmaps"][0]["files"]["a"], content["groups"][0]["lightmaps"][1]["files"]
    content["groups"][0]["lightmaps"] = content["groups"][1]["lightmaps"]
    path.write_text(json.dumps(content))
    assert "atlas a: expected a picture of it in a group" in error_of(load, path)
