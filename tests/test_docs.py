"""The documents: their figures are those of the benchmarks, and the pages of results those that the command makes.

`docs/figures.json` lists the sources of figures for each document::

    {"lightmap.md": [
        {"text": "Profile M has", "figures": [["nvidia-h200/lightmap/city/ours/M", "psnr", "bpp .1f"]]},
        {"text": "| city", "table": ["nvidia-h200/atlas/AntiqueCamera day/ours", "psnr", "bytes"]}]}

`text` is the start of a paragraph, list or table; `after`, if given, a text before it. Figures are in the order of
the text. A source is a file of `benchmarks/`, then system, scene, method and option of a row; `FILE/SET/METHOD` of a
report; or `FILE.csv/STEP` of a training's curve. ` - ` between two sources is their difference, ` / ` their ratio. A
figure has the format of `benchmarks.figures` unless another follows its name. A `table` has all rows whose source
begins alike; its first columns are the rest of the source.
"""

import csv
import functools
import json
import re
from collections.abc import Mapping
from pathlib import Path

import pytest

from benchmarks import FIGURES, pages, read_json
from benchmarks.plots import digests as digests_of_plots
from demos.pictures import digests as digests_of_pictures

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
DOCUMENTS = [ROOT / "README.md", *sorted([*DOCS.glob("*.md"), *DOCS.glob("notes/*.md"), *DOCS.glob("tutorials/*.md")])]
RESULTS = sorted((DOCS / "results").glob("*.md"))
STATED = json.loads((DOCS / "figures.json").read_text(encoding="utf-8"))


def named(document: Path) -> str:
    """A document's name in `figures.json`, with the folder below docs."""
    return str(document.relative_to(DOCS)) if document.is_relative_to(DOCS) else document.name


@functools.cache
def sources(file: str) -> dict[str, Mapping[str, float]]:
    """The figures in a file of `benchmarks/`, by the rest of their source."""
    path = ROOT / "benchmarks" / file
    if path.suffix == ".csv":
        lines = csv.DictReader(path.read_text(encoding="utf-8").splitlines())
        return {line["step"]: {name: float(cell) for name, cell in line.items()} for line in lines}
    path = path.with_suffix(".json")
    if sets := json.loads(path.read_text(encoding="utf-8")).get("sets"):
        return {f"{images['name']}/{name}": images["methods"][name] for images in sets for name in images["methods"]}
    return {f"{row.system}/{row.scene}/{row.method}/{row.option}": row.figures for row in read_json(path)[0]}


def expected(source: str, figure: str, form: str = "") -> str:
    parts = re.split(r" ([-/]) ", source)
    values = [sources(file)[key][figure] for file, key in (part.split("/", 1) for part in parts[::2])]
    value = values[0] if len(values) == 1 else values[0] - values[1] if parts[1] == "-" else values[0] / values[1]
    return text_of(value, figure, form)


def text_of(value: float, figure: str, form: str = "") -> str:
    return FIGURES[figure].text(value, form) if figure in FIGURES else format(value, form)


def paragraph_of(text: str, entry: dict) -> str:
    """The paragraph, list or table of an entry, up to the next empty line."""
    start = text.index(entry["after"]) if "after" in entry else 0
    match = re.compile(rf"^{re.escape(entry['text'])}(?:.*\n)+?(?=\n|\Z)", re.M).search(text, start)
    assert match, f"no paragraph begins with {entry['text']!r}"
    return match[0]


def test_every_entry_is_of_a_document():
    assert STATED.keys() <= {named(path) for path in DOCUMENTS}


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_figures_are_those_of_the_benchmarks(document):
    text = document.read_text(encoding="utf-8")
    assert "<!--" not in text, "sources of figures belong into docs/figures.json"
    for entry in STATED.get(named(document), []):
        paragraph = paragraph_of(text, entry)
        start = 0
        for source, *figures in entry.get("figures", []):
            for figure in figures:
                number = expected(source, *figure.split())
                match = re.compile(rf"(?<![\w.,]){re.escape(number)}(?![\w]|[.,]\d)").search(paragraph, start)
                assert match, f"{source}: {figure}: expected {number} in {paragraph[start:]!r}"
                start = match.end()
        if "table" in entry:
            source, *figures = entry["table"]
            file, slash, method = source.partition("/")
            lines = []
            for key, row in sources(file).items():
                if key.startswith(method + slash):
                    numbers = ((row.get(figure.split()[0]), figure.split()) for figure in figures)
                    cells = ("" if number is None else text_of(number, *figure) for number, figure in numbers)
                    lines.append(f"| {' | '.join([*key.removeprefix(method + slash).split('/'), *cells])} |")
            assert paragraph.splitlines()[2:] == lines


def test_pages_of_results_are_those_that_the_command_makes(monkeypatch):
    monkeypatch.chdir(ROOT)
    results = [f"benchmarks/{name}.json" for name in ("nvidia-h200", "nvidia-h100", "cpu")]
    for name, page in pages(results, "docs/results.md").items():
        assert (DOCS / name).read_text(encoding="utf-8") == page, name
        rows = re.findall(r"^\| (?!---|method).*$", page, re.M)
        assert len(rows) <= 60 and max(map(len, (row.split("|") for row in rows)), default=0) <= 12, name


def test_the_gallery_shows_every_picture_beside_its_command():
    pictures = {path.name: path.stat().st_size for path in (DOCS / "images").glob("*.png")}
    text = (DOCS / "gallery.md").read_text(encoding="utf-8")
    shown = re.findall(r"^!\[.*\]\(images/(.*)\)\n\n.*\n\n    (python .*)$", text, re.M)
    assert sorted(name for name, _ in shown) == sorted(pictures) and max(pictures.values()) <= 400_000
    for name, command in shown:
        assert command.endswith("benchmarks plots" if name.startswith("bench-") else f"demos.pictures {name}")
        assert all((ROOT / script).is_file() for script in re.findall(r"python (demos/\w+\.py)", command)), command


def test_pictures_are_made_from_the_present_sources():
    stored = json.loads((DOCS / "images" / "sources.json").read_text(encoding="utf-8"))
    expected = {}
    for command, digests in (("benchmarks plots", digests_of_plots()), ("demos.pictures", digests_of_pictures())):
        stale = [name for name, digest in digests.items() if stored.get(name) != digest]
        assert not stale, f"{stale}: sources changed: run their demos and `python -m {command}`, and look at them"
        expected |= digests
    assert stored == expected
    assert stored.keys() == {path.name for path in (DOCS / "images").glob("*.png")}


def test_pages_are_short():
    for document in DOCUMENTS:
        most = 120 if document.parent.name == "tutorials" else 250
        assert document.read_text(encoding="utf-8").count("\n") <= most, named(document)


def test_links_lead_to_headings():
    for document in DOCUMENTS:
        for path, anchor in re.findall(r"\]\(([^)#:]*)#([^)]*)\)", document.read_text(encoding="utf-8")):
            target = document.parent / path if path else document
            headings = re.findall(r"^#+ (.*)$", target.read_text(encoding="utf-8"), re.M)
            slugs = [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings]
            assert anchor in slugs, f"{named(document)}: {path}#{anchor}"


def test_files_that_documents_link_are_there():
    for document in DOCUMENTS + RESULTS:
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", document.read_text(encoding="utf-8")):
            assert (document.parent / link).exists(), f"{document.name}: {link}"
