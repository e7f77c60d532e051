"""README, tutorials and notebooks: all of their steps, run as printed in a temporary folder."""

import json
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest
from builders.running import call

from demos.notebooks import NOTEBOOKS, code_of, digest_of, run
from demos.tutorials import TUTORIALS, steps
from wlm.formats.exr import read_exr, write_exr
from wlm.system import Settings

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / "README.md"
DOCUMENTS = [README, *TUTORIALS]
# Left out where fits are short: what simulates or scores pictures, and what reads the output of these.
LONG = ("wlm smoke", "wlm evaluate hall.wlm", "wlm evaluate room.wlm", "wlm web six")
LONG += ("wlm run demos/data/street", "wlm web demos/data/street")
MOST_BYTES = 7168


@pytest.fixture
def few_steps(tmp_path, monkeypatch) -> None:
    """Changes to a folder with a part of the demos' data, and shortens every fit to some steps."""
    shutil.copytree(ROOT / "demos" / "data", tmp_path / "demos" / "data")
    city, room = (tmp_path / "demos" / "data" / name for name in ("city/set.json", "atlas/room.exr"))
    listed = json.loads(city.read_text())
    city.write_text(json.dumps(listed | {"lightmaps": listed["lightmaps"][::8]}))
    write_exr(room, read_exr(room)[0][::2, ::2])
    monkeypatch.chdir(tmp_path)
    override = Settings.override

    def short(self, values, prefix=""):
        settings = override(self, values, prefix)
        few = {"steps": 12, "samples": 128, "ratio": 0.02, "views": 1}
        known = {name: value for name, value in few.items() if name in type(settings).model_fields}
        return override(settings, known)

    monkeypatch.setattr(Settings, "override", short)


def take(kind: str, text: str) -> None:
    """Takes a step in the current folder."""
    words = shlex.split(text) if kind == "command" else []
    if words[:1] == ["wlm"]:
        assert call(*words[1:])
    elif words:
        subprocess.run(words, check=True)
    elif kind == "python":
        exec(compile(text, "a block of a document", "exec"), {"__name__": "__main__"})
    else:
        Path(kind).write_text(text, encoding="utf-8")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_steps(document, few_steps):
    taken = [step for step in steps(document) if not step[1].startswith(LONG)]
    if document.stem == "smoke":
        taken = [step for step in taken if step[0].endswith("yaml")]
    assert taken
    for step in taken:
        take(*step)


@pytest.mark.slow
@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.stem)
def test_all_steps(document, tmp_path, monkeypatch):
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    monkeypatch.chdir(tmp_path)
    for step in steps(document):
        take(*step)


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebooks(path, tmp_path, monkeypatch):
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    monkeypatch.chdir(tmp_path)
    shown = run(code_of(json.loads(path.read_text(encoding="utf-8"))))
    assert sum("image/png" in output.get("data", {}) for outputs in shown for output in outputs) >= 3


def test_notebooks_keep_what_their_code_shows():
    assert len(NOTEBOOKS) == 3
    for path in NOTEBOOKS:
        notebook = json.loads(path.read_text(encoding="utf-8"))
        fresh = notebook["metadata"]["wlm"]["code"] == digest_of(notebook)
        assert fresh, f"{path.name}: code changed: run `python -m demos.notebooks {path.stem}`, and look at it"


def test_readme_is_short_and_every_step_is_found():
    assert len(README.read_bytes()) <= MOST_BYTES
    assert len(list(steps(README))) >= 14 and sum(len(list(steps(tutorial))) for tutorial in TUTORIALS) >= 45
