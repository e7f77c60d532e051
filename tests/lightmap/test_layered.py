"""Layers and atlases in one file: what is fitted, stored, decoded, scored and exported."""

import json

import numpy as np
import pytest
from builders.checks import assert_same, error_of
from builders.layered_sets import SHEETS, random_layers, small_layers, turning_directions
from builders.resigned import GONE, rewrite
from builders.running import report_always
from builders.shader_runs import read_dds_levels
from builders.small_sets import HOURS, tiny_profile
from builders.synthetic import random_model
from wlm.lightmap.layers import codec
from wlm.lightmap.layers.data import LayerArrays, from_layers
from wlm.lightmap.layers.model import LayeredModel

import wlm
from wlm.export.page.pages import make_page
from wlm.formats.artifact import read_artifact
from wlm.formats.checkpoint import Pace
from wlm.formats.exr import read_exr
from wlm.lightmap import survey
from wlm.lightmap.tiles import TileKind


@pytest.fixture(scope="module")
def fitted():
    """A set of three layers and a model of it: networks of a moment."""
    lightmaps = small_layers(hours=HOURS[:3])
    return lightmaps, wlm.lightmap.compress(lightmaps, tiny_profile(steps=200, samples=256))


def directions_set(frames: np.ndarray, hours=HOURS, **options):
    return from_layers([LayerArrays(frames, "dir", encoding="signed")], hours, period=24.0, **options)


def test_what_is_written_comes_back(tmp_path):
    model = random_layers()
    size = model.save(tmp_path / "a.wlm")
    assert size == (tmp_path / "a.wlm").stat().st_size == model.file_bytes()
    back = wlm.load(tmp_path / "a.wlm")
    assert (back.name, back.source, tuple(back.sheets)) == (model.name, model.source, SHEETS)
    for sheet in SHEETS:
        assert_same(back.sheets[sheet], model.sheets[sheet])
    masks = [own.mask for own in back.sheets.values()]
    assert masks[0] is masks[1] is masks[2], "an atlas has one mask"
    names = list(read_artifact(tmp_path / "a.wlm").tensors)
    assert [name for name in names if "mask" in name or "times" in name] == ["times", "0.mask"]
    assert back.save(tmp_path / "b.wlm") == size
    assert (tmp_path / "a.wlm").read_bytes() == (tmp_path / "b.wlm").read_bytes()


def test_files_that_claim_too_much_are_one_line(tmp_path):
    path = tmp_path / "a.wlm"

    def refused(settings, tensors, words):
        random_layers().save(path)
        rewrite(path, settings, tensors)
        text = error_of(wlm.load, path)
        assert text.startswith(str(path)) and words in text, text

    random_layers().save(path)
    stored = read_artifact(path)
    sheets = stored.settings["sheets"]

    def changed(number, **values):
        return {"sheets": [item | values if i == number else item for i, item in enumerate(sheets)]}

    large = [item | {"settings": item["settings"] | {"size": [16384, 16384]}} for item in sheets]
    refused({"sheets": large}, {}, "at most 268435456 texels of all sheets, found 1073741824")
    refused({"sheets": sheets[:1] * 2000}, {}, "setting sheets")
    refused({"sheets": [*sheets, sheets[0]]}, {}, "each of them once")
    refused({"sheets": sheets[:3]}, {}, "part 3.")
    refused(changed(2, channels=["G"]), {}, "each channel of a layer once")
    refused(changed(1, settings=sheets[1]["settings"] | {"size": [119, 107]}), {}, "expected one size")
    refused(changed(1, encoding="srgb"), {}, "setting sheets.1.encoding")
    refused(changed(1, settings=sheets[1]["settings"] | {"period": 30.0}), {}, "expected one period")
    refused({}, {"1.mask": stored.tensors["0.mask"]}, "part 1.mask: expected it with sheet 0")
    refused({}, {"00.kind": stored.tensors["0.kind"]}, "part 00.kind is none of the file's")
    refused({}, {"0.times": stored.tensors["times"], "times": GONE}, "times")


def test_video_of_all_sheets_together_is_bounded(tmp_path, monkeypatch):
    model = LayeredModel("video", "0123456789abcdef", {SHEETS[i]: random_model((5,), 1, seed=i) for i in (0, 3)})
    model.save(tmp_path / "a.wlm")
    assert len(wlm.load(tmp_path / "a.wlm").sheets) == 2
    monkeypatch.setattr(codec, "VIDEO_GROWTH", 1)
    monkeypatch.setattr(codec, "VIDEO_BYTES", 300_000)
    text = error_of(wlm.load, tmp_path / "a.wlm")
    assert "the file's video and levels: expected at most" in text
    assert "found a size of 524288" in text, "of either 262,144"


