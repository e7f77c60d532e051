"""Stubs of the packages: type checkers see every public name with its type."""

from importlib import import_module
from pathlib import Path

import pytest

import wlm
from wlm._facade import places


def test_every_name_of_a_stub_is_there():
    root = Path(wlm.__file__).parent
    stubs = sorted(root.rglob("__init__.pyi"))
    assert len(stubs) >= 9 and (root / "py.typed").is_file()
    for path in stubs:
        package = import_module(".".join(path.parent.relative_to(root.parent).parts))
        names, lines = places(str(path)), path.read_text(encoding="utf-8").splitlines()
        assert set(package.__all__) - {"__version__"} == set(names) <= set(dir(package))
        assert len(names) == sum(line.startswith("from ") for line in lines), f"{path}: a line that is not read"
        assert all(getattr(package, name) is not None for name in names)
    with pytest.raises(AttributeError, match="module 'wlm.probe' has no attribute 'nothing'"):
        _ = wlm.probe.nothing


@pytest.mark.slow
def test_a_type_checker_sees_the_types(tmp_path):
    api = pytest.importorskip("mypy.api")
    code = "import wlm\nreveal_type(wlm.lightmap.compress)\nreveal_type(wlm.probe.load)\nreveal_type(wlm.load)\n"
    (tmp_path / "a.py").write_text(code)
    options = ["--config-file=", "--follow-imports=silent", "--ignore-missing-imports", f"--cache-dir={tmp_path / 'c'}"]
    text, _, _ = api.run([*options, str(tmp_path / "a.py")])
    assert "LightmapModel" in text and "ProbeSet" in text and text.count("Revealed type") == 3
    assert 'Revealed type is "Any"' not in text
