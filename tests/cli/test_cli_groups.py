"""The verbs on light groups."""

import json

import numpy as np
import pytest
import yaml
from builders.light_groups import lit_sets, write_groups
from builders.running import call, fails
from builders.small_sets import tiny_profile, write_set

import wlm
from wlm.formats.exr import write_exr
from wlm.formats.light import read_light


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the set `sky` and `lamp.exr`, and `a.wlm` of both."""
    folder, sets = tmp_path_factory.mktemp("groups"), lit_sets()
    write_set(folder / "sky", sets["sky"])
    write_exr(folder / "lamp.exr", sets["lamp 0"].light.frames[0], half=False)
    (folder / "tiny.yaml").write_text(yaml.safe_dump(tiny_profile().model_dump(mode="json")))
    options = ["--group", f"lamp={folder / 'lamp.exr'}", "--profile", folder / "tiny.yaml"]
    text = call("compress", folder / "sky", *options, "-o", folder / "a.wlm")
    return folder, text


def test_compress_info_and_inspect_list_the_groups(made):
    folder, text = made
    for shown in (text, call("info", folder / "a.wlm")):
        assert "light groups" in shown and "lamp: 0/light RGB" in shown
    groups = json.loads(call("info", folder / "a.wlm", "--json"))["groups"]
    assert [(group["name"], len(group["times"])) for group in groups] == [("base", 3), ("lamp", 1)]
    assert sum(group["GPU_bytes"] for group in groups) == wlm.load(folder / "a.wlm").memory_bytes
    assert "2 light groups: base" in call("inspect", folder / "a.wlm")


def test_decode_takes_weights_and_colours(made, tmp_path):
    folder, _ = made
    decoder = wlm.load(folder / "a.wlm").decoder()
    decoder.set_weights({"lamp": (0.5, 0.25, 0.0), "base": 2.0})
    options = ["--weight", "lamp=0.5", "--colour", "lamp=1,0.5,0", "--weight", "base=2"]
    call("decode", folder / "a.wlm", "--time", 6, *options, "-o", tmp_path / "a.exr")
    np.testing.assert_allclose(read_light(tmp_path / "a.exr")[0][..., :3], decoder.frame(6.0), rtol=1e-3)
    for wrong, words in (
        (["--weight", "lamp=-1"], "--weight: expected lamp=NUMBER, numbers of at least 0, got '-1'"),
        (["--weight", "lamp=nan"], "got 'nan'"),
        (["--weight", "lamp"], "expected NAME=NUMBER"),
        (["--weight", "moon=1"], "expected a group among base, lamp, got 'moon'"),
        (["--colour", "lamp=1,0"], "expected lamp=R,G,B"),
        (["--weight", "lamp=1", "--weight", "lamp=2"], "each name once"),
    ):
        assert words in fails("decode", folder / "a.wlm", "--time", 6, *wrong, "-o", tmp_path / "b.exr")
    assert not (tmp_path / "b.exr").exists()


def test_a_list_of_groups_is_found(tmp_path):
    write_groups(tmp_path / "lit", lit_sets(64))
    text = call("inspect", tmp_path / "lit")
    assert "a set of lightmaps in 5 light groups: sky at 3 times, sun at 3 times, lamp 0 at 1 time" in text
    assert "-> wlm compress" in text
    (tmp_path / "lit" / "0_0.exr").unlink()
    assert "0_0.exr is missing" in call("inspect", tmp_path / "lit")
    text = fails("compress", tmp_path / "lit", "--group", "lamp", "-o", tmp_path / "a.wlm")
    assert "--group: expected NAME=PATH" in text


def test_evaluate_scores_each_group_and_the_sum(made, tmp_path):
    folder, _ = made
    words = ["evaluate", folder / "a.wlm", folder / "sky", "--group", f"lamp={folder / 'lamp.exr'}", "--views", 0]
    text = call(*words, "--all-lights", folder / "sky", "--json", tmp_path / "a.json")
    assert "lamp: 0/light RGB" in text and "bake of all lights" in text
    report = json.loads((tmp_path / "a.json").read_text())
    assert [sheet["group"] for sheet in report["sheets"]] == ["base", "lamp"]
    # Without the lamp the bake is not the sum.
    assert report["sums"][0]["psnr"] > report["sums"][1]["psnr"] + 3.0
