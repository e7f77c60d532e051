"""`wlm lightmap` on sets of several layers and atlases."""

import json

import numpy as np
import pytest
import yaml
from builders.layered_sets import write_unity
from builders.running import call, fails
from builders.small_sets import tiny_profile
from PIL import Image

import wlm
from wlm.formats.channels import read_channels


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder of Unity's, and what `compress` made of it."""
    folder = tmp_path_factory.mktemp("unity")
    write_unity(folder / "scene")
    profile = folder / "tiny.yaml"
    profile.write_text(yaml.safe_dump(tiny_profile().model_dump(mode="json")))
    options = ["--period", 24, "--profile", profile]
    text = call("lightmap", "compress", folder / "scene", "-o", folder / "a.wlm", *options)
    return folder, text


def test_compress_and_info_tell_every_sheet(made):
    folder, text = made
    model = wlm.load(folder / "a.wlm")
    for sheet in model.sheets:
        assert sheet.label in text and sheet.label in call("lightmap", "info", folder / "a.wlm")
    assert len(model.sheets) == 6 and model.period == 24 and not list(folder.glob("*.partial"))
    facts = json.loads(call("lightmap", "info", folder / "a.wlm", "--json"))
    assert "--tiles is of files of one lightmap" in fails("lightmap", "info", folder / "a.wlm", "--tiles")
    assert facts["bytes"] == (folder / "a.wlm").stat().st_size > sum(sheet["bytes"] for sheet in facts["sheets"])
    assert facts["sheets"][3]["atlas"] == "Lightmap-1" and facts["sheets"][3]["height"] == 24


def test_evaluate_scores_every_sheet(made):
    folder, _ = made
    report = folder / "report.json"
    text = call("lightmap", "evaluate", folder / "a.wlm", folder / "scene", "--period", 24, "--json", report)
    assert "Lightmap-0/dir A, unit" in text and "layer dir" in text
    content = json.loads(report.read_text())
    assert [sheet["encoding"] for sheet in content["sheets"]] == ["radiance", "unit", "unit"] * 2
    assert content["psnr_by_layer"]["dir"] > 10 and content["sheets"][1]["flip"] is None
    for option in ("--html=a.html", "--score=hprc"):
        assert "one with layers" in fails("lightmap", "evaluate", folder / "a.wlm", folder / "scene", option)


def test_decode_writes_a_layer_with_its_channels(made, tmp_path):
    folder, _ = made
    decoder = wlm.load(folder / "a.wlm").decoder()
    out, png = tmp_path / "a.exr", tmp_path / "a.png"
    call("lightmap", "decode", folder / "a.wlm", "--time", 6, "--layer", "dir", "--atlas", "Lightmap-1", "-o", out)
    assert "layer dir of atlas Lightmap-1, unit: R, G, B, A" in call.stderr
    pixels, names, _ = read_channels(out)
    assert names == ("R", "G", "B", "A")
    np.testing.assert_allclose(pixels, decoder.layer(6.0, "dir", "Lightmap-1"), atol=1e-3)
    call("lightmap", "decode", folder / "a.wlm", "--time", 6, "-o", out, "--eight-bit", png)
    assert read_channels(out)[0].shape == (16, 12, 3) and json.loads(Image.open(png).text["wlm"])["gamma"] == 2.2
    options = ["-o", out, "--layer", "dir", "--eight-bit", png]
    assert "at most three channels" in fails("lightmap", "decode", folder / "a.wlm", "--time", 6, *options)


def test_options_of_one_lightmap_are_refused(made, tmp_path):
    folder, _ = made
    command = ["lightmap", "compress", folder / "scene", "-o", tmp_path / "a.wlm"]
    for option in ("--tiles=0", "--target-psnr=40", "--max-bpp=1"):
        assert f"{option.split('=')[0]}: expected a set of one" in fails(*command, option)
    assert "expected some of light, dir" in fails(*command, "--layers=ao")
    assert "sheet_05" in call("lightmap", "export", folder / "a.wlm", "-o", tmp_path / "engine")
