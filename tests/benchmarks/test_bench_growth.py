"""The simulated growth: bounds of each resource, failures, and the row of costs."""

import pytest

from benchmarks import growth
from benchmarks.growth import CORES, STORAGE, Costs, run, simulate


def test_bounds():
    """Each resource alone bounds the time; GPUs halve it until the storage that all share is always busy."""
    costs = Costs(read=0.1 * STORAGE, written=0.0, core_seconds=0.5 * CORES, gpu_seconds=2.0)
    one, eight, many = (simulate(costs, gpus, 2000) for gpus in (1, 8, 64))
    assert one.seconds == pytest.approx(2000 * 2.0, rel=0.01) and one.gpus > 0.99
    assert eight.seconds == pytest.approx(one.seconds / 8, rel=0.01)
    assert many.seconds == pytest.approx(2000 * 0.1, rel=0.03) and many.storage > 0.97 and many.gpus < 0.35
    slow = simulate(Costs(0.1 * STORAGE, 0.0, 4.0 * CORES, 2.0), 8, 2000)
    assert slow.seconds == pytest.approx(2000 * 4.0 / 8, rel=0.01) and slow.cores > 0.98


def test_failures(monkeypatch: pytest.MonkeyPatch):
    """A GPU that fails repeats its lightmap, and nothing is lost or done twice."""
    monkeypatch.setattr(growth, "HOURS_TO_FAIL", 0.05)
    costs = Costs(0.001 * STORAGE, 0.0, 0.01, 2.0)
    failing = simulate(costs, 4, 1000)
    assert failing.repeated > 3
    assert failing.seconds * failing.gpus * 4 == pytest.approx(1000 * 2.0 + failing.repeated, rel=0.02)


def test_rows():
    first, *rows = run(quick=True, device="cpu")
    assert first["read_bytes"] > 1e8 and first["core_seconds"] > 0.0 and first["fit_seconds"] > 1.0
    assert [row.option for row in rows] == ["1 GPU", "8 GPUs", "64 GPUs"]
    assert rows[0]["hours"] > rows[1]["hours"] > rows[2]["hours"]
