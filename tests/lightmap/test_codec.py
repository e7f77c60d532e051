"""A model's file: what is saved comes back, in the bytes that it needs."""

import dataclasses

import numpy as np
import pytest
from builders.checks import assert_same
from builders.synthetic import random_model, random_sheet

import wlm
from wlm.formats.artifact import read_artifact
from wlm.lightmap.codec import PACKED, part_bytes
from wlm.lightmap.encodings.maps import tile_bytes
from wlm.lightmap.model import SheetModel
from wlm.lightmap.profile import Profile
from wlm.lightmap.sheet import LIGHT

ARRAYS = [field.name for field in dataclasses.fields(SheetModel) if field.type is np.ndarray]


@pytest.mark.parametrize("kinds", [(3, 2, 1, 0), (3, 3), (2, 2), (1, 1), (0, 0), (4, 3, 1, 4), (4, 0, 0, 0)])
@pytest.mark.parametrize(("period", "share"), [(24.0, None), (None, 0.4), (24.0, 0.01), (None, 0.0)])
def test_what_is_written_comes_back(tmp_path, kinds, period, share):
    """The share is that of the map's texels that are valid; None leaves the mask out."""
    shape = (-(-len(kinds) // 2) * 128 - 20, 247)
    mask = None if share is None else np.random.default_rng(0).random(shape) < share
    model = random_model(kinds, mask=mask, period=period, metric_weight=0.25, time_axis="paper")
    size = model.save(tmp_path / "a.wlm")
    assert size == (tmp_path / "a.wlm").stat().st_size == model.file_bytes() == sum(part_bytes(model, size).values())
    assert_same(wlm.load(tmp_path / "a.wlm"), model)
    assert ("0.tiles" in read_artifact(tmp_path / "a.wlm").parts) == (max(kinds) >= 2) or share == 0.0


def test_the_arrays_are_all_tested():
    assert len(ARRAYS) == len({*ARRAYS}) and {*ARRAYS} == {*random_sheet().parts, "times", "mask"}


@pytest.mark.parametrize("times", [(0.0, 1e-9), (18.45, 18.55), (7.0,), (1e6, 1e6 + 1e-4)])
def test_times_stay_apart_and_close(tmp_path, times):
    model = random_model((3, 0), times=times, period=None)
    model.save(tmp_path / "a.wlm")
    back = wlm.load(tmp_path / "a.wlm").times
    np.testing.assert_allclose(back, times, rtol=2e-7)
    assert (np.diff(back) > 0).all()


@pytest.mark.parametrize("kind", [3, 2])
def test_the_size_is_the_arithmetic_of_table_3(tmp_path, kind):
    sizes = {"hidden": 16, "uvt_resolution": 32, "uvt_slices": 12}
    times = tuple(float(hour) for hour in range(24))
    tiles = 16
    model = random_model((kind,) * tiles, columns=4, times=times, **sizes)
    profile = Profile(name="", **sizes)
    expected = tiles * tile_bytes(profile, kind == 3)
    assert sum(getattr(model.sheets[LIGHT], name).nbytes for name in PACKED) == expected
    # zstd can not shorten noise: the file is as large except for the bits that name the mode, and the scales.
    assert 0.93 < model.save(tmp_path / "a.wlm") / expected < 1.02
    # Table 3 of the paper: 34 KiB of maps for profile M, and 16 KiB for F_uv alone.
    sheet = random_sheet((kind, kind), **sizes)
    networks = (sheet.net if kind == 3 else sheet.net_static).nbytes // 2
    assert tile_bytes(profile, kind == 3) - networks == (34 if kind == 3 else 16) * 1024
