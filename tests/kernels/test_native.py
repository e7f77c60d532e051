"""CUDA C++ in files of its own: read as part of the package, and packaged."""

import runpy
from fnmatch import fnmatch
from pathlib import Path
from string import Template

import pytest
import setuptools

from wlm_kernels.native import native_source

ROOT = Path(__file__).resolve().parents[2]
FILES = sorted((ROOT / "wlm_kernels").rglob("*.cuh"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_each_file_is_packaged_and_read(file, monkeypatch):
    options = {}
    monkeypatch.setattr(setuptools, "setup", options.update)
    monkeypatch.chdir(ROOT)
    runpy.run_path(str(ROOT / "setup.py"))
    folder = file.parents[1]
    package = ".".join(folder.relative_to(ROOT).parts)
    patterns = [pattern for name in ("", package) for pattern in options["package_data"].get(name, [])]
    assert package in options["packages"]
    assert any(fnmatch(file.relative_to(folder).as_posix(), pattern) for pattern in patterns)
    head, code = file.read_text().split("\n\n", 1)
    assert all(line.startswith("//") for line in head.splitlines())
    source = native_source(package, file.stem, **dict.fromkeys(Template(code).get_identifiers(), 4))
    assert "$" not in source and source.count("\n") == code.count("\n") + 1


def test_a_number_that_is_missing():
    with pytest.raises(KeyError, match="warps"):
        native_source("wlm_kernels.probe", "block_sum", numbers=4)
