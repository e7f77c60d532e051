"""The benchmarks of kernels and operations: cases at two sizes, an older run, the plot, rows of each operation."""

from collections import defaultdict
from dataclasses import replace

import numpy as np
import pytest
from builders.checks import error_of
from builders.operation_subjects import WITHOUT

from benchmarks import ops as bench
from benchmarks import write_json
from benchmarks.ceilings import KINDS
from benchmarks.kernel_cases import CASES, Work
from benchmarks.kernels import run
from benchmarks.kernels_profile import run as profile
from benchmarks.kernels_profile import summarise
from benchmarks.runner import Bench
from wlm import ops
from wlm.errors import WlmError

CASE = "atlas, read"


def test_a_case_and_its_baseline(tmp_path):
    """Floors follow from work and ceilings; a run whose older shares were higher ends with the case's name."""
    rows = run(quick=True, device="cpu", only=[CASE], plot_path=tmp_path / "plot.png")
    ceilings = {row.option: row["rate"] for row in rows if row.method == "ceiling"}
    assert list(ceilings) == list(KINDS) and min(ceilings.values()) > 0.0
    first, second = (row for row in rows if row.method == CASE)
    for row, points in ((first, 1000), (second, 10_000)):
        assert row["moved_bytes"] == 20 * points and row["size"] == points
        assert row["floor_ms"] == pytest.approx(1e-6 * 20 * points / ceilings["copy"])
        assert row["of_floor"] == pytest.approx(row["floor_ms"] / row["time_ms"])
    assert second["slope"] > 0.0 and first.get("slope") is None
    assert (tmp_path / "plot.png").read_bytes()[1:4] == b"PNG"

    environment = {"device_name": "a machine"}
    better = [replace(row, figures={**row.figures, "of_floor": 1e3}) for row in (first, second)]
    write_json(tmp_path / "old.json", better, environment)
    with pytest.raises(WlmError, match=f"slower than the baseline.*{CASE}, 1,000 points"):
        run(quick=True, device="cpu", only=[CASE], baseline_path=tmp_path / "old.json")
    worse = [replace(row, figures={**row.figures, "of_floor": 1e-9}) for row in (first, second)]
    write_json(tmp_path / "old.json", worse, environment)
    run(quick=True, device="cpu", only=[CASE], baseline_path=tmp_path / "old.json")


def test_cases():
    """Every case has sizes that rise, and all kinds of work have a ceiling."""
    for case in CASES.values():
        assert list(case.sizes) == sorted(set(case.sizes)) and list(case.quick) == sorted(set(case.quick))
    assert set(Work().amounts()) <= set(KINDS)
    assert "--only" in error_of(run, device="cpu", only=["nothing"])


def test_a_profile():
    """Launches of one kernel are summed, weighted by time; the busiest unit and what warps wait for are named."""
    step = "void wp::kernels__locals__step_1f_cuda_kernel_forward<4>(int)"
    launches = [
        _launch(step, 3000, 90.0, {"long_scoreboard": 5.0, "wait": 1.0}),
        _launch(step, 1000, 50.0, {"long_scoreboard": 5.0, "wait": 1.0}),
        _launch("copy", 1000, 20.0, {"barrier": 2.0, "drain": 3.0}),
    ]
    first, second = summarise(Bench("kernels-profile", "cpu", None).row, CASE, launches)
    assert (first.method, first.option, first["launches"]) == (CASE, "step", 2) and first["share_of_time"] == 0.8
    assert first["memory_busy"] == pytest.approx(0.8) and first.notes.startswith("bound by memory; warps wait for glob")
    assert second.notes.startswith("bound by latency with few warps active (40 registers")
    assert "drain" not in second.notes
    assert "stores at its end, then for other warps" in second.notes
    assert "expected cuda" in error_of(profile, device="cpu")


def _launch(name, time, memory, stalls):
    row = {"Kernel Name": name, "gpu__time_duration.sum": f"{time:,}", "launch__registers_per_thread": "40"}
    row = defaultdict(str, row)
    row["dram__bytes.sum.pct_of_peak_sustained_elapsed"] = str(memory)
    return row | {
        f"smsp__average_warps_issue_stalled_{key}_per_issue_active.ratio": str(v) for key, v in stalls.items()
    }


def test_every_operation_is_measured():
    # `rasterize_uv` is `rasterize` with other corners.
    assert {work.op for work in bench.works().values()} == {*ops.__all__} - WITHOUT.keys() - {"rasterize_uv"}


def test_rows(monkeypatch):
    values, points = np.eye(4, dtype=np.float32)[..., None], np.random.default_rng(0).random((9, 2)).astype(np.float32)
    works = {
        "plane": bench.Work("plane", "small", {"values": values, "points": points}),
        "wrapped": bench.Work("plane", "periodic", {"values": values}, {"points": points}, {"periodic": True}),
    }
    monkeypatch.setattr(bench, "works", lambda: works)
    lines: list[str] = []
    rows = bench.run(device="cpu", progress=lines.append)
    named = [(row.system, row.method, row.option) for row in rows]
    assert named == [("ops", "plane", "small"), ("ops", "plane", "periodic")]
    assert len(lines) == 2
    for row in rows:
        assert row["value_error"] < 1e-5 and row["gradient_error"] < 1e-4
        assert all(row[f"{name}_ms"] > 0.0 for name in ("forward", "backward", "torch_forward", "torch_backward"))
    assert [row.option for row in bench.run(device="cpu", only=["wrapped"])] == ["periodic"]
    with pytest.raises(WlmError, match="--only: expected one of plane, wrapped; found 'sphere'"):
        bench.run(device="cpu", only=["sphere"])


def test_a_wrong_result_is_an_error(monkeypatch):
    """Errors are those of the operation, and not of the reference with itself."""
    values, points = np.eye(4, dtype=np.float32)[..., None], np.full((9, 2), 0.4, np.float32)
    work = bench.Work("plane", "small", {"values": values}, {"points": points})
    right = ops.plane
    monkeypatch.setattr(ops, "plane", lambda values, points: 1.5 * right(values, points))
    monkeypatch.setattr(bench, "works", lambda: {"plane": work})
    (row,) = bench.run(device="cpu")
    assert abs(row["value_error"] - 0.5) < 1e-4 and abs(row["gradient_error"] - 0.5) < 1e-4
