"""The float64 path and tiles of frames, against the decoders and by hand."""

import dataclasses
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from builders.checks import error_of
from builders.resigned import error_of_changed
from builders.small_sets import moving_light, tiny_profile
from builders.synthetic import any_blocks, random_model, random_sheet

import wlm
from benchmarks.lightmap_exact import bound64, colour_tile64, decode_tile64
from benchmarks.rivals.lightmap import encode_set
from wlm.errors import WlmError
from wlm.lightmap.data import from_arrays
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.encodings.frames import choose_frames, round_half
from wlm.lightmap.encodings.maps import tile_bytes
from wlm.lightmap.evaluation import count_kinds
from wlm.lightmap.fit import compress, open_checkpoint
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.tiles import TileKind
from wlm.metrics import evaluate_frame, summarise

TIMES = (0.0, 7.5, 10.0, 21.7)


@pytest.mark.parametrize(
    "settings",
    [
        {"times": (3.0,)},
        {"period": None},
        {"time_axis": "paper", "period": None, "interpolation": "network"},
        {"uvt_slices": 1},
        {"hidden": 17, "time_axis": "paper"},
        {"kinds": (4, 3, 1, 4)},
        {"kinds": (4, 3, 1, 4), "interpolation": "network"},
    ],
    ids=str,
)
def test_the_decoder_agrees(settings, device):
    model = random_sheet(**settings)
    decoder = SheetDecoder(model, device)
    for time in TIMES:
        tiles = decoder.tiles(range(4), time)
        for number in range(4):
            expected = decode_tile64(model, number, time)
            # float32 arithmetic through two layers, and a power: 2e-6 measured.
            np.testing.assert_allclose(tiles[number], expected, rtol=0, atol=2e-5 * max(1.0, expected.max()))
            colour = colour_tile64(model, number, time)
            np.testing.assert_allclose(colour**2.2, expected, rtol=1e-9, atol=1e-12)


def test_what_is_not_there():
    model = random_sheet()
    assert "tile 4 is outside" in error_of(decode_tile64, model, 4, 0.0)
    assert "finite" in error_of(colour_tile64, model, 0, math.nan)
    assert not decode_tile64(model, 3, 1.0).any() and bound64(model, 3, 1.0) == 0.0


DEMO = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"


def test_half_floats_are_rounded_outwards():
    values = np.random.default_rng(0).lognormal(0.0, 2.0, 1000).astype(np.float32)
    low, high = round_half(values, -np.inf), round_half(values, np.inf)
    assert (low <= values).all() and (high >= values).all() and (np.nextafter(low, high) == high).mean() > 0.99


def test_damage_is_one_line(tmp_path):
    model, path = random_model((4, 4), times=(0.0, 7.5)), tmp_path / "a.wlm"
    for change, words in (
        (lambda v: v[:, :, ::-1], "part ranges: expected the least colour"),
        (lambda v: v - np.float16(2.0), "part ranges: expected numbers of at least 0"),
    ):
        assert words in error_of_changed(model, path, tensors={"0.ranges": change})


def test_what_a_file_must_not_contain(tmp_path):
    model = random_model((4, 0))
    sheet = model.sheets[LIGHT]
    frames = sheet.frames.copy()
    frames[0, 2, 3, 4, 0] = 0
    sheet.frames = frames
    assert "tile 0: expected BC7 blocks of modes 0 to 7, found a reserved mode" in error_of(model.save, tmp_path / "a")
    assert not (tmp_path / "a").exists()


@pytest.fixture(scope="module")
def two_hours():
    """Baked light: noon and evening of the demo's city."""
    day = wlm.lightmap.load(DEMO)
    light = day.light
    return from_arrays(light.frames[[12, 20]], light.times[[12, 20]], light.mask, 24.0, name="two")


def test_two_states_are_as_good_as_bc7_in_as_many_bytes(two_hours, tmp_path):
    model, light = compress(two_hours, "M"), two_hours.light
    kinds = count_kinds(model.sheets[LIGHT])
    assert sum(kinds.values()) == kinds["frames"] == 2
    assert model.warnings == () and model.memory_bytes == 2 * 2 * (16384 + 12) + 2
    model.save(tmp_path / "a.wlm")
    found = wlm.lightmap.evaluate(wlm.load(tmp_path / "a.wlm"), two_hours, metrics=("psnr",))
    rival, frames = encode_set(
        "bc7", light, lambda i, decoded: evaluate_frame(light.frames[i], decoded, light.mask, 128, ("psnr",))
    )
    assert found.psnr > summarise(frames).psnr and found.bytes < 1.04 * rival.disk_bytes


@pytest.mark.parametrize(
    ("count", "settings", "framed"),
    [
        (1, {}, True),
        (2, {}, True),
        (3, {}, False),
        (3, {"uvt_resolution": 64}, True),
        (1, {"frames": "never"}, False),
        (3, {"frames": "always"}, True),
    ],
)
def test_a_tile_is_frames_where_that_takes_no_more(count, settings, framed):
    profile = Profile.load("M").override(settings)
    assert choose_frames(np.array([TileKind.DYNAMIC]), count, profile).tolist() == [framed]
    assert "frames" in settings or framed == (count * 16384 < tile_bytes(profile))


def test_without_the_encoder_a_network_is_fitted_and_that_is_said(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ispc_texcomp", None)
    lightmaps = moving_light(hours=(6.0,))
    model = compress(lightmaps, tiny_profile(frames="auto"))
    assert count_kinds(model.sheets[LIGHT])["dynamic"] == 1
    assert len(model.warnings) == 1 and "1 tile would take" in model.warnings[0]
    assert "pip install 'wlm[frames]'" in model.warnings[0] and "\n" not in model.warnings[0]
    with pytest.raises(WlmError, match=r"^frames: ispc_texcomp is missing; needs the extra"):
        compress(lightmaps, "frames")
    # A fit goes on as it began.
    checkpoint = open_checkpoint(tmp_path / "a.wlm", lightmaps, tiny_profile(frames="auto"), every=0.0)
    compress(lightmaps, tiny_profile(frames="auto"), checkpoint=checkpoint)
    monkeypatch.undo()
    line = error_of(open_checkpoint, tmp_path / "a.wlm", lightmaps, tiny_profile(frames="auto"), resume=True)
    assert "profile" in line
    random_model((4, 0)).decoder().frame(3.0)  # reading needs no encoder


def test_any_block_may_lie_beside_any(device):
    """Texels of a map of blocks whose neighbours are of other modes are where they belong."""
    model = random_sheet((4,), columns=1, times=(0.0,), period=None)
    frames = any_blocks(1, 1, 32, 32, seed=9)
    light = SheetDecoder(dataclasses.replace(model, frames=frames), device).tiles([0], 0.0)[0]
    for y, x in ((0, 0), (3, 77), (101, 126)):
        one = np.broadcast_to(frames[:, :, y // 4, x // 4][:, :, None, None], frames.shape)
        alone = SheetDecoder(dataclasses.replace(model, frames=np.ascontiguousarray(one)), device).tiles([0], 0.0)[0]
        assert np.array_equal(alone[y % 4, x % 4], light[y, x])
