"""The probe benchmark on a small room: every row has its figures, and they agree with the systems that they are of."""

import numpy as np
import pytest
from builders.bench_rows import check_outputs, keys

from benchmarks.probe import PANELS, run_rows
from benchmarks.probe_pictures import picture_rows
from benchmarks.probe_speed import many_probes, speed_rows
from wlm.formats.geometry import Geometry
from wlm.probe.data import from_arrays
from wlm.probe.model import Profile
from wlm.probe.views import KINDS

STEPS = 60
PROBES = {"room": 300, "hall": 100}
PROFILES = [
    Profile(name="standard", ratio=0.1, latent=3, hidden=8, steps=STEPS),
    Profile(name="other", ratio=0.1, latent=3, hidden=8, steps=STEPS, support="sphere"),
]
PCA = {"room": "28 components", "hall": "27 components"}


def room(seed: int, name: str):
    """Probes in a room with a lamp, a tenth of them inside a wall."""
    random, count = np.random.default_rng(seed), PROBES[name]
    position = random.uniform([0, 0, 0], [6, 2.5, 5], (count, 3))
    near = np.exp(-((position - [2, 2, 3]) ** 2).sum(1) / 4)
    values = near[:, None] * random.uniform(0.5, 1.0, 27) + 0.2 * np.sin(position @ random.normal(size=(3, 27)))
    values[: count // 10] = 0.0
    return from_arrays(position, values.astype(np.float32), name=name)


@pytest.fixture(scope="module")
def sets():
    return [room(0, "room"), room(1, "hall")]


@pytest.fixture(scope="module")
def rows(sets):
    return run_rows(sets, PROFILES, device="cpu", ratios=(0.1, 0.2), frames=4, repeats=1)


def test_every_row_has_its_figures(rows, tmp_path):
    check_outputs(rows, tmp_path, PANELS)
    ours = [("ours", "standard"), ("ours", "other"), ("ours", "ratio 0.20")]
    ways = ["sphere", "exact"]
    fits = [("fit", f"standard {STEPS} steps"), ("dense torch", f"standard {STEPS} steps")]
    held = [("held out", "standard")]
    volume = [("volume", f"{light}, walk of 4 frames") for light in ("lossless", "ours")]
    views = [("views", f"balls, {light}") for light in KINDS]
    for scene, speed in (("room", fits), ("hall", [])):
        decoded = (("decode", way) for way in ways)
        expected = [*ours, ("pca", PCA[scene]), *decoded, *speed, *held, *volume, *views]
        assert keys(row for row in rows if row.scene == scene) == expected
    for row in rows:
        assert row.system == "probe" and row.notes
        if row.method in ("ours", "decode"):
            assert row["psnr"] > 10.0 and row["decode_ms"] > 0.0
            assert row["error_999"] <= row["max_error"] < (1.0 if "cut" in row.option else 1e-4)
        if row.method == "ours":
            assert row["bpp"] == pytest.approx(row["bytes"] * 8 / PROBES[row.scene]) and row["encode_seconds"] > 0.0
            assert row["probes"] == 0.9 * PROBES[row.scene]
            assert row["share_of_float32"] == pytest.approx(row["bpp"] / (27 * 32))
        if row.method == "volume":
            assert 0.0 <= row["coverage"] <= 1.0 and row["frames"] == 4
            assert row["psnr"] < row["light_psnr"] + 1.0 and (row["light_psnr"] == 120.0) == ("lossless" in row.option)


def test_fits_to_pictures_stand_beside_plain_ones(sets):
    floor = Geometry(np.array([[0, 0, 0], [9, 0, 0], [0, 0, 9]], np.float32), np.array([[0, 1, 2]], np.uint32))
    counts = []
    rows = picture_rows(sets[:1], PROFILES[0], floor, device="cpu", views=2, done=lambda rows: counts.append(len(rows)))
    options = ["fit", *(f"{drawn}, {light}" for drawn in ("balls", "mesh") for light in KINDS)]
    assert counts == [7, 14]
    assert keys(rows) == [(name, option) for name in ("plain fit", "fit to pictures") for option in options]
    for plain, pictured in zip(rows[:7], rows[7:], strict=True):
        assert plain["psnr"] > 5.0 and (plain["psnr"] == pictured["psnr"]) == ("lossless" in plain.option)
    assert rows[0]["bytes"] == rows[7]["bytes"] and 0.0 < rows[0]["relative_error"] < 1.0


def test_speed_of_a_set_in_one_region_and_in_several(sets):
    counts, several = [], PROFILES[0].model_copy(update={"region": 100, "ratio": 0.2})
    speed = speed_rows(
        [sets[0], many_probes(250)], several, device="cpu", frames=5, done=lambda rows: counts.append(len(rows))
    )
    options = ("fit", "decode", "volume, lossless", "volume, ours")
    assert counts == list(range(1, 9)) and keys(speed) == [("speed", option) for option in options] * 2
    for row, probes in ((speed[0], 270), (speed[4], 250)):
        assert row["probes"] == probes and row["psnr"] > 10.0 and row["gaussians"] <= 0.2 * probes
        assert row.notes == "profile standard, regions: 4"
    assert all(row["update_ms"] <= row["update_ms_max"] and row["frames"] == 5 for row in speed if "vol" in row.option)
    assert np.array_equal(many_probes(250).values, many_probes(250).values)
