"""The package as a user meets it: its public names, and the example of its docstring and of its page."""

from pathlib import Path

import pytest

from wlm import fluid

PAGE = Path(__file__).resolve().parents[2] / "docs" / "fluid.md"


@pytest.mark.parametrize("text", [fluid.__doc__, PAGE.read_text(encoding="utf-8").split("\n## ")[0]])
def test_the_example_runs(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """In fewer steps."""
    monkeypatch.chdir(tmp_path)
    code = "\n".join(line[4:] for line in text.splitlines() if line.startswith("    "))
    assert "smoke.step(100)" in code
    exec(code.replace("smoke.step(100)", "smoke.step(2)"), {})
    assert float(fluid.load_volume("smoke.npz").density.sum()) > 0.0
