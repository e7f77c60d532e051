"""The kernels' benchmark: ceilings, a case at two sizes, the comparison with an older run, and the plot."""

from dataclasses import replace

import pytest

from benchmarks import write_json
from benchmarks.ceilings import KINDS
from benchmarks.kernel_cases import CASES, Work
from benchmarks.kernels import run
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
    with pytest.raises(WlmError, match="--only"):
        run(device="cpu", only=["nothing"])
