"""Gaps between charts: which texels are filled, and from where, on every path that decodes a map."""

import dataclasses

import numpy as np
import pytest
from builders.checks import error_of
from builders.synthetic import random_sheet

import wlm
from wlm.formats import zstd
from wlm.formats.artifact import read_artifact, write_artifact
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.gaps import Gaps
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.sheet import LIGHT
from wlm.texels import REACH, fill_gaps


def _mask(seed: int = 0, shape: tuple[int, int] = (40, 50), share: float = 0.05) -> np.ndarray:
    return np.random.default_rng(seed).random(shape) < share


@pytest.mark.parametrize("share", [0.0, 0.005, 0.05, 0.5, 1.0])
def test_each_takes_the_nearest_within_reach(share):
    mask = _mask(share=share)
    gaps, valid = Gaps.of(mask), np.argwhere(mask)
    expected = set()
    for at in np.argwhere(~mask):
        if len(valid) and np.abs(valid - at).max(1).min() <= REACH:
            expected.add(tuple(at))
    assert {tuple(at) for at in gaps.target} == expected
    for at, source in zip(gaps.target, gaps.source, strict=True):
        assert mask[tuple(source)]
        assert np.square(source - at).sum() == np.square(valid - at).sum(1).min()


def test_they_are_filled_as_a_baker_dilates():
    mask = _mask(3)
    image = np.random.default_rng(1).random((40, 50, 3))
    gaps, expected = Gaps.of(mask), fill_gaps(image, mask)
    gaps.fill(image)
    where = tuple(gaps.target.T)
    assert len(gaps.target) > 100
    np.testing.assert_array_equal(image[where], expected[where])


def test_the_first_of_several_as_near():
    mask = _mask(3)
    gaps, valid = Gaps.of(mask), np.argwhere(mask)  # in reading order
    first = [valid[np.square(valid - at).sum(1).argmin()] for at in gaps.target]
    np.testing.assert_array_equal(gaps.source, first)


@pytest.fixture(scope="module")
def model():
    mask = np.zeros((236, 247), bool)
    mask[20:60, 30:128] = mask[100:180, 60:90] = mask[235, 246] = True
    return random_sheet((3, 3, 2, 1), mask=mask)


@pytest.mark.parametrize("time", [7.5, 10.0])
def test_a_map_and_its_tiles_agree(model, time):
    decoder = SheetDecoder(model)
    frame = decoder.frame(time)
    raw = np.zeros((256, 256, 3), np.float32)
    for number, light in enumerate(decoder.tiles(range(4), time)):
        y, x = number // 2 * 128, number % 2 * 128
        raw[y : y + 128, x : x + 128] = light
    assert np.array_equal(frame[model.mask], raw[:236, :247][model.mask])
    gaps = Gaps.of(model.mask)
    assert np.array_equal(frame[tuple(gaps.target.T)], raw[tuple(gaps.source.T)])
    crossing = (gaps.target // 128 != gaps.source // 128).any(1)
    assert crossing.any()
    for border in (0, 4):
        tile = decoder.tile(0, time, border)
        assert np.array_equal(tile[border:, border:], frame[: 128 + border, : 128 + border])
        assert np.array_equal(tile[border, :border], tile[border, border : 2 * border][::-1])  # mirrored there
        last = decoder.tile(3, time, border)
        inside = frame[128 - border :, 128 - border :]
        assert np.array_equal(last[: inside.shape[0], : inside.shape[1]], inside)


def _file_of(sheet):
    return LightmapModel("m", "0123456789abcdef", sheet.profile, {LIGHT: sheet})


def test_the_file_has_the_mask(model, tmp_path):
    path = tmp_path / "m.wlm"
    _file_of(model).save(path)
    assert np.array_equal(wlm.load(path).sheets[LIGHT].mask, model.mask)
    whole = dataclasses.replace(model, mask=np.ones_like(model.mask))
    _file_of(whole).save(path)
    assert wlm.load(path).sheets[LIGHT].mask.all()
    assert not len(Gaps.of(whole.mask).target)


@pytest.mark.parametrize(
    ("content", "says"),
    [(b"x", "part mask: "), (b"", "part mask: "), (zstd.compress(bytes(7288)), "part mask: expected 7287 bytes")],
)
def test_a_wrong_mask_is_one_line(model, tmp_path, content, says):
    path = tmp_path / "m.wlm"
    _file_of(model).save(path)
    artifact = read_artifact(path)
    tensors = artifact.tensors | {"0.mask": np.frombuffer(content, np.uint8)}
    write_artifact(tmp_path / "bad.wlm", "lightmap", artifact.settings, tensors, artifact.source)
    assert says in error_of(lambda: wlm.load(tmp_path / "bad.wlm"))