def test_signed_values_keep_their_sign(fitted):
    _, model = fitted
    decoder = model.decoder()
    original = turning_directions(hours=HOURS[:3])
    decoded = np.stack([decoder.layer(hour, "dir") for hour in HOURS[:3]])
    assert decoded.shape == original.shape and decoded.min() < -0.8
    assert np.sqrt(np.square(decoded - original).mean()) < 0.06
    # Half-way between two hours the values are mixed, not their levels in a gamma space.
    middle = decoder.layer((HOURS[1] + HOURS[2]) / 2, "dir")
    ends = decoder.layer(HOURS[1], "dir") + decoder.layer(HOURS[2], "dir")
    np.testing.assert_allclose(middle, ends / 2, atol=1e-5)
    everything = decoder.frame(HOURS[0])
    assert list(everything) == ["0"] and list(everything["0"]) == ["light", "dir", "shadow"]
    np.testing.assert_array_equal(everything["0"]["dir"], decoder.layer(HOURS[0], "dir", "0"))
    assert "expected one of 0/light, 0/dir, 0/shadow, got 1/any layer" in error_of(decoder.layer, 0.0, atlas="1")


def test_zero_and_equal_channels_cost_no_error(fitted):
    lightmaps, model = fitted
    shadow = model.decoder().layer(HOURS[2], "shadow")
    assert not shadow[..., 0].any(), "a channel of zeros is one of zeros"
    original = list(lightmaps.sheets.values())[2].frames[2]
    assert np.abs(shadow - original).mean() < 0.04
    # Zero and other constants of a signed layer are half the range and more, and no network's affair.
    frames = np.zeros((2, 128, 256, 5), np.float32)
    frames[..., 3] = -1.0
    frames[:, :, 128:, 4] = turning_directions(128, 128, (0.0, 5.0))[..., 0]
    model = wlm.lightmap.compress(directions_set(frames, (0.0, 5.0)), tiny_profile())
    first, second = model.sheets.values()
    assert first.kind.tolist() == [TileKind.CONSTANT] * 2 and second.kind.tolist() == [1, 3]
    decoded = model.decoder().layer(2.5)
    assert not decoded[..., :3].any() and (decoded[:, :128] == [0, 0, 0, -1, 0]).all()


def test_levels_of_8_bits_that_flicker_are_constant_and_others_are_not():
    """A tile of one value and its neighbour, and one with a single texel that means something."""
    levels = np.full((1, 128, 256, 3), 128.0) + np.random.default_rng(0).integers(0, 2, (1, 128, 256, 3))
    levels[0, 5, 200] = 200.0
    layer = LayerArrays(levels / 255.0, "dir", encoding="unit")
    model = wlm.lightmap.compress(from_layers([layer], [0.0]), tiny_profile())
    (own,) = model.sheets.values()
    assert own.kind.tolist() == [TileKind.CONSTANT, TileKind.STATIC]
    assert np.abs(model.decoder().layer(0.0)[:, :128] - 128.5 / 255.0).max() < 1e-3


def test_scores_are_relative_to_the_encodings_range(fitted, tmp_path):
    lightmaps, model = fitted
    report = wlm.lightmap.evaluate(model, lightmaps)
    hours = HOURS[:3]
    decoder, original = model.decoder(), turning_directions(hours=hours)
    light, directions, _ = report.sheets.values()
    # Of values in [-1, 1]: the peak is 2, wherever the tile's own values are.
    expected = [
        10 * np.log10(4.0 / np.square(decoder.layer(h, "dir") - o).mean()) for h, o in zip(hours, original, strict=True)
    ]
    np.testing.assert_allclose(directions.psnr_by_time, expected, atol=1e-3)
    assert report.psnr_by_layer["dir"] == pytest.approx(np.mean(expected), abs=1e-3)
    worst = max(np.abs(decoder.layer(h, "dir") - o).max() for h, o in zip(hours, original, strict=True))
    assert directions.max_abs_error == pytest.approx(worst, rel=1e-4)
    assert np.isnan(directions.flip) and 0 < light.flip < 1 and directions.views == 0
    assert min(directions.seen, directions.between) > 25 and not report.warnings
    size = model.save(tmp_path / "a.wlm")
    assert report.bytes == size > sum(own.bytes for own in report.sheets.values()) > 0.9 * size
    assert report.bpp == pytest.approx(8 * size / (128 * 128 * 3))
    text = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert text["sheets"][1]["layer"] == "dir" and text["sheets"][1]["psnr"] == pytest.approx(directions.psnr)
    other = from_layers([LayerArrays(original, "dir", encoding="unit")], hours, period=24.0, name="other")
    assert "expected the sheets of the file" in error_of(wlm.lightmap.evaluate, model, other)
    plain = next(iter(lightmaps.sheets.values()))
    assert "has layers, but this set has none" in error_of(wlm.lightmap.evaluate, model, plain)


