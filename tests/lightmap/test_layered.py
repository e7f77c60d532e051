"""Layers and atlases in one file: fits, files, decoders, scores and bundles."""

import json

import numpy as np
import pytest
from builders.checks import assert_same, error_of
from builders.layered_sets import SHEETS, random_layers, small_layers, turning_directions
from builders.resigned import GONE, error_of_changed
from builders.running import report_always
from builders.small_sets import HOURS, moving_light, tiny_profile

import wlm
from wlm.export.files import decode_texture
from wlm.export.page.pages import make_page
from wlm.formats.artifact import read_artifact
from wlm.formats.checkpoint import Pace
from wlm.lightmap import Layer, fit, from_layers
from wlm.lightmap.tiles import TileKind


@pytest.fixture(scope="module")
def fitted():
    """A set of three layers and a model of it."""
    lightmaps = small_layers(hours=HOURS[:3])
    return lightmaps, wlm.lightmap.compress(lightmaps, tiny_profile(steps=200, samples=256))


def directions_set(frames: np.ndarray, hours=HOURS, **options):
    return from_layers([Layer(frames, "dir", encoding="signed")], hours, period=24.0, **options)


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
    random_layers().save(path)
    stored = read_artifact(path)
    sheets = stored.settings["sheets"]

    def changed(number, **values):
        return {"sheets": [item | values if i == number else item for i, item in enumerate(sheets)]}

    for settings, tensors, words in (
        ({"sheets": [*sheets, sheets[0]]}, {}, "found one twice"),
        (changed(2, channels=["G"]), {}, "every channel once"),
        (changed(1, size=[119, 107]), {}, "texels, but others of its layer"),
        ({}, {"1.mask": stored.tensors["0.mask"]}, "part 1.mask: expected a mask only with the first sheet"),
        ({}, {"0.times": stored.tensors["times"], "times": GONE}, "times"),
    ):
        assert words in error_of_changed(random_layers(), path, settings, tensors)


def test_signed_values_keep_their_sign(fitted):
    _, model = fitted
    decoder = model.decoder()
    original = turning_directions(hours=HOURS[:3])
    decoded = np.stack([decoder.frame(hour, "dir") for hour in HOURS[:3]])
    assert decoded.shape == original.shape and decoded.min() < -0.8
    assert np.sqrt(np.square(decoded - original).mean()) < 0.06
    # Half-way between two hours the values are mixed, not their levels in a gamma space.
    middle = decoder.frame((HOURS[1] + HOURS[2]) / 2, "dir")
    ends = decoder.frame(HOURS[1], "dir") + decoder.frame(HOURS[2], "dir")
    np.testing.assert_allclose(middle, ends / 2, atol=1e-5)
    everything = decoder.frames(HOURS[0])
    assert list(everything) == ["0"] and list(everything["0"]) == ["light", "dir", "shadow"]
    np.testing.assert_array_equal(everything["0"]["dir"], decoder.frame(HOURS[0], "dir", "0"))
    assert "expected one of 0/light, 0/dir, 0/shadow, got 1/any layer" in error_of(decoder.frame, 0.0, atlas="1")


def test_zero_and_equal_channels_cost_no_error(fitted):
    lightmaps, model = fitted
    shadow = model.decoder().frame(HOURS[2], "shadow")
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
    decoded = model.decoder().frame(2.5)
    assert not decoded[..., :3].any() and (decoded[:, :128] == [0, 0, 0, -1, 0]).all()


def test_levels_of_8_bits_that_flicker_are_constant_and_others_are_not():
    """A tile of one value and its neighbour, and one with a single texel that means something."""
    levels = np.full((1, 128, 256, 3), 128.0) + np.random.default_rng(0).integers(0, 2, (1, 128, 256, 3))
    levels[0, 5, 200] = 200.0
    layer = Layer(levels / 255.0, "dir", encoding="unit")
    model = wlm.lightmap.compress(from_layers([layer], [0.0]), tiny_profile())
    (own,) = model.sheets.values()
    assert own.kind.tolist() == [TileKind.CONSTANT, TileKind.DYNAMIC]
    assert np.abs(model.decoder().frame(0.0)[:, :128] - 128.5 / 255.0).max() < 1e-3


