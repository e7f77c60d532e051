"""The benchmark of operations: every one is measured, and errors and times are those of the call."""

import numpy as np
import pytest
from builders.operation_subjects import WITHOUT

from benchmarks import ops as bench
from wlm import ops
from wlm.errors import WlmError


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
    assert [(row.system, row.method, row.option) for row in rows] == [
        ("ops", "plane", "small"),
        ("ops", "plane", "periodic"),
    ]
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
