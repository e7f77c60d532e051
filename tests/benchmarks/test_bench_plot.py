"""Results beside older ones, the Pareto front by hand, and plots that are drawn, complete and readable."""

import json
import math
from dataclasses import replace
from xml.etree import ElementTree

import pytest
from builders.bench_rows import ENVIRONMENT
from builders.checks import error_of
from typer.testing import CliRunner

from benchmarks import Row, Run, compare, describe_environment, pareto_front, plot, write_json
from benchmarks.app import app
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


OLD = Row("lightmap", "city", "ours", "M", {"psnr": 45.0, "encode_seconds": 10.0, "bytes": 100})


def worse(new: dict, old: Row = OLD, machine: str = "a CPU") -> list[str]:
    environment = ENVIRONMENT | {"device_name": machine}
    changes = compare(Run(environment, [replace(OLD, figures=new)]), [Run(ENVIRONMENT, [old])])
    return [change.name for change in changes if change.worse]


@pytest.mark.parametrize(
    ("new", "names"),
    [
        ({"psnr": 44.96, "encode_seconds": 10.4, "bytes": 900}, []),
        ({"psnr": 44.94, "encode_seconds": 10.4}, ["psnr"]),
        ({"psnr": 46.0, "encode_seconds": 10.6}, ["encode_seconds"]),
        ({"psnr": 46.0, "encode_seconds": 1.0}, []),
        ({}, []),
    ],
)
def test_a_loss_of_decibels_or_of_time_is_worse(new, names):
    assert worse(new) == names


def test_times_of_another_machine_are_not_compared():
    assert worse({"psnr": 40.0, "encode_seconds": 99.0}, machine="another") == ["psnr"]


def test_a_time_within_the_spread_of_its_samples_is_not_worse():
    old = replace(OLD, figures={"decode_ms": 1.0, "decode_ms_spread": 0.1})
    new = {"decode_ms": 1.09, "decode_ms_spread": 0.1}
    assert worse(new, old) == []
    assert worse(new | {"decode_ms": 1.11}, old) == ["decode_ms"]


def test_only_rows_that_both_have_are_compared():
    others = [replace(OLD, option="H"), replace(OLD, scene="room"), replace(OLD, method="BC7")]
    assert compare(Run(ENVIRONMENT, [OLD]), [Run(ENVIRONMENT, others)]) == []
    changes = compare(Run(ENVIRONMENT, [OLD]), [Run(ENVIRONMENT, others), Run(ENVIRONMENT, [OLD])])
    found = [(change.name, change.old, change.new) for change in changes]
    assert found == [("psnr", 45.0, 45.0), ("encode_seconds", 10.0, 10.0)]


def invoke(folder, new: Row, old: Row):
    """Runs `python -m benchmarks compare` on files of one row each."""
    environment = describe_environment("cpu", "python -m benchmarks")
    for name, row in (("new.json", new), ("old.json", old)):
        write_json(folder / name, [row], environment)
    return CliRunner().invoke(app, ["compare", str(folder / "new.json"), str(folder / "old.json")])


def test_the_command_fails_where_a_figure_is_worse(tmp_path):
    assert invoke(tmp_path, OLD, OLD).exit_code == 0
    result = invoke(tmp_path, OLD.with_figures(psnr=44.0), OLD)
    assert result.exit_code == 1
    assert "worse: city ours M: PSNR, dB: 45.00 before, 44.00 now" in result.stderr


def test_the_command_says_what_it_cannot_compare(tmp_path):
    assert "no row has the method" in invoke(tmp_path, OLD, replace(OLD, option="H")).stderr
    result = CliRunner().invoke(app, ["compare", str(tmp_path / "old.json"), str(tmp_path / "absent.json")])
    assert "absent.json" in result.stderr
