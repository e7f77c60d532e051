"""Reports as pages: what a score says stands there, with pictures, and a name stays text."""

import dataclasses
import re

import numpy as np
import pytest
import torch
from builders.contract import SUBJECTS
from builders.smoke_samples import random_model

from wlm.smoke.evaluation import NETWORK, REFERENCE, Comparison, Example, Score
from wlm.smoke.network.planes import PLANES
from wlm.view.document import Document
from wlm.view.reports import atlas_report, lightmap_report, probe_report, smoke_report


@pytest.fixture(scope="module", params=["lightmap", "atlas-tiles", "probe"])
def scored(request):
    """A model, its data, and its report."""
    subject = SUBJECTS[request.param]()
    data = subject.data()
    model = subject.compress(data)
    return subject.name, model, data, subject.evaluate(model, data)


def write(path, name, model, data, report) -> str:
    if name == "atlas":
        size = atlas_report(path, model, data, report, 2)
    else:
        size = {"lightmap": lightmap_report, "probe": probe_report}[name](path, model, data, report)
    assert size == path.stat().st_size
    return path.read_text(encoding="utf-8")


def test_a_report_shows_its_score_with_pictures_and_loads_nothing(scored, tmp_path):
    text = write(tmp_path / "report.html", *scored)
    assert f"{scored[-1].psnr:.2f} dB" in text
    assert "<script" not in text and not re.search(r'(?:src|href)="(?!data:)', text)
    if scored[0] == "lightmap":
        report = scored[-1]
        assert f"{report.between:.2f} dB" in text and f"tile {report.light.worst_seen['tile']} at" in text
    pictures = text.count("data:image/png;base64,")
    assert pictures >= {"lightmap": 5, "atlas": 6, "probe": 1}[scored[0]]


def test_a_report_of_a_strange_name_and_without_scores(scored, tmp_path):
    name, model, data, report = scored
    gone = {
        item.name: np.full_like(value, np.nan) if isinstance(value, np.ndarray) else np.nan
        for item in dataclasses.fields(report)
        if isinstance(value := getattr(report, item.name), float | np.ndarray) and item.name != "time_values"
    }
    model = dataclasses.replace(model, name="<b>\u2028</b>")
    report = dataclasses.replace(report, **gone, **({"name": "<b>"} if name == "probe" else {}))
    if name == "atlas":
        report = dataclasses.replace(report, worst_view=-1, views=0)
    text = write(tmp_path / "report.html", name, model, data, report)
    assert "<b>" not in text and "–" in text and ">nan" not in text
    assert name != "atlas" or "No camera" in text


def smoke_comparison(name, frames, views, hot=True):
    """A network, and a rival that has no image of the first view."""
    random = np.random.default_rng(0)
    images = {NETWORK: 30 + 10 * random.random((frames, views)), "flip book": 20 + random.random((frames, views))}
    images["flip book"][:, 0] = np.nan
    scores = {}
    for method, values in images.items():
        seen = values[np.isfinite(values)].tolist() or [12.0]
        planes = tuple(np.linspace(31.5, 38.5, len(PLANES)).tolist())
        scores[method] = Score(float(np.mean(seen)), min(seen), max(seen), planes, 0.02, 0.01, tuple(seen))
    shown = {name: torch.rand(len(PLANES), 12, 12).half() for name in (REFERENCE, NETWORK, "flip book")}
    if not hot:
        shown[REFERENCE][PLANES.index("emission")] = 0
    worst = Example(frames - 1, views - 1, shown), Example(0, 0, {key: shown[key] for key in (REFERENCE, NETWORK)})
    turns = 90.0 / views * np.arange(views)
    return Comparison(name, frames * views // 2, scores, turns, images, worst)


def test_a_report_of_smoke(tmp_path):
    comparisons = [smoke_comparison("density x 1", 8, 3), smoke_comparison("<b>.npz", 2, 1, hot=False)]
    size = smoke_report(tmp_path / "report.html", "<i>", random_model(), comparisons)
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert size == len(text.encode()) and "<b>" not in text and "<i>" not in text and "<script" not in text
    for comparison in comparisons:
        for score in comparison.methods.values():
            assert f"<td>{score.psnr:.2f}</td><td>{score.lowest:.2f}</td><td>{score.highest:.2f}</td>" in text
    assert "<td>2.000</td>" in text
    worst = comparisons[0].images[NETWORK][7, 2]
    assert f"density x 1: frame 8 from 60°, {worst:.2f} dB" in text
    # Three plots of the first, one of the volume, which has neither several frames nor views.
    assert [text.count(f"PSNR by {what}") for what in ("light", "frame", "the view")] == [2, 1, 1]
    # In each of the two worst images of both: what there is, and errors of all but the reference.
    assert text.count("<figure>") == 2 * (5 + 3)


def test_parts_of_a_document(tmp_path):
    page = Document("a & b")
    page.text("note")
    page.table("", ("", "x"), [("<i>", "1")])
    page.lines("lines", "dB", np.arange(3.0), {"one": np.array([1.0, np.nan, 2.0]), "two": np.zeros(3)})
    page.points("points", "dB", ("a", "b"), {"one": (1.0, np.nan), "two": (2.0, 3.0)})
    page.grid("grid", "dB", np.array([[1.0, np.nan], [np.nan, np.nan]]))
    page.grid("no numbers", "dB", np.full((2, 2), np.nan))
    page.histogram("histogram", "dB", np.array([np.inf, 1.0, 2.0]))
    page.pictures("pictures", {"one": np.zeros((2, 2, 3), np.uint8)})
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text(encoding="utf-8")
    assert "a &amp; b" in text and "&lt;i&gt;" in text and text.count("<img") == 6
