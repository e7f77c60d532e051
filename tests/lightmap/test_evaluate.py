"""Scores: those of the protocol, over the tiles that a model has, and of a short fit of the demo set."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.small_sets import HOURS, moving_light, tiny_profile

import wlm
from wlm.lightmap.data import from_arrays, load
from wlm.lightmap.evaluation import bits_per_texel, evaluate
from wlm.lightmap.fit import compress
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.tiles import TILE
from wlm.metrics import evaluate_frame, summarise

SUFFIXED = ("psnr_by_tile", "psnr_by_time", "ssim_by_time", "flip_by_time")


def four_tiles():
    """Two dynamic tiles, a constant and an empty one, in a map that ends inside its last row and column."""
    moving = moving_light(128, 228).light
    frames = np.zeros((5, 200, 228, 3), np.float32)
    frames[:, :128] = moving.frames
    frames[:, 128:, :128] = 0.5
    mask = np.ones((200, 228), bool)
    mask[128:, 128:] = False
    return from_arrays(frames, moving.times, mask, 24.0, name="four")


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    lightmaps = four_tiles()
    path = tmp_path_factory.mktemp("fitted") / "a.wlm"
    size = compress(lightmaps, tiny_profile(steps=60)).save(path)
    return lightmaps, wlm.load(path), size


@pytest.fixture(scope="module")
def report(fitted):
    lightmaps, model, _ = fitted
    return evaluate(model, lightmaps)


def test_the_scores_are_those_of_the_protocol(fitted, report):
    lightmaps, model, _ = fitted
    decoder, light, found = model.decoder(), lightmaps.light, report.light
    frames = zip(light.frames, light.times, strict=True)
    frames = [evaluate_frame(original, decoder.frame(stamp), light.mask) for original, stamp in frames]
    expected = summarise(frames, light.times)
    assert math.isfinite(report.psnr)
    for name in ("psnr", "ssim", "flip", "worst_tile", "max_abs_error"):
        assert getattr(found, name) == getattr(expected, name)
    assert (report.psnr, report.ssim, report.flip) == pytest.approx((found.psnr, found.ssim, found.flip), rel=1e-12)
    for name in SUFFIXED:
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))


def test_what_is_scored_and_left_out_is_counted(fitted, report):
    _, model, size = fitted
    light = report.light
    assert light.kinds == {"empty": 1, "constant": 1, "dynamic": 2, "frames": 0}
    assert (light.tiles, len(report.times), report.bytes) == (3, 5, size)
    assert light.not_scored == {"empty": 5, "not_held": 0, "few_texels": 0, "zero_range": 5}
    assert light.scored == 10
    assert report.bpp == size * 8 / (200 * 228 * 5)
    assert report.warnings == [] and report.profile == "tiny"


def test_only_the_tiles_of_the_file_are_scored(fitted):
    lightmaps, whole, _ = fitted
    model = compress(lightmaps, tiny_profile(steps=60), tiles=[1, 2])
    report = evaluate(model, lightmaps, metrics=("psnr",), file_bytes=50_000)
    light = report.light
    assert light.not_scored == {"empty": 5, "not_held": 5, "few_texels": 0, "zero_range": 5}
    assert light.tiles == 2 and "1 tiles with valid texels" in report.warnings[0]
    assert math.isnan(light.psnr_by_tile[0, 0]) and math.isfinite(light.psnr_by_tile[0, 1])
    # The part of the map that tiles 1 and 2 cover.
    assert report.bpp == 50_000 * 8 / ((128 * 100 + 72 * 128) * 5)
    assert bits_per_texel(whole.sheets[LIGHT], lightmaps.light.mask, 50_000) == 50_000 * 8 / (200 * 228 * 5)


def test_another_source_is_scored_with_a_warning(fitted):
    lightmaps, model, _ = fitted
    light = lightmaps.light
    other = from_arrays(light.frames * 1.5, light.times, light.mask, 24.0)
    report = evaluate(model, other, metrics=("psnr",))
    assert model.source in report.warnings[0] and other.source in report.warnings[0]
    assert report.psnr < evaluate(model, lightmaps, metrics=("psnr",)).psnr


def test_a_set_that_does_not_fit_is_one_line(fitted):
    lightmaps, model, _ = fitted
    frames, times, mask = lightmaps.light.frames, lightmaps.times, lightmaps.light.mask
    for other, says in (
        (from_arrays(frames[:, :-1], times, mask[:-1]), "has 228x199 texels, but the file four has 228x200"),
        (from_arrays(frames[:3], times[:3], mask), "expected a lightmap at 13.5, as in the file four, found none"),
        (from_arrays(frames, times + 0.1, mask), "expected a lightmap at 0, as in the file four, found none"),
        (from_arrays(frames, times, ~mask), "no tile of the file four has a valid texel"),
    ):
        assert re.search(says, error_of(evaluate, model, other))
    assert "unknown metric" in error_of(evaluate, model, lightmaps, metrics=("lpips",))
    assert "device" in error_of(evaluate, model, lightmaps, device="tpu")


def test_a_firefly_that_is_lost_is_said():
    """By the fit's own look at the few tiles that may have one, and by the evaluation; of the times that hold it."""
    plain = moving_light(128, 150)
    frames = plain.light.frames.copy()
    frames[2, 60, 60] = 1e4
    lightmaps = from_arrays(frames, plain.times, period=24.0, name="fly")
    model = compress(lightmaps, tiny_profile(steps=60))
    (line,) = model.warnings
    assert line.startswith("fly: 1 texel among the brightest of their tile lost more than half of the light; the larg")
    assert "of 1e+04 decodes to 0." in line and line.endswith("(tile 0 at 11)")
    assert line in evaluate(model, lightmaps, metrics=("psnr",)).warnings
    assert compress(plain, tiny_profile(steps=60)).warnings == ()


