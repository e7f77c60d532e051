"""Tiles stored as video: what they decode to, what their streams may be, and what they are worth."""

import dataclasses
import io
import sys
from pathlib import Path

import imagecodecs
import numpy as np
import pytest
from builders.checks import error_of
from builders.small_sets import moving_light
from builders.synthetic import random_model
from builders.words import check_written, error_of_changed
from PIL import Image

import wlm
from wlm.errors import WlmError
from wlm.formats import av1
from wlm.lightmap import video
from wlm.lightmap.data import from_arrays
from wlm.lightmap.decode import Decoder
from wlm.lightmap.evaluation import count_kinds, memory_bytes
from wlm.lightmap.exact import bound64, colour_tile64, decode_tile64
from wlm.lightmap.fit import compress
from wlm.lightmap.gaps import Gaps
from wlm.lightmap.model import Profile
from wlm.lightmap.rate import choose
from wlm.lightmap.runtime import FrameDecoder
from wlm.lightmap.tiles import TileKind
from wlm.lightmap.video import encode_levels
from wlm.lightmap.video_packing import decode_levels, levels_of, pages, unpack_video

DEMO = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"
FILES = Path(__file__).resolve().parents[1] / "files"
KINDS = (5, 4, 1, 5)
TIMES = (7.5, 10.0, 23.0)


@pytest.fixture
def av1_alone(monkeypatch):
    """No tile is stored as levels instead."""
    monkeypatch.setattr(video, "_DEAR", np.inf)


@pytest.mark.parametrize("interpolation", ["radiance", "network"])
def test_decoders_agree_with_the_float64_path(interpolation, device):
    model = random_model(KINDS, interpolation=interpolation)
    decoder, runtime = Decoder(model, device), FrameDecoder(model, device, TileKind.VIDEO)
    assert runtime.numbers.tolist() == [0, 3]
    for time in TIMES:
        light, (codes, bounds) = decoder.tiles([0, 1, 3], time), decoder.tiles_8bit([0, 1, 3], time)
        for place, number in ((0, 0), (2, 3)):
            expected = decode_tile64(model, number, time)
            np.testing.assert_allclose(light[place], expected, rtol=0, atol=1e-5 * expected.max())
            assert abs(bounds[place] - bound64(model, number, time)) < 1e-6
            share = np.minimum(colour_tile64(model, number, time) / bounds[place], 1.0)
            assert np.abs(codes[place, ..., :3] / 255.0 - share).max() < 0.502 / 255.0
            assert (codes[place, ..., 3] == 255).all()
        runtime.set_time(time)
        runtime.decode()
        assert np.abs(runtime.numpy().astype(int) - codes[[0, 2]]).max() <= (time != 7.5)
        np.testing.assert_array_equal(runtime.bounds, bounds[[0, 2]])
    with pytest.raises(WlmError, match="expected at least one tile of video or levels, found none"):
        FrameDecoder(random_model((3, 0)), device, TileKind.VIDEO)


def test_a_bound_is_the_greatest_of_its_time(av1_alone):
    """Not that of the range, which may be of all times: dark hours keep their 8 bits."""
    lightmaps = moving_light(hours=(6.0, 12.0))
    lightmaps.frames[1] *= 1e-2
    model = compress(lightmaps, "video", video_speed=10)
    wide = np.broadcast_to(model.video_ranges[:, :1], model.video_ranges.shape)
    model = dataclasses.replace(model, video_ranges=np.ascontiguousarray(wide))
    levels = levels_of(model.words[0, 1]).max() / 1023.0
    least, greatest = model.video_ranges[0, 1].astype(float)
    assert bound64(model, 0, 12.0) == pytest.approx(least + levels * (greatest - least), rel=1e-6)
    assert bound64(model, 0, 8.0) == max(bound64(model, 0, 6.0), bound64(model, 0, 12.0))


def test_gaps_are_filled_as_everywhere(device):
    mask = np.zeros((108, 119), bool)
    mask[20:60, 30:90] = True
    decoder = Decoder(random_model((5,), columns=1, mask=mask), device)
    frame, gaps = decoder.frame(9.0), Gaps.of(mask)
    assert np.array_equal(frame[tuple(gaps.target.T)], frame[tuple(gaps.source.T)])


def test_pages_hold_the_tiles_of_video_alone():
    kind = np.zeros((10, 11), np.uint8)
    kind[[1, 2, 3, 9], [2, 5, 9, 3]] = TileKind.VIDEO
    kind[0, 0] = kind[9, 10] = TileKind.FRAMES
    laid = pages(kind.ravel(), 11, 26)
    assert [page.numbers.tolist() for page in laid] == [[13, 27], [42], [102]]
    assert laid[0].places.tolist() == [[0, 0], [1, 3]] and laid[0].shape == (256, 512)
    assert laid[1].shape == laid[2].shape == (128, 128)
    # Of many times the pages are small.
    assert [page.numbers.tolist() for page in pages(kind.ravel(), 11, 200)] == [[13], [27], [42], [102]]
    assert pages(kind.ravel() * 0, 11, 26) == []


