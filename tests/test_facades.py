"""Stubs of the packages: type checkers see every public name with its type."""

from pathlib import Path

import pytest

import wlm
from wlm._facade import packages


def test_the_stubs_are_those_of_the_packages():
    root = Path(wlm.__file__).parent
    found = packages(root)
    assert len(found) >= 9 and set(found) == set(root.rglob("__init__.pyi"))
    for path, text in found.items():
        assert path.read_text(encoding="utf-8") == text, f"{path}: run python -m wlm._facade"
    assert (root / "py.typed").is_file()


@pytest.mark.slow
def test_a_type_checker_sees_the_types(tmp_path):
    api = pytest.importorskip("mypy.api")
    code = "import wlm\nreveal_type(wlm.lightmap.compress)\nreveal_type(wlm.probe.load)\nreveal_type(wlm.load)\n"
    (tmp_path / "a.py").write_text(code)
    options = ["--config-file=", "--follow-imports=silent", "--ignore-missing-imports", f"--cache-dir={tmp_path / 'c'}"]
    text, _, _ = api.run([*options, str(tmp_path / "a.py")])
    assert "LightmapModel" in text and "ProbeSet" in text and text.count("Revealed type") == 3
    assert 'Revealed type is "Any"' not in text
