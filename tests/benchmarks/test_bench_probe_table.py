"""The table of probes at equal bytes: its rows keep to their size, and their errors are those of the models."""

import numpy as np
import pytest
from builders.bench_rows import keys
from builders.checks import error_of

from benchmarks.probe_table import RIVALS, nearest_probes, table_rows
from wlm.probe.data import from_arrays
from wlm.probe.evaluation import by_distance, score
from wlm.probe.fit import compress
from wlm.probe.model import Profile

PROFILE = Profile(name="standard", latent=3, hidden=8, steps=40)
SHARES = (10, 25)
ERRORS = ("relative", "absolute")
OURS = [f"{name}, {error}" for name in ("Gaussians", "PCA") for error in ERRORS]


@pytest.fixture(scope="module")
def probes():
    """A room with a lamp; a tenth of the probes are inside a wall."""
    random = np.random.default_rng(0)
    position = random.uniform([0, 0, 0], [6, 2.5, 5], (300, 3))
    near = np.exp(-((position - [2, 2, 3]) ** 2).sum(1) / 4)
    values = near[:, None] * random.uniform(0.5, 1.0, 27) + 0.02 * np.sin(position @ random.normal(size=(3, 27)))
    values[:, :3] += 0.1
    values[:30] = 0.0
    return from_arrays(position, values.astype(np.float32), name="room")


@pytest.fixture(scope="module")
def made(probes):
    calls = []
    rows = table_rows([probes], PROFILE, device="cpu", shares=SHARES, done=lambda rows: calls.append(len(rows)))
    return rows, calls


def test_every_method_has_a_row_of_each_size(made, probes):
    rows, calls = made
    each = [*OURS, *RIVALS, *(f"ours, {error}" for error in ERRORS)]
    fixed = [("original", ""), ("Unreal packing", "")]
    assert keys(rows) == fixed + [(name, f"{share}%") for share in SHARES for name in each]
    assert calls == [2 + len(each), 2 + 2 * len(each)]
    for row in rows:
        if row.option and row.figures:
            assert row["bytes"] <= int(row.option[:-1]) / 100 * probes.float_bytes and row["psnr"] > 10.0
            assert row["share_of_float32"] == pytest.approx(row["bytes"] / probes.float_bytes)
            assert row["relative_db"] == pytest.approx(-20 * np.log10(row["relative_error"]))


def test_ours_is_what_compress_takes(made, probes):
    found = {(row.method, row.option): row for row in made[0]}
    for share in SHARES:
        size = share * probes.float_bytes // 100
        model = compress(probes, PROFILE, error="relative", max_bytes=size)
        report = score(model.decoder("cpu", position=probes.position).decode_probes(), probes, 1)
        row = found["ours, relative", f"{share}%"]
        assert row["bytes"] == model.content.nbytes and row["psnr"] == pytest.approx(report.psnr, abs=1e-6)
        assert row["relative_error"] == pytest.approx(report.relative_error, rel=1e-6)
        assert row.figures == found[f"{row.notes.partition(':')[0]}, relative", f"{share}%"].figures


def test_errors_of_the_originals_are_those_of_reading(made, probes):
    row = made[0][0]
    assert row["psnr"] == row["relative_db"] == row["view_psnr"] == 120.0 and row["view_flip"] == 0.0
    live = np.flatnonzero(probes.live)
    out = live[4::5]
    kept = np.setdiff1d(live, out)
    others = from_arrays(probes.position[kept], probes.values[kept])
    error = by_distance(others, probes.position[out], 8) - probes.values[out]
    mse, peak = np.square(error).mean(), np.ptp(probes.values)
    assert row["held_out_psnr"] == pytest.approx(10 * np.log10(peak**2 / mse))
    assert 25.0 < row["volume_psnr"] < 120.0 and row["volume_relative_db"] > 15.0


def test_a_single_probe_has_no_held_out_light(probes):
    one = nearest_probes(probes, 1)
    (row,) = (
        row for row in table_rows([one], PROFILE, device="cpu", only=["PCA"], shares=(100,)) if row.method == OURS[2]
    )
    assert row.scene == "room, 1 probes" and row["relative_error"] < 0.05 and "held_out_psnr" not in row.figures


def test_the_nearest_probes_are_around_the_middle(probes):
    part = nearest_probes(probes, 40)
    middle = (probes.position[probes.live].min(0) + probes.position[probes.live].max(0)) / 2
    assert part.live.all() and np.abs(part.position - middle).max() < 2.0
    for count in (0, 271):
        assert "expected 1 to 270 live probes" in error_of(nearest_probes, probes, count)
