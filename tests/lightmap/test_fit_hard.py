"""Hard input from end to end: fitted, written, read, decoded."""

import numpy as np
import pytest
import torch
from builders.checks import error_of
from builders.kept_files import lightmap_fit
from builders.small_sets import HOURS, moving_light, tiny_profile

import wlm
from wlm.lightmap.data import from_arrays
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.evaluation import count_kinds, evaluate
from wlm.lightmap.fit import compress
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import LIGHT

PROFILE = tiny_profile()


def through_file(tmp_path, lightmaps, profile=PROFILE, **options):
    """Compresses, saves and loads a set; returns the decoder of its sheet, of finite light that is not negative."""
    compress(lightmaps, profile, **options).save(tmp_path / "a.wlm")
    decoder = SheetDecoder(wlm.load(tmp_path / "a.wlm").sheets[LIGHT])
    for stamp in lightmaps.times:
        frame = decoder.frame(stamp)
        assert frame.shape == lightmaps.light.frames.shape[1:]
        assert np.isfinite(frame).all() and (frame >= 0).all()
    return decoder


def decoded(decoder):
    return np.stack([decoder.frame(stamp) for stamp in decoder.model.times])


def only(decoder, kind):
    kinds = count_kinds(decoder.model)
    return kinds[kind] == sum(kinds.values())


def test_an_all_zero_set_is_constant_and_exact(tmp_path):
    decoder = through_file(tmp_path, from_arrays(np.zeros((5, 128, 128, 3)), HOURS, period=24.0))
    assert only(decoder, "constant") and not decoded(decoder).any()
    assert (tmp_path / "a.wlm").stat().st_size < 1024


@pytest.mark.parametrize("level", [1e-40, 1e-7, 6.26e-7])
def test_a_constant_below_what_half_floats_hold_is_kept(tmp_path, level):
    """Beside one that they hold, in as many bytes as before where all are such."""
    frames = np.full((2, 128, 256, 3), level, np.float32)
    frames[:, :, 128:] = 1e-3
    decoder = through_file(tmp_path, from_arrays(frames, (0.0, 1.0)))
    assert only(decoder, "constant") and decoder.model.constant.dtype == np.float32
    np.testing.assert_allclose(decoded(decoder), frames, rtol=1e-3)
    plain = compress(from_arrays(np.full_like(frames, 1e-3), (0.0, 1.0)), PROFILE)
    assert plain.sheets[LIGHT].constant.dtype == np.float16


def test_a_fit_that_diverged_keeps_nothing():
    _, trainer = lightmap_fit()
    for wrong in (np.nan, 1e5):
        trainer.state()
        kept = trainer.hidden[0, 2, 1].item()
        with torch.no_grad():
            trainer.hidden[0, 2, 1] = wrong
        assert "tile 0: the fit diverged; take a smaller map_rate or net_rate" in error_of(trainer.state)
        with torch.no_grad():
            trainer.hidden[0, 2, 1] = kept


def test_one_valid_texel(tmp_path):
    mask = np.zeros((128, 128), bool)
    mask[77, 3] = True
    lightmaps = moving_light(mask=mask)
    decoder = through_file(tmp_path, lightmaps)
    # A texel alone is a constant at every time, whatever the light does.
    assert only(decoder, "constant")
    np.testing.assert_allclose(decoded(decoder)[:, 77, 3], lightmaps.light.frames[:, 77, 3], rtol=2**-10)
    report = evaluate(wlm.load(tmp_path / "a.wlm"), lightmaps)
    assert report.light.scored == 0 and report.to_json()["psnr"] is None


@pytest.mark.parametrize("frames", ["auto", "never"])
def test_one_time_only_is_the_same_at_any_hour(tmp_path, frames):
    for period in (24.0, None):
        decoder = through_file(tmp_path, moving_light(hours=(6.0,), period=period), tiny_profile(frames=frames))
        assert only(decoder, "frames" if frames == "auto" else "dynamic")
        for hour in (0.0, 6.0, 23.9, -5.0, 100.0):
            # Up to the rounding of (1 - share) x + share x.
            np.testing.assert_allclose(decoder.frame(hour), decoder.frame(6.0), rtol=1e-5)


