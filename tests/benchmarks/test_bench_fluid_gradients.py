"""The benchmark of gradients through air and smoke on a small grid: every row has its figures."""

import pytest

from benchmarks.fluid_gradients import run


@pytest.mark.slow
def test_every_row_has_its_figures():
    rows = run(quick=True, device="cpu")
    timed = [row for row in rows if "step_ms" in row.figures]
    assert len(timed) == 8 and {row.method for row in timed} == {"air", "smoke"}
    assert all(row.figures["step_ms"] > 0.0 for row in timed)
    # Populations of 16^3 cells in two arrays.
    assert rows[-1].figures["memory"] == pytest.approx(2 * 19 * 16**3 * 4 / 2**20)
