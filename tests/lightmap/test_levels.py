"""Tiles stored as levels: what they decode to, what their streams may be, and what they are worth."""

import sys
from pathlib import Path

import numpy as np
import pytest
from builders.small_sets import moving_light
from builders.synthetic import random_model
from builders.words import check_written, error_of_changed

import wlm
from benchmarks.rivals.lightmap import evaluate_rivals
from wlm.errors import WlmError
from wlm.lightmap import video
from wlm.lightmap.data import from_arrays
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import count_kinds, memory_bytes
from wlm.lightmap.exact import bound64, colour_tile64, decode_tile64
from wlm.lightmap.fit import compress
from wlm.lightmap.held import held_tiles
from wlm.lightmap.level_packing import STEPS, unpack_levels
from wlm.lightmap.levels import decoded, quantise, steps_for, tile_psnr
from wlm.lightmap.model import Profile
from wlm.lightmap.page import MapDecoder
from wlm.lightmap.rate import choose
from wlm.lightmap.runtime import FrameDecoder
from wlm.lightmap.streams import code_levels, read_levels
from wlm.lightmap.tiles import TileKind

DEMO = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"
FILES = Path(__file__).resolve().parents[1] / "files"
KINDS = (6, 4, 5, 6)


@pytest.mark.parametrize("time", [7.5, 10.0, 23.0])
def test_decoders_agree_with_the_float64_path(time, device):
    """Beside tiles of video, with which they share a texture."""
    model = random_model(KINDS)
    decoder, runtime = Decoder(model, device), FrameDecoder(model, device, TileKind.VIDEO)
    assert runtime.numbers.tolist() == [0, 2, 3]
    light, (codes, bounds) = decoder.tiles([0, 1, 2, 3], time), decoder.tiles_8bit([0, 1, 2, 3], time)
    for number in (0, 2, 3):
        expected = decode_tile64(model, number, time)
        np.testing.assert_allclose(light[number], expected, rtol=0, atol=1e-5 * expected.max())
        assert abs(bounds[number] - bound64(model, number, time)) < 1e-6
        share = np.minimum(colour_tile64(model, number, time) / bounds[number], 1.0)
        assert np.abs(codes[number, ..., :3] / 255.0 - share).max() < 0.502 / 255.0
    runtime.set_time(time)
    runtime.decode()
    assert np.abs(runtime.numpy().astype(int) - codes[[0, 2, 3]]).max() <= (time != 7.5)
    assert [one.numbers.tolist() for one in MapDecoder(model, device).decoders] == [[1], [0, 2, 3]]


def test_each_channel_has_its_own_range():
    model = random_model((6, 0))
    colour = decode_tile64(model, 0, 7.5) ** (1 / model.profile.gamma)
    least, greatest = model.level_ranges[0, 1].astype(float)
    assert (colour.min((0, 1)) >= least - 1e-9).all() and (colour.max((0, 1)) <= greatest + 1e-9).all()
    assert np.ptp(least) > 0.01


