"""A model's file: what is saved comes back, in the bytes that it needs."""

import dataclasses

import numpy as np
import pytest
from builders.checks import assert_same
from builders.synthetic import random_model

import wlm
from wlm.lightmap.model import LightmapModel, Profile
from wlm.lightmap.packing import PACKED

ARRAYS = [field.name for field in dataclasses.fields(LightmapModel) if field.type is np.ndarray]


@pytest.mark.parametrize(
    "kinds", [(3, 2, 1, 0), (3, 3), (2, 2), (1, 1), (0, 0), (0, 3), (4, 4), (4, 3, 1, 4), (5, 4, 6, 5)]
)
@pytest.mark.parametrize("period", [24.0, None])
def test_what_is_written_comes_back(tmp_path, kinds, period):
    model = random_model(kinds, period=period, metric_weight=0.25, time_axis="paper")
    size = model.save(tmp_path / "a.wlm")
    assert size == (tmp_path / "a.wlm").stat().st_size == model.file_bytes()
    assert_same(wlm.load(tmp_path / "a.wlm"), model)


def test_the_arrays_are_all_tested():
    assert len(ARRAYS) == 22 and {*ARRAYS} == {*random_model().parts, "times", "mask"}


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
    assert sum(getattr(model, name).nbytes for name in PACKED) == tiles * profile.tile_bytes(kind == 3)
    # Noise hardly deflates: the file is as large but for some bytes of a stream, and the bits that say the mode.
    size = model.save(tmp_path / "a.wlm")
    assert 0.93 < size / (tiles * profile.tile_bytes(kind == 3)) < 1.02
    # Table 3 of the paper: 34 KiB of maps for profile M, and 16 KiB for F_uv alone.
    model = random_model((kind, kind), **sizes)
    networks = (model.net if kind == 3 else model.net_static).nbytes // 2
    assert profile.tile_bytes(kind == 3) - networks == (34 if kind == 3 else 16) * 1024