def test_a_layer_of_light_alone_is_fitted_as_without_layers(tmp_path):
    lightmaps = next(iter(small_layers().sheets.values()))
    alone = wlm.lightmap.compress(lightmaps, tiny_profile())
    layered = from_layers([LayerArrays(lightmaps.frames)], lightmaps.times, period=24.0)
    (own,) = wlm.lightmap.compress(layered, tiny_profile()).sheets.values()
    for name, part in alone.parts.items():
        np.testing.assert_array_equal(own.parts[name], part)


@pytest.mark.parametrize("stage", ["sheet 2 of 3, tiles", "sheet 2 of 3"])
def test_a_stopped_fit_goes_on_in_its_sheet_to_the_same_bytes(stage, tmp_path, monkeypatch):
    report_always(monkeypatch)
    monkeypatch.setattr(survey, "_LOOK", 1)
    # Nothing is written before the fit is stopped.
    monkeypatch.setattr(Pace, "affordable", lambda self: False)
    data, profile, output = small_layers(40, 24), tiny_profile(steps=20), tmp_path / "part.wlm"
    stages = []
    wlm.lightmap.compress(data, profile, progress=lambda done: stages.append(done.stage)).save(tmp_path / "whole.wlm")
    assert {"sheet 1 of 3", "sheet 2 of 3", "sheet 3 of 3"} <= set(stages)

    def stop(progress):
        if progress.stage == stage and progress.done:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        checkpoint = wlm.lightmap.open_checkpoint(output, data, profile)
        wlm.lightmap.compress(data, profile, progress=stop, checkpoint=checkpoint)
    checkpoint = wlm.lightmap.open_checkpoint(output, data, profile, resume=True)
    stages.clear()
    wlm.lightmap.compress(data, profile, progress=lambda done: stages.append(done.stage), checkpoint=checkpoint).save(
        output
    )
    assert checkpoint.resumed and "sheet 1 of 3" not in stages, "the first sheet isn't fitted again"
    assert output.read_bytes() == (tmp_path / "whole.wlm").read_bytes()


def test_an_export_has_a_folder_for_each_sheet(tmp_path):
    folder = tmp_path / "engine"
    model = random_layers()
    written = wlm.lightmap.export(model, folder)
    index = json.loads((folder / "sheets.json").read_text())
    assert written[-1] == folder / "sheets.json" and {path for path in folder.rglob("*") if path.is_file()} == {
        *written
    }
    assert [(item["layer"], item["channels"]) for item in index["sheets"]] == [
        (sheet.layer, list(sheet.channels)) for sheet in SHEETS
    ]
    light, directions = (folder / item["folder"] for item in index["sheets"][:2])
    assert (index["sheets"][1]["least"], index["sheets"][1]["greatest"]) == (-1.0, 1.0)
    shader = (directions / "decode.glsl").read_text()
    assert "return vec3(-1.0, -1.0, -1.0) + 2.0 * wlm_colour(texel);" in shader and "wlm_radiance" not in shader
    assert "wlm_radiance" in (light / "decode.glsl").read_text()
    # By what the files say alone: a texel of the tile of frames, at the first time.
    document = json.loads((directions / "weights.json").read_text())
    (tile,) = document["tiles"]
    level = read_dds_levels(directions / "frames.dds")[0, ..., :3]
    colour = tile["least"][0] + level * (np.array(tile["greatest"][0]) - tile["least"][0])
    low, high = document["values"]
    frame = read_exr(directions / "frame.exr")[0]
    valid = model.sheets[SHEETS[1]].mask
    np.testing.assert_allclose(frame[valid], (low + (high - low) * colour)[:108, :119][valid], atol=1e-5)
    np.testing.assert_allclose(frame, model.decoder().layer(0.0, "dir")[..., :3], atol=1e-6)

    (folder / "notes.txt").write_text("mine")
    model.sheets = dict(list(model.sheets.items())[:1])
    assert set(wlm.lightmap.export(model, folder)) == {path for path in written if "sheet_00" in str(path)} | {
        written[-1]
    }
    assert sorted(path.name for path in folder.iterdir()) == ["notes.txt", "sheet_00", "sheets.json"]
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    assert "expected an empty folder" in error_of(wlm.lightmap.export, model, tmp_path / "mine")


def test_a_page_shows_the_first_light_and_says_so(tmp_path):
    random_layers().save(tmp_path / "a.wlm")
    page = make_page([tmp_path / "a.wlm"])
    assert "a/light RGB" in page.note and "3 other sheets" in page.note
    assert (page.manifest["width"], page.manifest["height"]) == (119, 108)
    model = random_layers()
    model.sheets = {sheet: model.sheets[sheet] for sheet in SHEETS[:1]}
    model.save(tmp_path / "b.wlm")
    assert make_page([tmp_path / "b.wlm"]).note.endswith("Shown is a/light RGB.")
