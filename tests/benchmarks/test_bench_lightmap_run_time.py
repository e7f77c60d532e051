"""The benchmark of the virtual texture: its cameras, its large set, and rows that are of what they name."""

import numpy as np
import pytest
from builders.bench_rows import check_outputs, keys
from builders.gltf_scene import box
from builders.small_sets import moving_light, tiny_profile

from benchmarks import Panel
from benchmarks import lightmap_run_time as bench
from benchmarks.rivals.lightmap_run_time import EveryFrame, EveryTime
from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.lightmap.fit import compress
from wlm.lightmap.tiles import TileKind

SIZE = (24, 40)


@pytest.fixture(scope="module")
def patch():
    with pytest.MonkeyPatch.context() as context:
        yield context


@pytest.fixture(scope="module")
def room(patch):
    """A set of one tile, in a room."""
    position, triangle, uv = (np.asarray(part) for part in box((0, 0, 0), (6, 3, 5), inward=True))
    patch.setattr(bench, "read_geometry", lambda path: Geometry(position.astype(np.float32), triangle, uv))
    return moving_light(hours=(0.0, 12.0, 18.45, 18.55))


def test_the_large_set_changes_as_a_real_one():
    model = bench.large_model(256)
    assert len(model.sheets) == 4 and len(model.times) == 26 and model.period == 24.0
    assert all((own.kind == TileKind.DYNAMIC).all() and own.grid.count == 4 for own in model.sheets.values())
    light = model.decoder(tiles={sheet: [0] for sheet in model.sheets}).light
    noon, later, night = (light.tiles([0], hour) for hour in (12.0, 13.0, 2.0))
    assert np.isfinite(noon).all() and noon.std() > 0.0
    assert 0.005 < np.abs(later - noon).mean() / noon.mean() < 0.2 < np.abs(night - noon).mean() / noon.mean()


@pytest.fixture(scope="module")
def model(room):
    return compress(room, tiny_profile())


@pytest.fixture(scope="module")
def run(patch):
    patch.setattr(bench, "_QUICK", 120)
    run = bench._RunTime("room, run time", True, "cpu", None)
    run.size = SIZE
    return run


@pytest.fixture(scope="module")
def rows(room, model, run):
    return run.rows(model, bench._RoomCamera(room, SIZE, "cpu"), room.light)


def test_an_unknown_rival():
    with pytest.raises(WlmError, match="--rival: expected one of each-frame, each-time, bc7, bc6h; found bc1"):
        bench.run(rival_names=["bc1"], quick=True, device="cpu")


def test_every_row_has_its_figures(rows, tmp_path):
    own, rivals = rows[:3], rows[3:11]
    check_outputs(rows, tmp_path, [Panel("texel_rms")], rows[11:])
    paths = ["walk, 8 pages a frame", "day, 8 pages a frame", "day, 64 pages a frame"]
    others = ("all decoded each frame", "all decoded each stored time", "BC7 resident", "BC6H resident")
    assert keys(rows) == [
        *(("virtual texture", path) for path in paths),
        *((name, path) for name in others for path in ("walk", "day")),
        *(("format", name) for name in ("RGB9E5", "RGBA8")),
    ]
    for row in own:
        assert 0.0 < row["current"] <= row["nearly_current"] <= 1.0 and row["cached_psnr"] > 30.0
        assert 0.0 <= row["staleness"] <= row["staleness_p95"] and row["pages_decoded"] <= row["pages_decoded_max"]
    for row in (*own, *rivals):
        assert row["frame_ms"] <= row["frame_ms_max"] and 0.0 < row["view_flip"] < 1.0 < row["view_psnr"]
        parts = ("texture", "tiles", "coarse", "pages", "masks", "tables")
        assert row["memory"] == pytest.approx(sum(row.get(f"{part}_memory") or 0.0 for part in parts))
    assert own[2]["current"] == 1.0 and abs(own[2]["gain"]) < 0.3
    for cached, (each, stored, *blocks) in ((own[0], rivals[::2]), (own[2], rivals[1::2])):
        assert each["frame_ms"] > stored["frame_ms"] and abs(each["view_psnr"] - cached["view_psnr"]) < 1.0
        assert each["view_psnr"] == pytest.approx(stored["view_psnr"], abs=0.5)
        # A fit of a few steps is far from the blocks.
        assert all(row["frame_ms"] == 0.0 and row["view_psnr"] > each["view_psnr"] + 3.0 for row in blocks)
    assert rows[11]["texel_rms"] < 0.002 < rows[12]["texel_rms"]


def test_rivals_read_the_light_of_an_hour(room, model):
    each, stored = EveryFrame(model, "cpu"), EveryTime(model, "cpu")
    decoder, work = model.decoder(), []
    for hour in (1.0, 2.0, 13.0, 18.5, 23.0, 23.5, 18.5):
        launches = stored.prepare(hour)
        work.append(launches is not None)
        if launches is not None:
            launches()
        light = decoder.frame(18.45 if hour == 18.5 else hour)  # the lamp is not on yet
        for rival in (each, stored):
            np.testing.assert_allclose(rival.light(hour), light, rtol=0, atol=light.max() / 256)
    assert work == [True, False, True, True, True, False, True]
    assert stored.memory["texture"] == 2 * each.memory["texture"] and stored.memory["tiles"] == model.memory_bytes
