"""README: its size, its links, and all of its snippets and commands, run as written in a temporary folder."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest
from builders.running import call

from wlm.formats.exr import read_exr, write_exr
from wlm.system import Settings

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PYTHON = re.findall(r"```python\n(.*?)```", README, re.S)
COMMANDS = re.findall(r"^    (wlm .*?)(?: +#.*)?$", README, re.M)
SLOW = ("wlm smoke simulate", "wlm smoke predict")  # predict reads the output of simulate
MOST_BYTES = 7168


@pytest.fixture
def checkout(tmp_path, monkeypatch) -> None:
    """Changes to a temporary folder with a link to the repository's demos."""
    (tmp_path / "demos").symlink_to(ROOT / "demos")
    monkeypatch.chdir(tmp_path)


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


@pytest.mark.parametrize("number", range(len(PYTHON)))
def test_python(number, few_steps):
    exec(compile(PYTHON[number], f"README.md, block {number}", "exec"), {"__name__": "__main__"})


@pytest.mark.slow
def test_python_with_all_steps(checkout):
    for number, block in enumerate(PYTHON):
        exec(compile(block, f"README.md, block {number}", "exec"), {"__name__": "__main__"})


def run(commands: list[str]) -> None:
    for command in commands:
        assert call(*shlex.split(command)[1:])


def test_commands(few_steps):
    assert len(COMMANDS) >= 8
    run([command for command in COMMANDS if not command.startswith(SLOW)])


@pytest.mark.slow
def test_all_commands(checkout):
    run(COMMANDS)


def test_it_is_short_and_its_links_lead_somewhere():
    assert len(README.encode()) <= MOST_BYTES
    for target in re.findall(r"\]\((?!http)([^)\s]+)\)", README):
        path, _, anchor = target.partition("#")
        assert (ROOT / path).exists(), target
        if anchor:
            headings = re.findall(r"^#+ (.*)$", (ROOT / path).read_text(encoding="utf-8"), re.M)
            assert anchor in [re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings], (
                target
            )
