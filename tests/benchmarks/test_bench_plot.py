"""The Pareto front by hand, and plots that are drawn, complete and readable."""

import json
import math
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from builders.checks import error_of

from benchmarks import Row, pareto_front, plot
from benchmarks.plots import Curve, digests, draw_all

NAN = math.nan
ROWS = [
    Row("lightmap", "city", "BC6H", "slow", {"bpp": 8.0, "decode_ms": 0.021, "psnr": 43.96}),
    Row("lightmap", "city", "ASTC", "12x12", {"bpp": 0.9, "decode_ms": 0.024, "psnr": 26.8}),
    Row("lightmap", "city", "ASTC", "10x10", {"bpp": 1.3, "decode_ms": 0.024, "psnr": 28.7}),
    Row("lightmap", "city", "ours", "M", {"bpp": 0.68, "decode_ms": 0.153, "psnr": 42.5}),
    Row("lightmap", "city", "torch", "M", {"bpp": 0.68, "decode_ms": 0.469, "psnr": 42.5}),
]


@pytest.mark.parametrize(
    ("points", "front"),
    [
        ([], []),
        ([(3.0, 1.0)], [0]),
        ([(2.0, 20.0), (1.0, 10.0), (3.0, 30.0)], [1, 0, 2]),  # all, by rising cost
        ([(1.0, 10.0), (2.0, 5.0), (3.0, 20.0)], [0, 2]),  # costs more and is worse
        ([(1.0, 10.0), (1.0, 12.0)], [1]),  # same cost: the better
        ([(2.0, 10.0), (1.0, 10.0)], [1]),  # same quality: the cheaper
        ([(1.0, 10.0), (1.0, 10.0), (2.0, 9.0)], [0]),  # equal: the first
        ([(NAN, 99.0), (1.0, NAN), (2.0, 5.0)], [2]),
        ([(NAN, NAN)], []),
        ([(1.0, -math.inf), (2.0, 0.0)], [0, 1]),
        ([(0.0, 1.0), (-1.0, 0.0)], [1, 0]),
    ],
)
def test_pareto_front_by_hand(points, front):
    assert pareto_front(points) == front


def svg_texts(path):
    return [node.text for node in ElementTree.parse(path).iter("{http://www.w3.org/2000/svg}text")]


@pytest.fixture
def as_text(monkeypatch):
    """Letters in SVG files as text rather than outlines, so that they can be read back."""
    import matplotlib

    monkeypatch.setitem(matplotlib.rcParams, "svg.fonttype", "none")


def test_panels_name_the_rows_that_have_their_values(tmp_path, as_text):
    """Both panels those that have both; a row without a size only that of times, one without an error none."""
    path = tmp_path / "p.svg"
    other = Row("lightmap", "night", "ours", "M", {"decode_ms": 1.0, "psnr": 30.0})
    gone, half = (replace(ROWS[0], method=method) for method in ("gone", "half"))
    gone, half = gone.with_figures(psnr=None), half.with_figures(bpp=None)
    plot([*ROWS, gone, half, other], path)
    texts = svg_texts(path)
    for row in ROWS:
        assert texts.count(f"{row.method} {row.option}") >= 2
    assert "gone slow" not in texts
    # A row of panels for each of the two scenes.
    for words in ("decode time (ms)", "size (bpp)"):
        assert texts.count(words) == 2
    assert texts.count("half slow") == texts.count("not measured") == 1
    assert texts.count("Pareto front") >= 2
    assert [p.name for p in tmp_path.iterdir()] == ["p.svg"]


def test_plots_of_the_documents(tmp_path):
    """Every plot is drawn with the digest of its points, digests of other pictures stay, and a curve has points."""
    (tmp_path / "sources.json").write_text('{"other.png": "0"}', encoding="utf-8")
    made = digests()
    assert set(draw_all(tmp_path)) == made.keys() == {path.name for path in tmp_path.glob("*.png")}
    assert json.loads((tmp_path / "sources.json").read_text()) == made | {"other.png": "0"}
    assert "cpu.json: expected rows of city that match NTC" in error_of(Curve("cpu", "lightmap", "city", "NTC .*").rows)
