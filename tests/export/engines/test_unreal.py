"""Folders for Unreal: what their nodes compute of the pictures beside them, and that their scripts run through."""

import json
import re

import numpy as np
import pytest
from builders.atlas_meshes import charts
from builders.atlas_models import KINDS, MIXED
from builders.atlas_models import random_model as random_atlas
from builders.checks import error_of
from builders.engine_scripts import Script, node_gives, pixels_of
from builders.synthetic import random_model as random_lightmap

from wlm.atlas.exact import decode64
from wlm.export import export
from wlm.export.engines import kit
from wlm.export.engines.kit import asset_name
from wlm.lightmap.decode import Decoder

ALL = (4, 3, 2, 1, 4, 0)


@pytest.mark.parametrize("kind", [*KINDS, MIXED])
def test_an_atlas_node_gives_its_light(kind, tmp_path, monkeypatch):
    model = random_atlas(charts(), kind)
    export(model, tmp_path / "out", "unreal")
    script = Script(tmp_path / "out" / "wlm_atlas.py", monkeypatch)
    files = json.loads((tmp_path / "out" / "bundle.json").read_text())["textures"]
    assert set(script.settings) == {each["file"] for each in files.values()} and script.slots == [0]
    ((code, inputs),) = script.customs()
    uv = np.random.default_rng(0).random((1000, 2)).astype(np.float32)
    if model.method == "tiles":
        place = (uv * model.sheets[0].size[::-1] - 0.5) / model.profile.tile
        uv = uv[np.abs(place - np.rint(place)).min(1) > 1e-4]
    bound = {f"wlm_atlas_{name}": pixels_of(str(tmp_path / "out" / each["file"])) for name, each in files.items()}
    # What is filtered are halves there; a table of coordinates is floats, which WebGPU doesn't filter.
    bound = {
        name: v.astype(np.float16) if model.method == "cascade" or "lut" not in name else v for name, v in bound.items()
    }
    bound["points"] = np.pad(uv, ((0, 0), (0, 2)))[None]
    found = node_gives(code, inputs, (1, len(uv)), "points.Load(int3(pixel, 0)).xy", bound, tmp_path)[0]
    allowed = 3.0 / 512 * 2 * (1 + 22 * (model.method == "cascade"))
    np.testing.assert_allclose(found, decode64(model, uv), rtol=0, atol=allowed)


@pytest.mark.parametrize("kinds", [ALL, (2, 1, 0, 2)], ids=str)
def test_lightmap_nodes_decode_an_hour_and_fill_its_gaps(kinds, tmp_path, monkeypatch):
    mask = np.ones((128 * len(kinds) // 2 - 20, 247), bool)
    mask[40:42, 60:62] = False
    model = random_lightmap(kinds, mask=mask)
    export(model, tmp_path, "unreal")
    script = Script(tmp_path / "wlm_lightmap.py", monkeypatch)
    decode, fill = script.customs()
    pictures = {path.stem: pixels_of(str(path)) for path in tmp_path.iterdir() if path.suffix in (".tga", ".exr")}
    assert set(script.settings) == {path.name for path in tmp_path.iterdir() if path.suffix in (".tga", ".exr")}
    bound = {f"wlm_lightmap_{name}": values for name, values in pictures.items()}
    size = mask.shape
    place = f"(float2(pixel) + 0.5) / float2({size[1]}, {size[0]})"
    for number in (0, 2):
        found = node_gives(*decode, size, place, bound, tmp_path, {"wlm_hour": f"float wlm_hour = {number}.0"})
        filled = bound | {"Decoded": np.pad(found, ((0, 0), (0, 0), (0, 1)))}
        found = node_gives(*fill, size, place, filled, tmp_path)
        want = Decoder(model).frame(float(model.times[number]))
        np.testing.assert_allclose(found, want, rtol=0, atol=want.max() / 200)
    for time in (0.0, 3.0, 7.5, 12.9, 23.0):
        assert script.names["neighbours"](time) == pytest.approx(model.light.axis.neighbours(time))
    script.names["set_hour"](12.9)
    values = script.unreal.MaterialLibrary.set_scalar_parameter_value.call_args.args
    assert values[2:] == ("Share", pytest.approx(model.light.axis.neighbours(12.9)[2]))


def test_times_without_a_day(tmp_path, monkeypatch):
    model = random_lightmap((2, 1), period=None)
    export(model, tmp_path, "unreal")
    neighbours = Script(tmp_path / "wlm_lightmap.py", monkeypatch).names["neighbours"]
    for time in (0.0, 7.5, 10.0, 19.0):
        early, late, share = model.light.axis.neighbours(time)
        found = neighbours(time)
        mixed = lambda pair: (1 - pair[2]) * pair[0] + pair[2] * pair[1]  # noqa: E731
        assert mixed(found) == pytest.approx(mixed((early, late, share)))
    assert neighbours(-5.0) == (0, 1, 0.0) and neighbours(50.0)[2] == 1.0


def test_what_unreal_does_not_import(tmp_path, monkeypatch):
    monkeypatch.setitem(kit._MOST_SIDE, "unreal", 127)
    line = error_of(export, random_lightmap(), tmp_path / "deep" / "out", "unreal")
    assert re.search(r"cannot export for unreal: uv: expected at most 127 texels along a side, found \d+x\d+", line)
    assert not (tmp_path / "deep").exists()
    assert asset_name("a b/ç.1") == "a_b___1"
