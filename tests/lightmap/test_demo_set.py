"""A short fit of the demo's set must reach a PSNR, so that no change of the codec costs quality unnoticed."""

from pathlib import Path

import pytest

from wlm.lightmap.data import load
from wlm.lightmap.evaluation import evaluate
from wlm.lightmap.fit import compress

DEMO = Path(__file__).resolve().parents[2] / "demos" / "data" / "city"


@pytest.fixture(scope="module")
def report():
    day = load(DEMO)
    return evaluate(compress(day, "M", steps=800, samples=1024), day, metrics=("psnr", "seen"), views=0)


@pytest.mark.parametrize(("name", "least"), [("psnr", 41.0), ("seen", 42.0), ("ring", 37.0), ("between", 42.5)])
def test_light_is_as_right_as_it_was(report, name, least):
    """At texels, filtered, beside charts, and half-way between hours, dB; seeds differ by 0.2."""
    assert getattr(report, name) >= least


def test_the_file_is_as_small_as_it_was(report):
    assert report.bpp <= 0.62