def _levels(times: int, most: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(0, most, (times, 128, 128, 3)).astype(np.uint16)


_WHOLE = np.ones((128, 128), bool)
_SPARSE = np.random.default_rng(1).random((128, 128)) < 0.3
_ONE = np.zeros((128, 128), bool)
_ONE[77, 5] = True
_FIRST = np.zeros((128, 128), bool)
_FIRST[0, 0] = True


@pytest.mark.parametrize("valid", [_WHOLE, _SPARSE, _ONE, _FIRST], ids=["whole", "gaps", "one", "first"])
@pytest.mark.parametrize("most", [1, 2, 7, 1024])
def test_nothing_is_lost(valid, most):
    levels = _levels(2, most)
    levels[1, ..., 2] = 1023  # a channel that stands still, at the last level
    stream = code_levels(levels, valid)
    found = read_levels(np.frombuffer(stream, np.uint8), valid, 2)
    assert found.dtype == np.uint16 and found.max() <= 1023
    np.testing.assert_array_equal(found[:, valid], levels[:, valid])
    noise = np.log2(most) / 8 * (6 - 1) * valid.sum()
    assert len(stream) < 1.1 * noise + 4000, "what is noise takes its bits, and the lists of levels"


def test_what_is_like_its_neighbours_takes_few_bytes():
    y, x = np.mgrid[:128, :128]
    ramp = np.stack([x + y, 2 * x + y, 3 * (x + y)], 2)[None].repeat(3, 0).astype(np.uint16)
    assert len(code_levels(ramp[:1], _WHOLE)) < 128 * 128 * 3 / 20, "a twentieth of a byte for a number"
    assert len(code_levels(ramp, _WHOLE)) < 1.8 * len(code_levels(ramp[:1], _WHOLE)), "three times alike"


def test_damage_is_a_value_error_or_other_levels():
    levels = _levels(1, 60)
    stream = np.frombuffer(code_levels(levels, _SPARSE), np.uint8)
    longer = np.append(stream, np.uint8(0)), np.append(stream[:1], stream)
    for changed in (stream[: len(stream) // 2], stream[:1], stream[:0], *longer):
        with pytest.raises(ValueError, match="expected"):
            read_levels(changed, _SPARSE, 1)
    with pytest.raises(ValueError, match="first byte of 0"):
        read_levels(np.append(np.uint8(3), stream[1:]), _SPARSE, 1)
    refused = 0
    for at in range(1, 200, 7):
        changed = stream.copy()
        changed[at] ^= 255
        try:
            assert read_levels(changed, _SPARSE, 1).max() < 1024
        except ValueError:
            refused += 1
    assert refused > 20


def test_what_is_written_comes_back(tmp_path):
    mask = np.random.default_rng(3).random((236, 247)) < 0.4
    few = {"times": (3.0, 9.0)}
    for model in (random_model((6, 5), **few), random_model((6, 6, 6, 0), mask=mask, **few), random_model((0, 6))):
        check_written(model, tmp_path / "a.wlm")


def _changed(tmp_path, **tensors) -> str:
    return error_of_changed(random_model((6, 0, 6), columns=3, times=(0.0, 7.5)), tmp_path, **tensors)


def test_damage_is_one_line(tmp_path):
    assert "part level_sizes is uint32 (1,), expected uint32 (2)" in _changed(tmp_path, level_sizes=lambda v: v[:1])
    assert "part level_sizes: expected those of 2 tiles" in _changed(tmp_path, level_sizes=lambda v: v + v)
    assert "part level_sizes: expected those of 2 tiles" in _changed(tmp_path, levels=lambda v: v[:-1])
    line = _changed(tmp_path, level_sizes=lambda v: v + np.array([1, 2**32 - 1], v.dtype))
    assert "part levels: tile 0: expected" in line
    assert "part levels: tile 0: expected a first byte" in _changed(tmp_path, levels=lambda v: v | 1)
    line = _changed(tmp_path, level_ranges=lambda v: v[:, :, ::-1])
    assert "part level_ranges: expected no least above its greatest" in line
    assert "part level_ranges: expected numbers of at least 0" in _changed(tmp_path, level_ranges=lambda v: v - 2)


def test_a_small_file_makes_no_large_memory():
    kind, mask = np.full(128, TileKind.LEVELS, np.uint8), np.ones((1024, 2048), bool)
    with pytest.raises(WlmError, match="part levels: expected at most 4096 times its 128 bytes"):
        unpack_levels(np.zeros(128, np.uint8), np.ones(128, np.uint32), kind, mask, 32)


def _ground(spread: float = 0.02) -> np.ndarray:
    """A flat ground of one hue, in half floats, day and night: few levels in each channel, far from the others'."""
    noise = np.random.default_rng(0).normal(0.0, 0.1, (128, 128, 3)).cumsum(0)
    noise = 0.5 + 0.1 * (noise - noise.mean()) / noise.std()
    day = np.array([0.58, 0.99, 1.28]) * (1.0 + spread * np.clip(noise, 0.0, 1.0))
    return np.stack([day, 3.0 * day[..., ::-1]]).astype(np.float16).astype(np.float32)


def test_a_tile_of_few_levels_is_better_than_plain_bytes_at_fewer():
    light = from_arrays(_ground(), [0.0, 12.0], period=24.0, name="ground")
    model = compress(light, "levels")
    found = wlm.lightmap.evaluate(model, light, metrics=("psnr", "flip"))
    [(_, plain)] = evaluate_rivals(model, light, ["8bit"], metrics=("psnr", "flip"), views=0)
    assert found.psnr > 95.0 and found.psnr > plain.psnr + 5.0 and found.flip <= plain.flip
    assert found.bytes < 0.75 * plain.disk_bytes
    assert memory_bytes(model) == 2 * (4 * 128 * 128 + 12) + 1


@pytest.fixture(scope="module")
def hours():
    """Baked light: two hours of a tile of the demo's city."""
    day = wlm.lightmap.load(DEMO)
    chosen = [9, 12]
    return from_arrays(day.frames[chosen, :128, :128], day.times[chosen], day.mask[:128, :128], 24.0, name="two")


def _reached(light, **settings) -> tuple[dict[str, int], float, int]:
    model = compress(light, "video", video_speed=8, **settings)
    report = wlm.lightmap.evaluate(model, light, metrics=("psnr",))
    return count_kinds(model), report.psnr, report.bytes


def test_each_quality_is_better_and_larger(hours):
    found = [_reached(hours, video_quality=quality) for quality in sorted(STEPS)]
    assert all(kinds["levels"] == 1 and kinds["video"] == 0 for kinds, _, _ in found)
    gains = np.diff([psnr for _, psnr, _ in found])
    assert (gains[:3] > 2.0).all() and (gains > 0.5).all() and (gains[:3] < 4.0).all()
    assert (np.diff([size for _, _, size in found]) > 0).all()


def test_they_take_the_place_of_av1_where_they_are_no_worse(hours, monkeypatch):
    kinds, psnr, size = _reached(hours, video_quality=100)
    low, *_ = _reached(hours, video_quality=60)
    assert kinds["levels"] == 1 and low["video"] == 1, "AV1 is far ahead where much may be lost"
    monkeypatch.setattr(video, "_DEAR", 1e9)
    kinds, av1_psnr, av1_size = _reached(hours, video_quality=100)
    assert kinds["video"] == 1 and psnr >= av1_psnr and size < av1_size
    monkeypatch.setattr(video, "_DEAR", 0.0)
    assert _reached(hours, video_quality=60)[0] == low, "more bytes than AV1 are never chosen"


def test_each_tile_has_what_takes_fewer_bytes(monkeypatch):
    """A rough wall beside smooth light: neither form is best for both."""
    rough, smooth = moving_light(hours=(6.0, 12.0)).frames, np.empty((2, 128, 128, 3))
    y, x = np.mgrid[:128, :128] / 128.0
    for i, hour in enumerate((6.0, 12.0)):
        smooth[i] = (1.2 + np.sin(4.0 * x + hour) * np.cos(3.0 * y))[..., None] * [1.0, 0.8, 0.6]
    light = from_arrays(np.concatenate([rough, smooth], 2), (6.0, 12.0), period=24.0, name="both")
    kinds, psnr, size = _reached(light, video_quality=97)
    assert kinds["levels"] == kinds["video"] == 1
    assert compress(light, "video", video_quality=97, video_speed=8).kind.tolist() == [TileKind.LEVELS, TileKind.VIDEO]
    monkeypatch.setattr(video, "_DEAR", np.inf)
    _, av1_psnr, av1_size = _reached(light, video_quality=97)
    assert size < av1_size and psnr > av1_psnr - 0.1


def test_the_steps_are_the_same_share_in_all_channels():
    rng = np.random.default_rng(0)
    colour = (rng.random((1, 128, 128, 3)) * [1.0, 0.25, 0.0] + [0.0, 0.5, 0.25]).astype(np.float32)
    levels, ranges = quantise(colour, np.ones((128, 128), bool), 100.0)
    counts = [len(np.unique(levels[..., channel])) for channel in range(3)]
    assert counts[0] == pytest.approx(101, abs=1) and counts[1] == pytest.approx(26, abs=1) and counts[2] == 1
    error = np.abs(decoded(levels, ranges) - colour).max((0, 1, 2))
    assert (error <= [0.0056, 0.0056, 1e-6]).all()


def test_steps_for_a_psnr():
    colour = (moving_light(hours=(6.0, 12.0)).frames ** (1 / 2.2)).astype(np.float32)
    valid = np.ones((128, 128), bool)
    steps = steps_for(colour, valid, 2.2, 62.0)
    assert 62.0 <= tile_psnr(colour, valid, 2.2, steps) < 63.0
    assert steps_for(colour, valid, 2.2, 119.0) == np.inf
    assert steps_for(colour, valid, 2.2, np.nan) == steps_for(colour, valid, 2.2, 3.0), "without a score: the least"


def test_hard_cases(tmp_path):
    """A black hour, a channel that is zero, a firefly, a light that stands still, and too few texels for a score."""
    frames = moving_light(256, 128, hours=(0.0, 6.0, 12.0)).frames
    frames[0] = 0.0
    frames[:, :128, :, 2] = 0.0
    frames[1, 3, 3] = 1e4
    frames[2, :, :, 1] = 0.25
    mask = np.ones((256, 128), bool)
    mask[128:] = False
    mask[140, 10:40] = True
    light = from_arrays(frames, (0.0, 6.0, 12.0), mask, 24.0, name="hard")
    for quality in (100, 101, 105):
        model = compress(light, "video", video_quality=quality, video_speed=10)
        model.save(tmp_path / "a.wlm")
        found = wlm.load(tmp_path / "a.wlm").decoder()
        assert np.abs(found.frame(0.0)[mask]).max() == 0.0
        assert found.frame(6.0)[3, 3, :2] == pytest.approx(1e4, rel=2e-3)
        np.testing.assert_allclose(found.frame(12.0)[mask], frames[2][mask], atol=0.01, rtol=0.02)
    assert model.kind.tolist() == [6, 6]


def test_it_needs_no_package(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    light = moving_light(hours=(6.0,))
    compress(light, "levels").save(tmp_path / "a.wlm")
    assert wlm.lightmap.evaluate(wlm.load(tmp_path / "a.wlm"), light, metrics=("psnr",)).psnr > 65.0


def test_the_quality_is_chosen(hours):
    settings = Profile.load("video").override({"video_speed": 10})
    light = from_arrays(hours.frames[:1], [9.0], hours.mask)
    high = choose(light, settings, target_psnr=66.0)
    assert high.profile.video_quality in STEPS and high.psnr >= 66.0
    room = choose(light, settings, max_bpp=1.02 * high.bpp)
    assert room.profile.video_quality == high.profile.video_quality and room.bpp == high.bpp
    assert choose(light, settings, max_bpp=100.0).profile.video_quality == max(STEPS)


def test_info_says_why(hours):
    assert [tile.why for tile in held_tiles(compress(hours, "levels"))] == ["the setting video_quality is 105"]
    model = compress(hours, "video", video_quality=100, video_speed=10)
    [tile] = held_tiles(model)
    assert tile.why == "no worse than AV1 of quality 100, in fewer bytes" and tile.bytes == len(model.levels)


def test_a_kept_file_decodes_as_when_it_was_written(device):
    """Three hours of one tile with gaps."""
    model = wlm.load(FILES / "lightmap-levels.wlm")
    with np.load(FILES / "lightmap-levels.npz") as stored:
        np.testing.assert_array_equal(model.words[0][:, ::8, ::8], stored["words"])
        np.testing.assert_allclose(model.decoder(device).frame(8.25)[::4, ::4], stored["frame"], rtol=1e-5)
    assert model.kind.tolist() == [TileKind.LEVELS]
