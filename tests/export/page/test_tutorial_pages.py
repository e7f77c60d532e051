"""The pages of three.js that tutorials print, in Chromium, except that of probes: test_three_volume runs its module."""

import io
import shlex

import numpy as np
import pytest
from builders.running import call
from PIL import Image

from demos.tutorials import ROOT, steps

NEEDED = {
    "bake": ("wlm compress demos/data/cornell", "wlm export room.wlm -o room-three"),
    "smoke": ("wlm smoke simulate", "wlm smoke bake", "wlm smoke flipbook six -o puff-three"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", NEEDED)
def test_the_page_shows_light(name, tmp_path, monkeypatch, visit):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    for kind, text in steps(ROOT / "docs" / "tutorials" / f"{name}.md"):
        if text.startswith(NEEDED[name]):
            call(*shlex.split(text)[1:])
        elif kind not in ("command", "python"):
            (tmp_path / kind).write_text(text, encoding="utf-8")
    page = visit(tmp_path, "document.querySelector('canvas')", viewport={"width": 320, "height": 240})
    page.wait_for_timeout(4000)
    shown = np.asarray(Image.open(io.BytesIO(page.screenshot(timeout=200_000))).convert("L"), np.float32)
    # Without light, below the slider, the pages have one colour.
    assert shown[60:].std() > 5.0