def test_a_bright_patch_that_hides_the_rest_is_said():
    """Errors of a tile are relative to its range, which hides that the dim texels are off by half of their light."""
    plain = moving_light(128, 128)
    frames = plain.light.frames.copy()
    frames[:, 20:60, 20:60] = 6e4
    lightmaps = from_arrays(frames, plain.times, period=24.0, name="patch")
    model = compress(lightmaps, tiny_profile(steps=60))
    report = evaluate(model, lightmaps, metrics=("psnr",))
    (line,) = (line for line in model.warnings if "most of their tile" in line)
    assert line.startswith("patch: ") and line in report.warnings


def test_times_that_the_model_lacks_are_scored_by_themselves(fitted):
    whole, _, _ = fitted
    stored = whole.without([5.0, 13.5])
    light = whole.light
    assert stored.source == from_arrays(light.frames[[0, 2, 4]], light.times[[0, 2, 4]], light.mask, 24.0).source
    model = compress(stored, tiny_profile(steps=60))
    report, alone = evaluate(model, whole, metrics=("psnr",)), evaluate(model, stored, metrics=("psnr",))
    held, decoder = report.light.held_out, model.decoder()
    assert report.psnr == alone.psnr and report.warnings == [] and alone.light.held_out is None
    assert held.times.tolist() == [5.0, 13.5] and report.times.tolist() == [0.0, 11.0, 20.0]
    for i, (k, before, share) in enumerate(((1, 0, 5.0 / 11.0), (3, 2, 2.5 / 9.0))):
        mixed = (1.0 - share) * light.frames[before] + share * light.frames[(2, 4)[i]]
        for scores, frame in ((held.decoded, decoder.frame(light.times[k])), (held.mixed, mixed)):
            expected = summarise([evaluate_frame(light.frames[k], frame, light.mask, metrics=["psnr"])])
            assert scores.psnr_by_time[i] == pytest.approx(expected.psnr, rel=1e-6)
    assert held.mixed.psnr != held.decoded.psnr
    for times, says in (([7.0], "expected times of the set to leave out, got 7"), (HOURS, "at least one time")):
        assert re.search(says, error_of(whole.without, times))


def test_a_texel_of_a_time_that_is_left_out():
    """A texel that no other time has is not valid in what remains, and light of that time fills no other."""
    frames = moving_light(128, 128).light.frames
    mask = np.ones(frames.shape[:3], bool)
    mask[[0, 2, 3, 4], :10] = False
    mask[2, 20:30] = mask[3, 40:50] = False
    whole = from_arrays(frames, HOURS, mask, 24.0)
    stored = whole.without([HOURS[1]]).light
    expected = from_arrays(frames[[0, 2, 3, 4]], np.delete(HOURS, 1), mask[[0, 2, 3, 4]], 24.0).light
    assert not stored.mask[:10].any() and stored.mask[10:].all()
    np.testing.assert_array_equal(stored.covered, expected.covered)
    np.testing.assert_array_equal(stored.frames[:, 10:], expected.frames[:, 10:])


def test_each_hour_is_scored_on_its_own_texels():
    """An object that is there at one hour alone: it is fitted, and no other hour is blamed for it."""
    lightmaps = moving_light(128, 128).light
    mask = np.ones(lightmaps.frames.shape[:3], bool)
    mask[:, 40:80, 40:80] = False
    mask[2] = True
    frames = np.where(mask[..., None], lightmaps.frames, 0.0)
    differing = from_arrays(frames, HOURS, mask, 24.0)
    model = compress(differing, tiny_profile(steps=200))
    report = evaluate(model, differing, metrics=["psnr"])
    decoded = model.decoder().frame(HOURS[2])
    inside = np.abs(decoded - differing.light.frames[2])[40:80, 40:80]
    assert inside.mean() < 0.1 * np.ptp(differing.light.frames[2])
    frames, decoder = differing.light.frames, model.decoder()
    pairs = ((frames[i], decoder.frame(hour), mask[i]) for i, hour in enumerate(HOURS))
    expected = [evaluate_frame(*each, metrics=["psnr"]).psnr for each in pairs]
    np.testing.assert_allclose(report.light.psnr_by_time, np.ravel(expected), rtol=1e-6)


DEMO = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"


@pytest.mark.parametrize(
    ("whole", "least"),
    [
        (False, {"psnr": 32.2, "seen": 33.0, "ring": 28.7, "between": 33.3}),
        pytest.param(True, {"psnr": 41.0, "seen": 42.0, "ring": 37.0, "between": 42.5}, marks=pytest.mark.slow),
    ],
    ids=["a tile", "all"],
)
def test_light_is_as_right_and_small_as_it_was(whole, least):
    """At texels, filtered, beside charts, and half-way between hours, dB; seeds differ by 0.2."""
    day, steps = load(DEMO), 800
    if not whole:
        light, steps = day.light, 200
        day = from_arrays(light.frames[::3, :TILE], light.times[::3], light.mask[:TILE], 24.0)
    report = evaluate(compress(day, "M", steps=steps, samples=1024), day, metrics=("psnr", "seen"), views=0)
    found = {name: getattr(report, name) for name in least}
    assert all(found[name] >= least[name] for name in least), found
    assert report.bpp <= (0.72 if whole else 2.1)
