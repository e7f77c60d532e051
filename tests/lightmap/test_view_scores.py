"""Scores of light as it is seen, filtered and in views of a mesh, against values by hand."""

import dataclasses
import json
import math

import numpy as np
import pytest
from builders.checks import error_of
from builders.small_sets import moving_light, sheet_from_arrays, tiny_profile

from wlm.errors import WlmError
from wlm.formats.exr import write_exr
from wlm.formats.geometry import Geometry
from wlm.lightmap.data import from_arrays, load
from wlm.lightmap.evaluation import evaluate
from wlm.lightmap.fit import compress
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.view_scores import NO_VIEWS, ShownScore, Tally, Views, views_of
from wlm.metrics import PSNR_CAP_DB, evaluate_frame
from wlm.texels import fill_gaps


def light(height, width, times=(0.0,), mask=None, period=None):
    """Noise of range 1 at all times, alike; where it is 0 and 1 is in the mask."""
    frame = np.random.default_rng(3).uniform(0.2, 0.8, (height, width, 3))
    if mask is not None and mask.sum() > 1:
        frame[tuple(np.argwhere(mask)[0])], frame[tuple(np.argwhere(mask)[1])] = 0.0, 1.0
    elif mask is None:
        for y in range(0, height, 128):
            for x in range(0, width, 128):
                frame[y, x], frame[y, min(x + 1, width - 1)] = 0.0, 1.0
    return sheet_from_arrays(np.stack([frame] * len(times)), times, mask, period, name="noise")


def scored(lightmaps, decoded, decode=None, mask=None, indices=None) -> ShownScore:
    """The score of decoded frames, all or those of some times."""
    mask = lightmaps.mask if mask is None else mask
    tally = Tally(lightmaps, mask, decode)
    for i, frame in zip(range(len(lightmaps.times)) if indices is None else indices, decoded, strict=True):
        tally.add(i, frame, evaluate_frame(lightmaps.frames[i], frame, mask, metrics=("psnr",)))
    return tally.score()


def mixed(lightmaps, frames):
    """Light at any time by eq. 2."""
    axis = TimeAxis(lightmaps.times, lightmaps.period, "frames")

    def decode(time):
        before, after, share = axis.neighbours(time)
        return np.float32(1.0 - share) * frames[before] + np.float32(share) * frames[after]

    return decode


def db(share) -> float:
    return -20.0 * math.log10(share)


def square(side=128, low=32, high=96):
    mask = np.zeros((side, side), bool)
    mask[low:high, low:high] = True
    return mask


@pytest.mark.parametrize("period", [24.0, None])
def test_a_decoder_that_gives_the_original_is_at_the_cap(period):
    """A map that is no multiple of a tile, with gaps; the last hours of a day lie beside the first."""
    mask = np.ones((200, 228), bool)
    mask[40:60, 30:150] = mask[128:, 128:180] = False
    day = moving_light(200, 228, mask=mask, period=period).light
    filled = fill_gaps(day.frames, day.mask)
    score = scored(day, filled, mixed(day, filled))
    assert score.seen == score.ring == PSNR_CAP_DB and score.between > 115.0
    assert math.isnan(score.border) and 0.0 <= score.flicker < 1e-6
    rival = scored(day, filled)
    assert rival.seen == rival.ring == rival.between == PSNR_CAP_DB and rival.flicker == 0.0
    np.testing.assert_array_equal(rival.seen_by_time, np.full(5, PSNR_CAP_DB))
    assert rival.seen_by_tile.shape == (2, 2) and rival.views == 0 and rival.worst_view is None
    # With a period the interval from 20 to 24 h counts.
    assert rival.worst_between["time"] == 2.5