@pytest.mark.parametrize(
    ("times", "slices", "rows"), [(1, 1, 1), (6, 6, 6), (17, 12, 17), (26, 12, 24), (60, 28, 55), (200, 64, 64)]
)
def test_maps_follow_the_number_of_times(times, slices, rows):
    sized = Profile.load("standard").for_times(times)
    assert (sized.uvt_slices, sized.plane_rows) == (slices, rows)
    assert sized.for_times(times) == sized
    paper = Profile.load("M").for_times(times)
    assert (paper.uvt_slices, paper.plane_rows) == ((1, 1) if times == 1 else (12, 24))


@pytest.mark.slow
def test_two_hundred_times(tmp_path):
    """Eight days: 64 slices rather than 12."""
    days = moving_light(40, 40, np.arange(200.0), period=None)
    errors = []
    for follow in (False, True):
        profile = tiny_profile(steps=300, uvt_slices=12, plane_rows=24, follow_times=follow)
        compress(days, profile).save(tmp_path / "days.wlm")
        decoder = SheetDecoder(wlm.load(tmp_path / "days.wlm").sheets[LIGHT])
        wrong = (decoder.frame(hour) - days.light.frames[hour] for hour in range(0, 200, 7))
        errors.append(np.mean([np.square(frame).mean() for frame in wrong]))
    assert decoder.model.profile.uvt_slices == decoder.model.profile.plane_rows == 64
    assert errors[1] < 0.85 * errors[0]


def test_charts_of_one_texel_and_across_borders(tmp_path):
    """Texels alone, a chart over the border of two tiles and one along the map's end, as right as one within."""
    mask = np.zeros((128, 256), bool)
    mask[4:124:6, 4:60:6] = True
    within, across, along = np.s_[10:110, 70:100], np.s_[30:90, 110:150], np.s_[124:128, 160:256]
    for chart in (within, across, along):
        mask[chart] = True
    lightmaps = moving_light(128, 256, mask=mask)
    decoder = through_file(tmp_path, lightmaps, tiny_profile(hidden=16, steps=500, samples=512, uvt_resolution=16))
    error = np.square(decoded(decoder) - lightmaps.light.frames).mean((0, -1))
    alone = np.s_[4:124:6, 4:60:6]
    for part in (alone, across, along, np.s_[30:90, 127:129]):
        assert error[part].mean() < 2.0 * error[within].mean() < 5e-3
    # What a filter reads beside a texel that is alone is that texel.
    frame = decoder.frame(HOURS[1])
    np.testing.assert_array_equal(frame[5:124:6, 5:60:6], frame[alone])


@pytest.mark.parametrize(("height", "width", "tiles"), [(130, 70, 2), (1, 1, 1), (1, 300, 3)])
def test_maps_that_are_no_multiple_of_a_tile(tmp_path, height, width, tiles):
    lightmaps = moving_light(height, width)
    decoder = through_file(tmp_path, lightmaps)
    assert len(decoder.model.kind) == tiles
    assert decoder.tiles([tiles - 1], 3.0).shape == (1, 128, 128, 3)
    report = evaluate(wlm.load(tmp_path / "a.wlm"), lightmaps, metrics=("psnr",))
    assert report.bytes == (tmp_path / "a.wlm").stat().st_size
    assert report.bpp == report.bytes * 8 / (height * width * len(HOURS))


def test_dark_and_bright_tiles_side_by_side(tmp_path):
    frames = moving_light(128, 256).light.frames.copy()
    frames[:, :, :128] *= 1e-4
    frames[:, :, 128:] *= 5e4
    lightmaps = from_arrays(frames, HOURS, period=24.0)
    out = decoded(through_file(tmp_path, lightmaps, tiny_profile(steps=60)))
    assert frames.max() > 50_000 and out.max() > 10_000
    for half in (slice(0, 128), slice(128, 256)):
        np.testing.assert_allclose(out[:, :, half].mean((1, 2)), frames[:, :, half].mean((1, 2)), rtol=0.3)