def test_levels_come_back_exactly_but_for_the_change_of_colours():
    levels = np.random.default_rng(0).random((2, 128, 128, 3)).astype(np.float32)
    levels[:, :, 64:] = levels[:, :, 64:, :1]
    found = decode_levels(encode_levels(levels, 100, 10), 2, 128, 128).astype(int)
    off = np.abs(found - levels * 1023.0)
    # Three planes in whole numbers: three halves off at most; grey is one plane.
    assert off.max() <= 1.51 and off[:, :, 64:].max() < 0.51
    assert (np.ptp(found[:, :, 64:], axis=3) == 0).all()


def test_a_stream_depends_on_its_pictures_alone_and_another_decoder_reads_it(monkeypatch):
    """imagecodecs' planes against Pillow's, in 8 bits."""
    levels = np.linspace(0, 1023, 128 * 128 * 3).astype(np.uint16).reshape(1, 128, 128, 3).repeat(3, 0)
    levels[1] //= 2
    stream = av1.encode_av1(levels, 90, 10, "video")
    assert stream == av1.encode_av1(levels, 90, 10, "video") and b"mvhd" not in stream
    boxed = []
    original = imagecodecs.avif_decode
    monkeypatch.setattr(imagecodecs, "avif_decode", lambda data: boxed.append(data) or original(data))
    planes = av1.decode_av1(stream, 3, 128, 128, "video")
    image = Image.open(io.BytesIO(boxed[0]))
    assert image.n_frames == 3 and image.size == (128, 128)
    for i in range(3):
        image.seek(i)
        red, green, blue = np.moveaxis(np.asarray(image.convert("RGB")).astype(int), 2, 0)
        assert np.abs(np.stack([green, blue, red], 2) - planes[i] / 1023 * 255).max() <= 1.0


def test_what_is_written_comes_back(tmp_path):
    for model in (random_model(KINDS), random_model((5,) * 6, columns=3), random_model((5, 0), times=(3.0,))):
        check_written(model, tmp_path / "a.wlm")


def _changed(tmp_path, **tensors) -> str:
    return error_of_changed(random_model((5, 0, 5), columns=3, times=(0.0, 7.5)), tmp_path, **tensors)


