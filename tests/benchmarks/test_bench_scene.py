"""The benchmark of a scene's frames on a small film: every row has its figures."""

import pytest

from benchmarks.scene import run
from wlm.scene.frame import STAGES


@pytest.mark.slow
def test_frames_and_their_stages_have_times():
    rows = run(quick=True, device="cpu")
    assert [row.method for row in rows] == ["a frame", *STAGES]
    assert rows[0]["frame_ms"] == pytest.approx(sum(row["frame_ms"] for row in rows[1:]))
    assert rows[0]["view_psnr"] > 30.0 and rows[0]["memory"] > 1.0
