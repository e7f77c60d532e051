"""docs/ops.md: every code block of it, run as written; its links and its pictures are there."""

import re
from pathlib import Path

import pytest
import torch

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "ops.md").read_text(encoding="utf-8")
BLOCKS = dict(re.findall(r"^## (\S+?),?(?: [^\n]*)?\n(?:(?!^## ).)*?```python\n(.*?)```", PAGE, re.S | re.M))


@pytest.mark.parametrize("section", BLOCKS)
def test_block(section: str):
    torch.manual_seed(0)
    exec(compile(BLOCKS[section], f"docs/ops.md, {section}", "exec"), {"__name__": "__main__"})


def test_page():
    assert [*BLOCKS] == ["bc7_map", "plane", "mlp", "gaussian_sum", "rasterize", "march"]
    for target in re.findall(r"\]\(([^)#\s]+)\)", PAGE):
        assert (ROOT / "docs" / target).exists(), target
