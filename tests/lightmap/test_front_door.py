"""The system as a Python user meets it: a few lines, settings by name, and one-line errors."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from builders.small_sets import moving_light, tiny_profile

import wlm
from wlm.errors import WlmError

CITY = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"


def test_a_day_in_a_few_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("demos/data/city").mkdir(parents=True)
    for hour in ("09_00", "18_45", "18_55"):
        shutil.copy(CITY / f"lightmap_{hour}h.exr", "demos/data/city")

    day = wlm.lightmap.load("demos/data/city")
    model = wlm.lightmap.compress(day, "M", device="cpu", steps=10, samples=128)
    model.save("city.wlm")
    frame = wlm.load("city.wlm").decoder("cpu").frame(18.5)
    report = wlm.lightmap.evaluate(model, day)

    assert frame.shape == (256, 128, 3) and np.isfinite(frame).all()
    assert report.psnr > 0 and report.bytes == Path("city.wlm").stat().st_size
    assert wlm.lightmap.export(model, "engine")[-1] == Path("engine/weights.json")


def test_a_profile_by_name_by_path_and_as_an_object_is_one_profile(tmp_path):
    (tmp_path / "M.yaml").write_text("name: M\n")
    few = {"steps": 10, "samples": 128}
    named = wlm.lightmap.Profile.load("M")
    for i, (profile, overrides) in enumerate((("M", few), (tmp_path / "M.yaml", few), (named.override(few), {}))):
        wlm.lightmap.compress(moving_light(16, 16), profile, **overrides).save(tmp_path / f"{i}.wlm")
    first, *rest = (path.read_bytes() for path in sorted(tmp_path.glob("*.wlm")))
    assert all(content == first for content in rest) and len(rest) == 2
    assert wlm.load(tmp_path / "0.wlm").profile == named.override(few)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"stepps": 10}, "unknown key 'stepps'; did you mean 'steps'?"),
        ({"steps": 1}, "steps: expected greater than or equal to 10"),
        ({"quantise_from": 1.0, "freeze_from": 0.5}, "quantise_from must not be later than freeze_from"),
        ({"profile": "XXL"}, "profile 'XXL' of lightmap"),
    ],
)
def test_wrong_settings_are_one_line(options, says):
    with pytest.raises(WlmError) as error:
        wlm.lightmap.compress(moving_light(8, 8), **{"profile": tiny_profile()} | options)
    assert says in str(error.value) and "\n" not in str(error.value)