def test_gaps_unfilled_are_seen_and_the_texels_do_not_tell():
    """A point in a texel's outer half reads x of the gap, 0 <= x < 1/2: the mean of x^2 over a texel is 1/24."""
    mask, off = square(), 0.3
    still = light(128, 128, mask=mask)
    filled = fill_gaps(still.frames[0], mask)
    wrong = np.where(mask[..., None], filled, filled + np.float32(off))
    assert evaluate_frame(still.frames[0], wrong, mask, metrics=("psnr",)).psnr[0, 0] == PSNR_CAP_DB
    score = scored(still, [wrong])
    assert score.ring == pytest.approx(db(off), abs=1e-4)
    # 4 sides of 64 texels of 4,096.
    assert score.seen == pytest.approx(db(off * math.sqrt(1 / 24 / 16)), abs=0.3)
    assert score.worst_seen == {"psnr": score.seen, "time": 0.0, "tile": 0, "row": 0, "column": 0}
    # Texels that no read touches may have any value, and the ring too except in its own score.
    ring = np.zeros_like(mask)
    ring[31:97, 31:97] = True
    far = np.where(ring[..., None], filled, np.nan).astype(np.float32)
    assert scored(still, [far]).seen == scored(still, [far]).ring == PSNR_CAP_DB
    wrong[31, 31] = np.inf
    assert "beside a chart decodes to NaN or infinity: row 31, column 31" in error_of(scored, still, [wrong])


