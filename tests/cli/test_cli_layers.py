"""The verbs on lightmap sets of several layers and atlases."""

import json

import numpy as np
import pytest
import yaml
from builders.layered_sets import write_unity
from builders.running import call, fails
from builders.small_sets import tiny_profile

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
    text = call("compress", folder / "scene", "-o", folder / "a.wlm", *options)
    return folder, text


def test_compress_and_info_tell_every_sheet(made):
    folder, text = made
    model = wlm.load(folder / "a.wlm")
    for sheet in model.sheets:
        assert sheet.label in text and sheet.label in call("info", folder / "a.wlm")
    assert len(model.sheets) == 6 and model.period == 24 and not list(folder.glob("*.partial"))
    facts = json.loads(call("info", folder / "a.wlm", "--json"))
    assert facts["bytes_on_disk"] == (folder / "a.wlm").stat().st_size
    assert facts["sheets"][3]["atlas"] == "Lightmap-1" and facts["sheets"][3]["height"] == 24


def test_decode_writes_a_layer_with_its_channels(made, tmp_path):
    folder, _ = made
    decoder = wlm.load(folder / "a.wlm").decoder()
    out = tmp_path / "a.exr"
    text = call("decode", folder / "a.wlm", "--time", 6, "--layer", "dir", "--atlas", "Lightmap-1", "-o", out)
    assert "R, G, B, A" in text and "Lightmap-1" in text
    pixels, names, _ = read_channels(out)
    assert names == ("R", "G", "B", "A")
    np.testing.assert_allclose(pixels, decoder.frame(6.0, "dir", "Lightmap-1"), atol=1e-3)


def test_wrong_layers_and_export(made, tmp_path):
    folder, _ = made
    command = ["compress", folder / "scene", "-o", tmp_path / "a.wlm"]
    assert "expected names among light, dir" in fails(*command, "--layers=ao")
    assert "bundle.json" in call("export", folder / "a.wlm", "-o", tmp_path / "engine")
