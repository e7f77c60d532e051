"""CUDA C++ in files of its own: read as part of the package, and packaged."""

import runpy
from fnmatch import fnmatch
from pathlib import Path

import pytest

from wlm_kernels.native import native_source

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "wlm_kernels").rglob("*.cuh"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_each_file_is_packaged_and_read(file, monkeypatch):
    options = {}
    monkeypatch.setattr(pytest.importorskip("setuptools"), "setup", options.update)
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / "setup.py"))
    folder = file.parents[1]
    package = ".".join(folder.relative_to(ROOT).parts)
    patterns = [pattern for name in ("", package) for pattern in options["package_data"].get(name, [])]
    assert package in options["packages"]
    assert any(fnmatch(file.relative_to(folder).as_posix(), pattern) for pattern in patterns)
    assert file.read_text().startswith("//"), "a comment says what it is and why it is native"
    assert native_source(package, file.stem, N=4) == "constexpr int N = 4;\n" + file.read_text()