def test_damage_is_one_line(tmp_path):
    def flipped(stream):
        stream[len(stream) // 2 :] ^= 255
        return stream

    assert "part video_sizes: expected those of 1 pages" in _changed(tmp_path, video_sizes=lambda v: v.repeat(2))
    assert "part video_sizes: expected those of 1 pages" in _changed(tmp_path, video=lambda v: v[:-1])
    assert "part video_sizes: " in _changed(tmp_path, video_sizes=lambda v: np.zeros(0, np.uint32))
    assert "part video: page 0: AV1: " in _changed(tmp_path, video=lambda v: v ^ 255)
    assert "part video: page 0: " in _changed(tmp_path, video=flipped)
    assert "part video_ranges: expected no least above its gre" in _changed(
        tmp_path, video_ranges=lambda v: v[..., ::-1]
    )
    assert "part video_ranges: expected numbers of at least 0" in _changed(tmp_path, video_ranges=lambda v: v - 2)
    # A stream of fewer pictures, of a smaller page, and of another kind.
    for shape, text in (((1, 128, 384), "expected 2 pictures, found 1"), ((2, 128, 128), "found 128x128")):
        other = np.frombuffer(encode_levels(np.zeros((*shape, 3), np.float32), 50, 10), np.uint8)
        sizes = np.array([len(other)], np.uint32)
        line = _changed(tmp_path, video=lambda v, other=other: other, video_sizes=lambda v, sizes=sizes: sizes)
        assert text in line


def test_a_stream_asks_for_no_more_than_its_pictures():
    stream = encode_levels(np.zeros((3, 128, 128, 3), np.float32), 50, 10)
    units, header = av1._units(stream)
    sizes = [len(unit) for unit in units]
    assert len(units) == 3 and b"".join(units) == stream

    def refused(data: bytes, expected: str, count: int = 3) -> None:
        with pytest.raises(ValueError, match=expected):
            av1.decode_av1(data, count, 128, 128, "video")

    at = stream.index(header)
    # Bits 29 to 36 of the header are the lengths of width and height: longer ones leave room for other sizes.
    bits = int.from_bytes(header, "big")
    longer = (bits | 0xFF << 8 * len(header) - 37).to_bytes(len(header), "big")
    refused(stream[:at] + longer + stream[at + len(header) :], "expected pictures of 128x128")
    eight = bytes([header[0] & 0x1F]) + header[1:]
    refused(stream[:at] + eight + stream[at + len(header) :], "expected pictures of 128x128 in profile 1")
    second = stream[at - 2 : at] + longer
    refused(stream[: sizes[0]] + stream[:2] + second + stream[sizes[0] :], "two that differ", 4)
    refused(stream[2:], "expected units of frames")
    refused(stream[:2] + stream[at + len(header) :], "a sequence header first")
    refused(b"", "a sequence header, found none")
    refused(stream[:-1], "cut short")
    refused(stream + bytes([1]), "blocks with their sizes")
    refused(stream[: sizes[0]] + stream[sizes[0] : sizes[0] + 2] * 2, "AV1: ")  # units without a picture


def test_a_small_file_makes_no_large_memory():
    kind = np.zeros((8, 16), np.uint8)
    kind[[0, 7, 0, 7], [0, 7, 8, 15]] = TileKind.VIDEO
    with pytest.raises(WlmError, match="part video: expected at most 4096 times its 100 bytes"):
        unpack_video(np.zeros(100, np.uint8), np.array([60, 40], np.uint32), kind.ravel(), 16, 32)


@pytest.fixture(scope="module")
def few_hours():
    """Baked light: four hours of the demo's city."""
    day = wlm.lightmap.load(DEMO)
    return from_arrays(day.frames[[9, 11, 12, 20]], day.times[[9, 11, 12, 20]], day.mask, 24.0, name="four")


def test_it_is_better_than_blocks_in_fewer_bytes(few_hours, av1_alone, tmp_path):
    model, frames = compress(few_hours, "video", video_speed=6), compress(few_hours, "frames")
    assert count_kinds(model)["video"] == 2 and memory_bytes(model) == 2 * 4 * (4 * 128 * 128 + 4) + 2
    model.save(tmp_path / "a.wlm")
    found, blocks = (
        wlm.lightmap.evaluate(each, few_hours, metrics=("psnr",)) for each in (wlm.load(tmp_path / "a.wlm"), frames)
    )
    assert found.psnr > blocks.psnr + 0.3 and found.bytes < 0.5 * blocks.bytes


def test_the_ranges_are_those_that_are_worth_more(av1_alone):
    """Of all times where hours are alike; of each where they differ much."""
    alike = moving_light(hours=(6.0, 7.0, 8.0))
    model = compress(alike, "video", video_speed=6)
    assert (model.video_ranges == model.video_ranges[:, :1]).all()
    differing = dataclasses.replace(alike, frames=alike.frames * np.array([1.0, 1e-3, 1.0])[:, None, None, None])
    model = compress(differing, "video", video_speed=6)
    assert (model.video_ranges[:, 1, 1] < 0.1 * model.video_ranges[:, 0, 1]).all()


def test_without_the_package_a_line_names_the_extra(monkeypatch, tmp_path):
    random_model((5, 0)).save(tmp_path / "a.wlm")
    monkeypatch.setitem(sys.modules, "imagecodecs", None)
    for call, argument in ((wlm.load, tmp_path / "a.wlm"), (lambda x: compress(x, "video"), moving_light())):
        assert "video: imagecodecs is missing; needs the extra: pip install 'wlm[video]'" in error_of(call, argument)


def test_a_kept_file_decodes_as_when_it_was_written(device):
    """Three hours of one tile with gaps."""
    model = wlm.load(FILES / "lightmap-video.wlm")
    with np.load(FILES / "lightmap-video.npz") as stored:
        np.testing.assert_array_equal(model.words[0, :, ::8, ::8], stored["levels"])
        np.testing.assert_allclose(model.decoder(device).frame(8.25)[::4, ::4], stored["frame"], rtol=1e-5)


def test_the_quality_is_chosen(few_hours, av1_alone):
    light = from_arrays(few_hours.frames[:2, :128], few_hours.times[:2], few_hours.mask[:128])
    settings = Profile.load("video").override({"video_speed": 9})

    def measured(profile):
        model = compress(light, profile)
        return wlm.lightmap.evaluate(model, light, metrics=("psnr",))

    choice = choose(light, settings, target_psnr=45.0)
    quality = choice.profile.video_quality
    assert choice.profile == settings.override({"video_quality": quality}) and not choice.limited
    found, below = (measured(settings.override({"video_quality": q})) for q in (quality, quality - 1))
    assert choice.psnr == found.psnr >= 45.0 > below.psnr and choice.bpp == found.bpp
    small = choose(light, settings, max_bpp=1.02 * choice.bpp)
    assert small.psnr is None and small.profile.video_quality >= quality
    assert measured(small.profile).bpp <= 1.02 * choice.bpp
    both = choose(light, settings, max_bpp=0.8 * choice.bpp, target_psnr=45.0)
    assert both.limited and both.psnr < 45.0 and both.bpp <= 0.8 * choice.bpp
    assert "--max-bpp: expected at least 0." in error_of(choose, light, settings, max_bpp=1e-3)
    assert "--target-psnr: expected at most " in error_of(choose, light, settings, target_psnr=119.0)
    constant = from_arrays(np.ones((1, 8, 8, 3), np.float32), [0.0])
    assert "no tile is more than a colour" in error_of(choose, constant, settings, max_bpp=1.0)


def test_the_number_of_threads_changes_nothing(monkeypatch):
    rng = np.random.default_rng(0)
    pictures = np.cumsum(rng.integers(-4, 5, (3, 256, 384, 3)), 2).astype(np.int64) % 1024
    streams = []
    for count in (1, 2, 5):
        monkeypatch.setattr(av1, "cores", lambda count=count: count)
        streams.append(av1.encode_av1(pictures.astype(np.uint16), 80, 8, "video"))
    assert streams[0] == streams[1] == streams[2]