def test_channels_that_are_black_at_one_time_or_always_stay_black(tmp_path):
    frames = moving_light().light.frames.copy()
    frames[..., 1] = 0.0
    frames[1, ..., 2] = 0.0
    frames[3] = 0.0
    decoder = through_file(tmp_path, from_arrays(frames, HOURS, period=24.0))
    out = decoded(decoder)
    assert not out[1, ..., 2].any() and not out[3].any() and not out[..., 1].any()
    assert out[1, ..., 0].mean() > 0.05 and out[2, ..., 2].mean() > 0.05


def test_a_subset_of_the_tiles(tmp_path):
    lightmaps = moving_light(200, 256)
    decoder = through_file(tmp_path, lightmaps, tiles=[3, 0])
    assert decoder.model.kind.tolist() == [3, 0, 0, 3]
    frame = decoder.frame(5.0)
    assert frame[:128, :128].any() and frame[128:, 128:].any()
    assert not frame[:128, 128:].any() and not frame[128:, :128].any()


def test_a_tile_alone_is_the_tile_of_a_batch():
    narrow, lightmaps = moving_light(128, 128), moving_light(128, 256)
    frames = lightmaps.light.frames.copy()
    frames[:, :, :128] = narrow.light.frames
    frames[:, :, 128:] = frames[:, :, 128:] * 0.01 + frames[:, :, :128].mean((1, 2))[:, None, None]
    lightmaps = from_arrays(frames, HOURS, period=24.0)
    batch = compress(lightmaps, PROFILE, seed=5).sheets[LIGHT]
    alone = compress(lightmaps, PROFILE, seed=5, tiles=[0]).sheets[LIGHT]
    assert len(batch.uv) == 2
    for name in ("uv", "uvt", "ut", "vt", "net", "scale", "peak", "affine"):
        np.testing.assert_array_equal(getattr(batch, name)[:1], getattr(alone, name)[:1], err_msg=name)
    np.testing.assert_array_equal(SheetDecoder(batch).tiles([0], 9.0), SheetDecoder(alone).tiles([0], 9.0))


# Not the paper's axis over a day: it is clamped at midnight, and the jump there is its own.
@pytest.mark.parametrize(("period", "time_axis"), [(24.0, "frames"), (None, "frames"), (None, "paper")])
def test_light_moves_smoothly_between_stored_times(tmp_path, period, time_axis):
    lightmaps = moving_light(period=period)
    decoder = through_file(tmp_path, lightmaps, tiny_profile(steps=100, time_axis=time_axis))
    frames = decoded(decoder)
    neighbours = np.abs(np.diff(frames, axis=0))
    if period is not None:
        neighbours = np.concatenate([neighbours, np.abs(frames[:1] - frames[-1:])])
    largest = neighbours.max(0)
    hours = np.arange(-0.5, 25.0, 1.5)
    steps = np.abs(np.diff(np.stack([decoder.frame(hour) for hour in hours]), axis=0)).max(0)
    assert (steps <= largest + 0.02 * frames.max()).all()
    # And it does move: the day is not a row of stills.
    middle = decoder.frame(8.0)
    assert np.abs(middle - frames[1]).max() > 0.02 and np.abs(middle - frames[2]).max() > 0.02


def test_times_outside_the_range_wrap_or_stop(tmp_path):
    wrapped = through_file(tmp_path, moving_light(period=24.0))
    for hour in (-3.0, 21.0, 24.0, 47.5, -240.0):
        np.testing.assert_allclose(wrapped.frame(hour), wrapped.frame(hour % 24.0), atol=1e-5)
    stopped = through_file(tmp_path, moving_light(period=None))
    np.testing.assert_array_equal(stopped.frame(-100.0), stopped.frame(HOURS[0]))
    np.testing.assert_array_equal(stopped.frame(1e9), stopped.frame(HOURS[-1]))
    for bad in (np.nan, np.inf):
        assert "time" in error_of(stopped.frame, bad)