def test_scores_are_relative_to_the_encodings_range(fitted, tmp_path):
    lightmaps, model = fitted
    report = wlm.lightmap.evaluate(model, lightmaps)
    hours = HOURS[:3]
    decoder, original = model.decoder(), turning_directions(hours=hours)
    light, directions, _ = report.sheets.values()
    # Of values in [-1, 1]: the peak is 2, wherever the tile's own values are.
    pairs = zip(hours, original, strict=True)
    expected = [10 * np.log10(4.0 / np.square(decoder.frame(h, "dir") - o).mean()) for h, o in pairs]
    np.testing.assert_allclose(directions.psnr_by_time, expected, atol=1e-3)
    worst = max(np.abs(decoder.frame(h, "dir") - o).max() for h, o in zip(hours, original, strict=True))
    assert directions.max_abs_error == pytest.approx(worst, rel=1e-4)
    assert np.isnan(directions.flip) and 0 < light.flip < 1 and directions.views == 0
    assert min(directions.seen, directions.between) > 25 and not report.warnings
    size = model.save(tmp_path / "a.wlm")
    assert report.bytes == size
    assert report.bpp == pytest.approx(8 * size / (128 * 128 * 3))
    text = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert text["sheets"][1]["layer"] == "dir" and text["sheets"][1]["psnr"] == pytest.approx(directions.psnr)
    other = from_layers([Layer(original, "dir", encoding="unit")], hours, period=24.0, name="other")
    assert "expected the same sheets as in the file" in error_of(wlm.lightmap.evaluate, model, other)


def test_a_layer_of_light_alone_is_fitted_as_without_layers(tmp_path):
    lightmaps = small_layers()
    light = lightmaps.light
    (alone,) = wlm.lightmap.compress(moving_light(), tiny_profile()).sheets.values()
    own = next(iter(wlm.lightmap.compress(lightmaps, tiny_profile()).sheets.values()))
    np.testing.assert_array_equal(light.frames, moving_light().light.frames)
    for name, part in alone.parts.items():
        np.testing.assert_array_equal(own.parts[name], part)


def test_a_stopped_fit_goes_on_in_its_sheet_to_the_same_bytes(tmp_path, monkeypatch):
    report_always(monkeypatch)
    monkeypatch.setattr(fit, "_LOOK", 1)
    # Nothing is written before the fit is stopped.
    monkeypatch.setattr(Pace, "affordable", lambda self: False)
    data, profile, output = small_layers(40, 24), tiny_profile(steps=20), tmp_path / "part.wlm"
    reports = []
    wlm.lightmap.compress(data, profile, progress=reports.append).save(tmp_path / "whole.wlm")
    assert {report.stage for report in reports} == {"tiles", "fit"}

    def stop(progress):
        if progress.stage == "fit" and progress.done > 25:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        checkpoint = wlm.lightmap.open_checkpoint(output, data, profile)
        wlm.lightmap.compress(data, profile, progress=stop, checkpoint=checkpoint)
    checkpoint = wlm.lightmap.open_checkpoint(output, data, profile, resume=True)
    reports.clear()
    wlm.lightmap.compress(data, profile, progress=reports.append, checkpoint=checkpoint).save(output)
    done = [report.done for report in reports if report.stage == "fit"]
    assert checkpoint.resumed and min(done) > 25, "the first sheet is not fitted again"
    assert output.read_bytes() == (tmp_path / "whole.wlm").read_bytes()


def test_a_bundle_has_a_part_for_each_sheet():
    model = random_layers()
    bundle = model.bundle()
    listed = bundle.document["sheets"]
    assert [(each["layer"], each["channels"]) for each in listed] == [(own.layer, list(own.channels)) for own in SHEETS]
    assert list(bundle.parts) == [item["part"] for item in listed] and not bundle.textures
    light, directions = (bundle.parts[item["part"]] for item in listed[:2])
    assert directions.document["values"] == [-1.0, 1.0]
    assert "return vec3(-1.0, -1.0, -1.0) + 2.0 * colour;" in directions.shader
    assert "wlm_radiance" not in directions.shader and "wlm_radiance" in light.shader
    # By the bundle alone: the texels of the tile of frames at the first time.
    (tile,) = directions.document["tiles"]
    level = decode_texture(directions.textures["frames"])[0, ..., :3] / 255.0
    colour = tile["least"][0] + level * (np.array(tile["greatest"][0]) - tile["least"][0])
    frame, valid = directions.reference["frame"], model.sheets[SHEETS[1]].mask
    np.testing.assert_allclose(frame[valid], (2.0 * colour - 1.0)[:108, :119][valid], atol=1e-5)
    np.testing.assert_allclose(frame, model.decoder().frame(0.0, "dir")[..., :3], atol=1e-6)
    model.sheets = dict(list(model.sheets.items())[:1])
    assert not model.bundle().parts


def test_a_page_shows_the_first_light_and_says_so(tmp_path):
    random_layers().save(tmp_path / "a.wlm")
    page = make_page([tmp_path / "a.wlm"])
    assert "a/light RGB" in page.note and "3 other sheets" in page.note
    assert (page.manifest["width"], page.manifest["height"]) == (119, 108)
    model = random_layers()
    model.sheets = {sheet: model.sheets[sheet] for sheet in SHEETS[:1]}
    model.save(tmp_path / "b.wlm")
    assert make_page([tmp_path / "b.wlm"]).note.endswith("Shown is a/light RGB.")
