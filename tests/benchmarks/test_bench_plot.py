"""The Pareto front by hand, and plots that are drawn, complete and readable."""

import math
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from PIL import Image

from benchmarks import Panel, Row, pareto_front, plot
from wlm.errors import WlmError

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


def test_a_panel_of_errors_shows_its_methods_and_falls(tmp_path, as_text, monkeypatch):
    from matplotlib.figure import Figure

    seen = []
    original = Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda self, *a, **k: (seen.extend(self.axes), original(self, *a, **k))[1])
    path = tmp_path / "p.svg"
    costs = [(4.0, 1e-7), (2.0, 1e-6), (3.0, 1e-5), (1.0, 1e-2)]
    rows = [
        Row("probe", "city", "decode", f"way {i}", {"decode_ms": x, "max_error": y}) for i, (x, y) in enumerate(costs)
    ]
    figures = {"decode_ms": 0.5, "max_error": 1e-9, "psnr": 40.0, "bpp": 5.0}
    other = Row("probe", "city", "ours", "standard", figures)
    plot([*rows, other], path, x=(Panel("bpp"), Panel("decode_ms", "max_error", ("decode",))))
    texts = svg_texts(path)
    assert texts.count("ours standard") == 1 and texts.count("largest error") == 1
    assert all(texts.count(f"decode way {i}") == 1 for i in range(4))
    axes = seen[1]
    assert axes.get_yscale() == "log" and seen[0].get_yscale() == "linear"
    # The front passes the three that no other beats, from the quickest to the most exact, and way 2 lies above it.
    front = next(line for line in axes.lines if len(line.get_xdata()) == 4)
    assert front.get_xydata()[:3].tolist() == [[1.0, 1e-2], [2.0, 1e-6], [4.0, 1e-7]]


def test_labels_of_a_crowd_do_not_overlap(tmp_path, monkeypatch):
    """Eight rows in a small corner: the boxes of their labels stay apart and inside the picture."""
    from matplotlib.figure import Figure
    from matplotlib.text import Text

    seen = {}
    original = Figure.savefig

    def spy(self, *args, **kwargs):
        renderer = self.canvas.get_renderer()
        self.canvas.draw()
        seen["frame"] = self.axes[0].get_window_extent(renderer)
        names = [text for text in self.axes[0].texts if text.get_text() != "Pareto front"]
        seen["boxes"] = [Text.get_window_extent(text, renderer) for text in names]
        return original(self, *args, **kwargs)

    monkeypatch.setattr(Figure, "savefig", spy)
    places = [(1.0 + 0.01 * (i % 3), 40.0 + 0.05 * i) for i in range(8)]
    crowd = [Row("l", "c", "method", f"no {i}", {"bpp": x, "psnr": y}) for i, (x, y) in enumerate(places)]
    plot([*crowd, Row("l", "c", "far", "", {"bpp": 8.0, "psnr": 50.0})], tmp_path / "p.png", x="bpp")
    boxes = seen["boxes"]
    assert len(boxes) == 9
    for i, a in enumerate(boxes):
        assert seen["frame"].x0 <= a.x0 and a.x1 <= seen["frame"].x1
        for b in boxes[:i]:
            assert a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0


@pytest.mark.parametrize(
    ("rows", "name", "x", "message"),
    [
        (ROWS, "p.png", "speed", "unknown measured quantity 'speed'"),
        (ROWS, "p.gif", "bpp", r"\.gif.*ends in"),
        ([], "p.png", "bpp", "no row"),
        ([Row("l", "c", "m", "", {"psnr": 1.0})], "p.png", "bpp", "expected results with both psnr and bpp"),
        (ROWS, "nowhere/p.png", "bpp", "nowhere"),
        (ROWS, "p.png", Panel("bpp", "max_error"), "expected results with both max_error and bpp"),
        (ROWS, "p.png", Panel("bpp", methods=("PCA",)), "expected results with both psnr and bpp"),
    ],
)
def test_what_cannot_be_drawn_is_one_clear_line(tmp_path, rows, name, x, message):
    with pytest.raises(WlmError, match=message):
        plot(rows, tmp_path / name, x=x)
    assert list(tmp_path.iterdir()) == []


def test_zero_cost_one_point_and_equal_points(tmp_path):
    """No logarithm of zero, no empty range."""
    for rows in ([ROWS[0].with_figures(bpp=0.0), ROWS[1]], ROWS[:1], [ROWS[0]] * 3):
        errors = [row.with_figures(max_error=0.1 * i) for i, row in enumerate(rows)]
        path = tmp_path / "p.png"
        plot(errors, path, x=(Panel("bpp"), Panel("bpp", "max_error")))
        with Image.open(path) as picture:
            assert picture.height == 585
