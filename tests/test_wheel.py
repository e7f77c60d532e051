"""The release: a wheel from the source archive has every file and works alone, and the version is stated alike."""

import os
import re
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path

import pytest
import yaml

import wlm

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "demos" / "data" / "cornell"
# Their needs beside Python: kernels and profiles, a page's scripts, a kit, meshes of a scene, weights.
COMMANDS = (
    ("compress", DATA, "-o", "room.wlm", "--steps", 10),
    ("web", "room.wlm", "-o", "room.html"),
    ("export", "room.wlm", "-o", "kit", "--engine", "three"),
    ("smoke", "simulate", "fan", "-o", "fan", "--scale", 0.15, "--frames", 1),
    ("smoke", "predict", "fan", "-o", "six", "--resolution", 32, "--network", "fast"),
)


def run(*words: object, **options: object) -> str:
    done = subprocess.run([*map(str, words)], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
def test_a_wheel_works_outside_the_checkout(tmp_path):
    # Of a copy, so that nothing which earlier builds left in the checkout gets in.
    tracked = run("git", "ls-files", "configs", "wlm", "wlm_kernels", cwd=ROOT).splitlines()
    for name in [*tracked, "pyproject.toml", "setup.py", "README.md", "LICENSE"]:
        (tmp_path / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "source" / name).write_bytes((ROOT / name).read_bytes())
    # Without isolation: an isolated build would download setuptools.
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path, tmp_path / "source")
    (wheel,) = tmp_path.glob(f"wlm-{wlm.__version__}-*.whl")
    names = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert names == {re.sub("^configs/", "wlm/configs/", name) for name in tracked}
    # The packages that the wheel requires are this environment's.
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    (packages,) = (tmp_path / "venv").glob("lib/*/site-packages")
    (packages / "required.pth").write_text(sysconfig.get_path("purelib"))
    python = tmp_path / "venv" / "bin" / "python"
    (tmp_path / "empty").mkdir()
    here = {"cwd": tmp_path / "empty", "env": {**os.environ, "PYTHONPATH": ""}}
    run(python, "-m", "pip", "install", "--no-deps", "--no-index", wheel, **here)
    assert run(python, "-c", "import wlm; print(wlm.__file__)", **here).startswith(str(packages))
    for command in COMMANDS:
        assert run(tmp_path / "venv" / "bin" / "wlm", *command, **here)


def test_the_version_is_stated_alike():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    (version, date), *_ = re.findall(r"^## (\d\S*) - (\S+)$", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.M)
    assert (wlm.__version__, wlm.__version__, date) == (version, citation["version"], str(citation["date-released"]))