@pytest.mark.parametrize("shape", [(128, 128), (130, 300)])
def test_an_error_that_is_the_same_everywhere_is_seen_as_it_is(shape):
    """Also at the map's ends, where reads are clamped; a set without gaps has no ring."""
    still = light(*shape)
    score = scored(still, still.frames + np.float32(0.25))
    np.testing.assert_allclose(score.seen_by_tile[:, : shape[1] // 128], db(0.25), atol=1e-4)
    assert math.isnan(score.ring)
    assert score.border == pytest.approx(1.0, abs=1e-5) if shape[1] > 128 else math.isnan(score.border)


def test_errors_at_borders_of_tiles_stand_out():
    still = light(128, 256)
    error = np.zeros((128, 256, 1), np.float32)
    # Tiles that are off by one number each way cancel between them: the mean of (1 - 2 x)^2, 0 <= x < 1/2, is 1/3.
    error[:, :128], error[:, 128:] = 0.1, -0.1
    assert scored(still, [still.frames[0] + error]).border == pytest.approx(math.sqrt(1 / 3), rel=0.05)
    # Wrong in the column beside the border alone: a seam.
    error[:, :127] = error[:, 129:] = 0.0
    assert scored(still, [still.frames[0] + error]).border > 5.0
    # One that is wrong nowhere but where a point reads two tiles has no measure to be compared with.
    flat = sheet_from_arrays(np.linspace(0.0, 1.0, 256)[None, None, :, None] * np.ones((1, 128, 1, 3)), [0.0])
    assert math.isnan(scored(flat, flat.frames).border)


def test_a_dark_tile_is_not_blamed_for_the_error_of_a_bright_one():
    bright = light(128, 256)
    share = np.where(np.arange(256) < 128, np.float32(0.01), np.float32(1.0))[:, None]
    both = sheet_from_arrays(bright.frames * share, bright.times, name="both")
    noise = np.random.default_rng(5).normal(0.0, 0.02, (128, 256, 3)).astype(np.float32)
    score = scored(both, [both.frames[0] + noise * share])
    # As with tiles that are alike: a hundredth of the light, a hundredth of the error.
    assert score.border == pytest.approx(scored(bright, [bright.frames[0] + noise]).border, rel=1e-3)
    assert score.border == pytest.approx(1.0, abs=0.1)


def test_half_way_between_times_a_step_is_half_a_step_off():
    """A decoder that stays until the next hour; eq. 2 is half-way. The wrong interval is the one after midnight's."""
    still = light(128, 128, (6.0, 18.0, 20.0), period=24.0)
    frames = still.frames.copy()
    frames[1:] += 0.2
    day = sheet_from_arrays(frames, still.times, period=24.0)

    def stays(time):
        return frames[np.searchsorted(day.times, time, side="right") - 1]

    score = scored(day, frames, stays)
    assert score.seen == PSNR_CAP_DB
    wrong = db(0.1)
    assert score.between == pytest.approx((PSNR_CAP_DB + 2 * wrong) / 3, abs=1e-3)
    assert score.worst_between["psnr"] == pytest.approx(wrong, abs=1e-3) and score.worst_between["time"] in (12.0, 1.0)
    # Without a period the day ends with its last hour.
    open_day = sheet_from_arrays(frames, still.times)
    assert scored(open_day, frames, stays).between == pytest.approx((PSNR_CAP_DB + wrong) / 2, abs=1e-3)


def test_flicker_is_what_moves_beyond_the_original():
    times = (0.0, 6.0, 12.0, 18.0)
    still = light(128, 128, times, period=24.0)

    def drifts(time):
        return still.frames[0] + np.float32(0.1) * np.float32(time)

    decoded = [drifts(time) for time in times]
    # 0.1 of the range in an hour is a twentieth of it in 3 minutes.
    assert scored(still, decoded, drifts).flicker == pytest.approx(0.005, rel=1e-3)
    # A rival's light moves from frame to frame: up in three intervals of 6 hours, all the way down in the last.
    assert scored(still, decoded).flicker == pytest.approx((3 * 0.005 + 0.015) / 4, rel=1e-3)
    # An original that moves as fast excuses it, and so one that moves faster.
    for faster in (1.0, 3.0):
        moving = sheet_from_arrays(np.stack([still.frames[0] + faster * 0.1 * time for time in times]), times)
        assert scored(moving, decoded, drifts).flicker < 1e-6
    # Two steps in an interval of 2.4 minutes.
    brief = sheet_from_arrays(still.frames[:2], (0.0, 0.04))
    assert scored(brief, decoded[:2], drifts).flicker == pytest.approx(0.002, rel=1e-3)


@pytest.mark.parametrize("period", [24.0, None])
def test_one_time_has_nothing_between(period):
    still = light(128, 128, (12.0,), period=period)
    score = scored(still, still.frames, lambda time: still.frames[0])
    assert score.seen == PSNR_CAP_DB and score.worst_between is None
    assert math.isnan(score.between) and math.isnan(score.flicker)
    document = score.to_json()
    assert document["between"] is None and document["flicker"] is None and document["border"] is None


def test_only_intervals_with_both_ends_count():
    day = light(128, 128, (0.0, 6.0, 12.0, 18.0), period=24.0)
    frames = day.frames.copy()
    frames[1] += 0.1
    score = scored(day, [frames[1], frames[3]], indices=(1, 3))
    assert math.isnan(score.between) and np.isnan(score.seen_by_time[[0, 2]]).all()
    assert np.nanargmin(score.seen_by_time) == 1
    # 18 h and 0 h meet at midnight.
    assert scored(day, frames[[0, 3]], indices=(0, 3)).between == PSNR_CAP_DB
    assert scored(day, frames[:2], indices=(0, 1)).between == pytest.approx(db(0.05), abs=1e-3)


def test_charts_of_one_texel():
    """64 at the map's ends and within make a score; of fewer there is none, and none of one grey."""
    mask = np.zeros((128, 130), bool)
    mask[::16, ::16] = True
    still = light(128, 130, mask=mask)
    assert mask[:, :128].sum() == 64
    filled = fill_gaps(still.frames[0], mask)
    score = scored(still, [filled])
    assert score.seen == PSNR_CAP_DB and np.isnan(score.seen_by_tile[0, 1])
    wrong = np.where(mask[..., None], filled, filled + np.float32(0.5))
    # With weights a and b of the texel itself, 1/2 <= a, b <= 1, a point is (1 - a b) off: the means of a and of its
    # square are 3/4 and 7/12, at the map's left and upper end 7/8 and 19/24.
    share = sum(
        count * (1 - 2 * first[0] * second[0] + first[1] * second[1]) / 64
        for count, first, second in (
            (49, (3 / 4, 7 / 12), (3 / 4, 7 / 12)),
            (14, (7 / 8, 19 / 24), (3 / 4, 7 / 12)),
            (1, (7 / 8, 19 / 24), (7 / 8, 19 / 24)),
        )
    )
    assert scored(still, [wrong]).seen == pytest.approx(db(0.5 * math.sqrt(share)), abs=0.4)
    mask[0, 0] = False
    few = light(128, 130, mask=mask)
    score = scored(few, [np.zeros_like(filled)])
    assert math.isnan(score.seen) and math.isnan(score.ring) and score.worst_seen is None
    grey = sheet_from_arrays(np.full((2, 128, 128, 3), 0.5), (0.0, 1.0), square())
    score = scored(grey, grey.frames)
    assert all(math.isnan(value) for value in (score.seen, score.ring, score.between, score.border, score.flicker))


def test_tiles_that_a_file_lacks_are_no_error_beside_them():
    still = light(128, 256)
    decoded = still.frames.copy()
    decoded[0, :, 128:] = 0.0
    half = still.mask.copy()
    half[:, 128:] = False
    assert scored(still, decoded, mask=half).seen == PSNR_CAP_DB
    # Of a tile without a chart a filter reads what is there: black, in a 24th of a column's texels, as above.
    empty = sheet_from_arrays(still.frames, [0.0], half)
    score = scored(empty, decoded)
    column = np.square(still.frames[0, :, 127]).mean()
    assert score.seen == pytest.approx(db(math.sqrt(column / 24 / 128)), abs=0.8)
    assert score.border == math.inf and math.isnan(score.ring)


def test_the_report_has_the_scores_of_its_decoder():
    day = moving_light(128, 150, mask=np.indices((128, 150)).sum(0) % 40 > 8)
    model = compress(day, tiny_profile(steps=60))
    report = evaluate(model, day, metrics=("psnr", "seen"))
    decoder = model.decoder()
    score = scored(day.light, [decoder.frame(time) for time in day.times], decoder.frame)
    for name, value in vars(score).items():
        np.testing.assert_equal(getattr(report.light, name), value)
    (document,) = report.to_json()["sheets"]
    assert all(isinstance(document[name], float) for name in ("seen", "ring", "between", "border", "flicker"))
    assert document["worst_seen"]["psnr"] == min(report.light.worst_seen["psnr"], np.nanmin(report.light.seen_by_tile))
    (left_out,) = evaluate(model, day, metrics=("psnr",)).to_json()["sheets"]
    assert left_out["seen"] is None and left_out["worst_seen"] is None and left_out["psnr"] == document["psnr"]
    assert "views: expected at least 0, got -1" in error_of(evaluate, model, day, metrics=("seen",), views=-1)


UPWARD = """v -1 0 -1
v 1 0 -1
v 1 0 1
v -1 0 1
vt 0 1
vt 1 1
vt 1 0
vt 0 0
f 4/4 3/3 2/2 1/1
"""
"""A floor, seen from above alone."""


@pytest.fixture(autouse=True)
def small_views(monkeypatch):
    monkeypatch.setattr("wlm.lightmap.view_scores.RESOLUTION", 128)


def floor() -> Geometry:
    position = np.array([[-1, 0, -1], [1, 0, -1], [1, 0, 1], [-1, 0, 1]], np.float32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    return Geometry(position, np.array([[3, 2, 1], [3, 1, 0]], np.uint32), uv)


def grey(level=0.5, times=(6.0, 12.0, 18.0)):
    return from_arrays(np.full((len(times), 8, 8, 3), level), times, period=24.0, name="grey").light


def shown(light: float) -> float:
    """Light on the display: an exposure that takes 0.5 to 0.8, Reinhard's curve, sRGB."""
    x = 1.6 * light
    x = x * (1.0 + x / 16.0) / (1.0 + x)
    return 1.055 * x ** (1 / 2.4) - 0.055


def test_the_error_is_that_of_the_display():
    day = grey()
    views = Views(day, floor(), 8)
    decoded = [day.frames[0], 0.5 * day.frames[1], day.frames[2]]
    for i in range(3):
        views.add(i, day.frames[i], decoded[i])
    score = views.score()
    # Cameras 0 to 3 of 8 look from above, 1 of them at 12 h.
    assert score.views == 4
    off = shown(0.5) - shown(0.25)
    worst = score.worst_view
    assert worst["view"] == 1 and worst["time"] == 12.0 and 0.0 < score.view_flip < worst["flip"] < 1.0
    assert worst["psnr"] == pytest.approx(-20.0 * math.log10(off), abs=1e-3)
    # One of four views of about equal areas.
    assert score.view_psnr == pytest.approx(-10.0 * math.log10(off**2 / 4.0), abs=1.5)
    right = Views(day, floor(), 8)
    for i in range(3):
        right.add(i, day.frames[i], day.frames[i])
    assert (right.score().view_psnr, right.score().view_flip) == (120.0, 0.0)


def test_all_times_take_turns_and_views_from_behind_show_nothing():
    day = grey()
    views = Views(day, floor(), 8)
    views.add(2, day.frames[2], 0.5 * day.frames[2])
    assert views.score().views == 1 and views.score().worst_view["time"] == 18.0
    below = Views(day, dataclasses.replace(floor(), triangle=floor().triangle[:, ::-1].copy()), 1)
    for i in range(3):
        below.add(i, day.frames[i], day.frames[i])
    assert below.score() == NO_VIEWS
    with pytest.raises(WlmError, match="expected a mesh with an extent"):
        Views(day, dataclasses.replace(floor(), position=np.zeros((4, 3), np.float32)), 1)


def with_mesh(day, path):
    return dataclasses.replace(day, sheets={LIGHT: dataclasses.replace(day.light, mesh=path)})


def test_a_set_that_names_its_mesh_has_views_in_its_report(tmp_path):
    day = moving_light(hours=(0.0, 12.0))
    model = compress(day, tiny_profile(steps=20))
    named = with_mesh(day, tmp_path / "floor.obj")
    (tmp_path / "floor.obj").write_text(UPWARD)
    report = evaluate(model, named, metrics=("seen",), views=4)
    light = report.light
    assert light.views == 2 and 5.0 < light.view_psnr < 60.0 and 0.0 < light.view_flip < 1.0
    assert light.worst_view["psnr"] <= light.view_psnr and not any("views" in line for line in report.warnings)
    assert report.to_json()["sheets"][0]["worst_view"]["time"] in (0.0, 12.0)
    assert evaluate(model, named, metrics=("seen",), views=0).light.views == 0
    assert views_of(day.light, 4) == (None, [])
    (tmp_path / "empty.obj").write_text("v 0 0 0")
    for name, says in (("empty.obj", "expected triangles"), ("absent.obj", "absent.obj")):
        named = with_mesh(day, tmp_path / name)
        report = evaluate(model, named, metrics=("seen",), views=4)
        light = report.light
        assert light.views == 0 and math.isnan(light.view_psnr) and light.worst_view is None
        assert report.warnings[0].startswith("moving: no views are scored: ") and says in report.warnings[0]


def test_the_mesh_of_a_set_lies_in_its_folder(tmp_path):
    write_exr(tmp_path / "a.exr", np.ones((4, 4, 3), np.float32))
    content = {"width": 4, "height": 4, "lightmaps": [{"time_hours": 1, "file": "a.exr"}]}

    def stored(**more):
        (tmp_path / "set.json").write_text(json.dumps(content | more))
        return tmp_path

    assert load(stored()).light.mesh is None and load(stored(mesh=None)).light.mesh is None
    # It need not be there: evaluate alone reads it.
    assert load(stored(mesh="scene.glb")).light.mesh == tmp_path / "scene.glb"
    assert "mesh: expected a file within" in error_of(load, stored(mesh="../scene.glb"))
    assert load(stored(mesh="../scene.glb"), trust=True).light.mesh == tmp_path / "../scene.glb"
    assert "mesh: expected a valid string, got 3" in error_of(load, stored(mesh=3))
