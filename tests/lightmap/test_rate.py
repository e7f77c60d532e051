"""The size of the maps, chosen for a PSNR or for a size of the file."""

import math
import re

import numpy as np
import pytest
from builders.checks import assert_same, error_of
from builders.running import call
from builders.small_sets import moving_light, tiny_profile, write_set

from wlm.lightmap import fit, rate, worker
from wlm.lightmap.data import from_arrays
from wlm.lightmap.evaluation import bits_per_texel, evaluate
from wlm.lightmap.fit import Trials, compress
from wlm.lightmap.rate import RESOLUTIONS, Choice, choose
from wlm.lightmap.survey import Survey
from wlm.lightmap.targets import Targets
from wlm.lightmap.tiles import TileKind

SIZES = (4, 8, 16)
OPTIONS = {"seed": 0, "device": "cpu", "workers": 1, "cluster": None, "progress": None}


@pytest.fixture(autouse=True)
def few_sizes(monkeypatch):
    monkeypatch.setattr(rate, "RESOLUTIONS", SIZES)


@pytest.fixture(scope="module")
def light():
    return moving_light()


def bpp_of(lightmaps, resolution):
    model = compress(lightmaps, tiny_profile(uvt_resolution=resolution))
    return bits_per_texel(model, lightmaps.mask, model.file_bytes())


def test_the_largest_maps_that_a_size_allows(light):
    sizes = [bpp_of(light, resolution) for resolution in SIZES]
    for i, resolution in enumerate(SIZES):
        choice = choose(light, tiny_profile(), max_bpp=1.005 * sizes[i])
        assert choice.profile == tiny_profile(uvt_resolution=resolution)
        assert choice.bpp == pytest.approx(sizes[i], rel=0.03)
        assert choice.psnr is None and not choice.limited


def test_the_curve_follows_short_fits(light, monkeypatch):
    fits = []

    class Fits(Trials):
        """3 dB for twice the bytes after all steps, of which errors fall with a power, whatever the texels are."""

        def fit(self, **changes):
            model = super().fit(**changes)[0]
            fits.append(changes)
            missing = 4.0 * ((changes["steps"] / STEPS) ** -0.68 - 1.0)
            slope = 3.0 / (1.085 if changes["steps"] == 0.1 * STEPS else 1.0)
            return model, 50.0 + slope * math.log2(model.file_bytes() / first) - missing

    STEPS = 1000
    profile = tiny_profile(steps=STEPS, samples=128)
    first = Trials(light, profile, **OPTIONS).fit(steps=100)[0].file_bytes()
    monkeypatch.setattr(rate, "Trials", Fits)
    monkeypatch.setattr(rate, "RESOLUTIONS", RESOLUTIONS[:16])
    choice = choose(light, profile, target_psnr=52.0)
    chosen = choice.profile.uvt_resolution
    assert [fit["steps"] for fit in fits] == [100, 50, 100] and fits[2]["uvt_resolution"] > 8
    assert chosen not in (8, RESOLUTIONS[0], RESOLUTIONS[15]) and not choice.limited
    compressed = Fits(light, profile, **OPTIONS).fit(uvt_resolution=chosen, steps=STEPS)[1]
    assert choice.psnr == pytest.approx(compressed, abs=0.6) and compressed == pytest.approx(52.0, abs=0.9)


def test_a_trial_scores_what_it_holds(light):
    model, psnr = Trials(light, tiny_profile(steps=200), **OPTIONS).fit(uvt_resolution=12)
    assert model.profile.uvt_resolution == 12
    assert_same(model, compress(light, tiny_profile(steps=200, uvt_resolution=12)))
    assert psnr == pytest.approx(evaluate(model, light, metrics=("psnr",), views=0).psnr, abs=0.5)


def test_a_set_is_looked_at_once_for_all_fits(light, monkeypatch):
    made = []
    monkeypatch.setattr(worker, "Targets", lambda *args: made.append(args) or Targets(*args))
    choice = choose(light, tiny_profile(), target_psnr=14.0)
    model = compress(light, choice.profile, survey=choice.survey)
    assert len(made) == 1
    assert_same(model, compress(light, choice.profile))
    assert len(made) == 2


@pytest.mark.parametrize("changes", [{}, {"metric_weight": 0.3}])
def test_what_another_set_or_setting_was_looked_at_for_is_refused(light, changes):
    survey = Survey(light, tiny_profile())
    other = light if changes else moving_light()
    with pytest.raises(ValueError, match="expected a survey of all tiles"):
        compress(other, tiny_profile(**changes), survey=survey)


def test_a_survey_serves_a_fit_that_stores_other_tiles_as_frames(monkeypatch):
    light = moving_light(128, 256)
    survey = Survey(light, tiny_profile())
    compress(light, tiny_profile(), survey=survey)
    monkeypatch.setattr(fit, "choose_frames", lambda kinds, *_: np.arange(len(kinds)) == 0)
    model = compress(light, tiny_profile(), survey=survey)
    assert model.kind.tolist() == [TileKind.FRAMES, TileKind.DYNAMIC]
    assert_same(model, compress(light, tiny_profile()))


def test_a_size_comes_before_a_psnr(light):
    choice = choose(light, tiny_profile(), target_psnr=150.0, max_bpp=1.02 * bpp_of(light, 8))
    assert choice.profile.uvt_resolution == 8 and choice.limited and choice.psnr < 100.0


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ({}, "rate: expected a PSNR or a size, got neither"),
        ({"target_psnr": math.nan}, "--target-psnr: expected a finite number above 0, got nan"),
        ({"max_bpp": 0.0}, "--max-bpp: expected a finite number above 0, got 0"),
        ({"max_bpp": 0.01}, "--max-bpp: expected at least .* for profile tiny, got 0.01"),
        ({"target_psnr": 150.0}, "--target-psnr: expected at most .* for profile tiny, got 150"),
    ],
)
def test_what_cannot_be_chosen(light, wanted, message):
    assert re.fullmatch(message, error_of(choose, light, tiny_profile(), **wanted))


def test_nothing_to_choose():
    grey = from_arrays(np.ones((2, 128, 128, 3)), (0.0, 12.0))
    assert "no tile changes over time" in error_of(choose, grey, tiny_profile(), max_bpp=8.0)


def test_frames_have_no_size_to_choose(light):
    line = error_of(choose, light, tiny_profile(frames="always"), max_bpp=1.0)
    assert line == "rate: expected a profile of networks or video, got tiny, whose tiles are frames"
    one = moving_light(hours=(6.0,))
    assert "no tile changes over time" in error_of(choose, one, tiny_profile(frames="auto"), max_bpp=1.0)


def test_a_file_beyond_the_wanted_size_is_told(tmp_path, monkeypatch):
    write_set(tmp_path / "set", moving_light(24, 40, (3.0, 9.0)))
    monkeypatch.setattr(rate, "choose", lambda lightmaps, profile, **_: Choice(profile, 0.5))
    words = "lightmap", "compress", tmp_path / "set", "-o", tmp_path / "a.wlm", "--profile", "video"
    call(*words, "--max-bpp=0.5")
    bits = 8 * (tmp_path / "a.wlm").stat().st_size / (24 * 40 * 2)
    assert f"warning: --max-bpp 0.5: the trials were smaller than the file, which has {bits:.3f}" in call.stderr
    call(*words, "--max-bpp=500")
    assert "--max-bpp" not in call.stderr
