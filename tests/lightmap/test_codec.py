"""Files of lightmaps and packed tiles: what is saved comes back, and damage is one line."""

import dataclasses

import numpy as np
import pytest
import torch
from builders import small_sets
from builders.checks import assert_same, error_of
from builders.resigned import GONE, error_of_changed
from builders.synthetic import random_model, random_sheet
from reference.levels import put_on_levels

import wlm
from wlm.formats import zstd
from wlm.formats.artifact import read_artifact
from wlm.lightmap.encodings import encoding_of
from wlm.lightmap.encodings.maps import tile_bytes
from wlm.lightmap.model import PACKED, LightmapModel
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import LIGHT


@pytest.mark.parametrize("kinds", [(3, 3, 1, 0), (3, 3), (1, 1), (0, 0), (4, 3, 1, 4), (4, 0, 0, 0)])
@pytest.mark.parametrize(("period", "share"), [(24.0, None), (None, 0.4), (24.0, 0.01), (None, 0.0)])
def test_what_is_written_comes_back(tmp_path, kinds, period, share):
    """The share is that of the map's texels that are valid; None leaves the mask out."""
    shape = (-(-len(kinds) // 2) * 128 - 20, 247)
    mask = None if share is None else np.random.default_rng(0).random(shape) < share
    model = random_model(kinds, mask=mask, period=period, metric_weight=0.25, time_axis="paper")
    size = model.save(tmp_path / "a.wlm")
    assert size == (tmp_path / "a.wlm").stat().st_size == model.file_bytes()
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    assert ("0.tiles" in read_artifact(tmp_path / "a.wlm").parts) == (max(kinds) >= 2)


@pytest.mark.parametrize("times", [(0.0, 1e-9), (18.45, 18.55), (7.0,), (1e6, 1e6 + 1e-4)])
def test_times_come_back(tmp_path, times):
    model = random_model((3, 0), times=times, period=None)
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm").times
    assert back.tolist() == list(times)


def test_the_size_is_the_arithmetic_of_table_3(tmp_path):
    sizes = {"hidden": 16, "uvt_resolution": 32, "uvt_slices": 12}
    times = tuple(float(hour) for hour in range(24))
    tiles = 16
    model = random_model((3,) * tiles, columns=4, times=times, **sizes)
    profile = Profile(name="", **sizes)
    expected = tiles * tile_bytes(profile)
    assert sum(getattr(model.sheets[LIGHT], name).nbytes for name in PACKED) == expected
    # zstd can not shorten noise: the file is as large except for the bits that name the mode, and the scales.
    assert 0.93 < model.save(tmp_path / "a.wlm") / expected < 1.02
    # Table 3 of the paper: 34 KiB of maps for profile M.
    assert tile_bytes(profile) - random_sheet((3, 3), **sizes).net.nbytes // 2 == 34 * 1024


def _file_of(sheet) -> LightmapModel:
    return LightmapModel("random", "0123456789abcdef", sheet.profile, {LIGHT: sheet})


@pytest.mark.parametrize("part", ["uv", "uvt"])
def test_any_block_of_mode_6_comes_back(tmp_path, part):
    sheet = random_sheet((3, 0))
    words = np.random.default_rng(1).integers(0, 2**64, (*getattr(sheet, part).shape[:-1], 2), np.uint64)
    words[..., 0] = words[..., 0] & ~np.uint64(127) | np.uint64(64)
    model = _file_of(dataclasses.replace(sheet, **{part: words.view(np.uint8)}))
    model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    words[..., 0] |= np.uint64(1)
    other = _file_of(dataclasses.replace(sheet, **{part: words.view(np.uint8)}))
    assert "BC7 blocks of mode 6" in error_of(other.save, tmp_path / "b")
    assert not (tmp_path / "b").exists()


def _changed(tmp_path, **parts) -> str:
    """Returns the error of a file whose parts were replaced, when it is opened or when all its tiles are read."""
    changed = {f"0.{name}": change for name, change in parts.items()}
    return error_of_changed(random_model((3, 4, 1, 0)), tmp_path / "a.wlm", tensors=changed)


def test_damage_is_one_line(tmp_path):
    assert "part tiles: expected a piece for each of 2 tiles, found 3" in _changed(tmp_path, tiles=lambda v: [*v, b""])
    assert "part tiles: expected a piece for each of 2 tiles, found 0" in _changed(tmp_path, tiles=GONE)
    assert "expected the tiles alone as a split part" in _changed(tmp_path, tiles=np.zeros(9, np.uint8))
    assert "expected the tiles alone as a split part" in _changed(tmp_path, scale=[b"x"])
    assert "sheet random: tile 0: " in _changed(tmp_path, tiles=lambda tiles: [tiles[0][::-1], tiles[1]])
    assert "sheet random: tile 0: " in _changed(tmp_path, tiles=lambda tiles: tiles[::-1])
    assert "sheet random: tile 1: " in _changed(tmp_path, tiles=lambda tiles: [tiles[0], b""])
    line = "part kind: found a static tile of an earlier version: compress the input again"
    assert line in _changed(tmp_path, kind=np.array([3, 2, 1, 0], np.uint8))


@pytest.mark.parametrize("size", [10, 1 << 24])
def test_a_frame_of_another_length_is_one_line(tmp_path, size):
    line = _changed(tmp_path, tiles=lambda tiles: [zstd.compress(bytes(size)), tiles[1]])
    assert "a.wlm: sheet random: tile 0: the packed tile: expected a frame of " in line and f"found {size}" in line


def test_tiles_with_wrong_content_are_one_line(tmp_path):
    sheet = random_model((3, 4, 1, 0)).sheets[LIGHT]
    wrong = (0, 1, "maps: expected BC7 blocks of mode 6"), (-1, 0x7F, "expected finite numbers in the")
    for place, byte, words in wrong:
        content = bytearray(encoding_of(3).pack(sheet, 0))
        content[place] = byte
        content[-2] = 0xFF  # with the high byte a NaN
        line = _changed(tmp_path, tiles=lambda tiles, content=content: [zstd.compress(bytes(content)), tiles[1]])
        assert f"a.wlm: sheet random: tile 0: {words}" in line


def _on_levels(model):
    """The model with networks on 8-bit levels."""
    width, values = model.profile.hidden, torch.from_numpy(model.net.astype(np.float32))
    split = (18 + width) * width
    parts = values[:, :split].reshape(-1, 18 + width, width), values[:, split:].reshape(-1, width + 1, 3)
    net = torch.cat([part.flatten(1) for part in put_on_levels(*parts, 16)], 1).numpy().astype(np.float16)
    return dataclasses.replace(model, profile=model.profile.override({"net_bits": 8}), net=net)


@pytest.mark.parametrize("factor", [1.0, 1e-6, 1e4, 0.0])
def test_networks_of_bytes_come_back(tmp_path, factor):
    model = random_sheet((3, 3), hidden=17)
    other = _on_levels(dataclasses.replace(model, net=(model.net * np.float16(factor)).astype(np.float16)))
    size = _file_of(other).save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), _file_of(other))
    if factor == 1.0:
        assert _file_of(model).file_bytes() - size > 0.3 * model.net.nbytes
        apart = np.abs(other.net.astype(float) - model.net).max() / np.abs(model.net).max()
        assert 0 < apart < 0.5 / 127 + 1e-3


def test_networks_off_their_levels_are_one_line(tmp_path):
    sheet = random_sheet((3, 0))
    wrong = dataclasses.replace(sheet, profile=sheet.profile.override({"net_bits": 8}))
    assert "net: expected weights that 8 bits store" in error_of(_file_of(wrong).save, tmp_path / "a.wlm")


def test_a_fit_on_levels_is_what_its_file_decodes_to(tmp_path):
    profile = small_sets.tiny_profile(net_bits=8, steps=30)
    lightmaps = small_sets.moving_light()
    model = wlm.lightmap.compress(lightmaps, profile)
    model.save(tmp_path / "a.wlm")
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    plain = wlm.lightmap.compress(lightmaps, small_sets.tiny_profile(steps=30))
    scores = [wlm.lightmap.evaluate(each, lightmaps, metrics=["psnr"]).psnr for each in (model, plain)]
    assert abs(scores[0] - scores[1]) < 2.0
    assert not np.array_equal(model.sheets[LIGHT].net, plain.sheets[LIGHT].net)
