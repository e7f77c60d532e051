"""Runs the notebooks of `notebooks/` and stores what their cells show, so that they can be read without running them.

    python -m demos.notebooks               # all; with names, some

The last expression of a cell is shown, as in Jupyter: a picture as such, anything else as text. A digest of the code is
kept in the notebook, by which a test finds outputs that are older than their code.
"""

from __future__ import annotations

import ast
import base64
import io
import json
import os
import sys
import tempfile
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

from PIL import Image

from benchmarks.plots import digest
from wlm.cli.console import quiet_warp
from wlm.formats.atomic import atomic_write

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


def code_of(notebook: dict[str, Any]) -> list[str]:
    """Returns the code of each cell that has some."""
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]


def digest_of(notebook: dict[str, Any]) -> str:
    """Returns the digest of a notebook's code."""
    return digest("\n".join(code_of(notebook)).encode())


def run(code: list[str]) -> list[list[dict[str, Any]]]:
    """Runs cells one after the other in the current folder, and returns the outputs of each in Jupyter's form."""
    names: dict[str, Any] = {"__name__": "__main__"}
    outputs = []
    for number, text in enumerate(code, 1):
        tree, shown, printed = ast.parse(text), None, io.StringIO()
        last = tree.body.pop() if isinstance(tree.body[-1], ast.Expr) else None
        with redirect_stdout(printed):
            exec(compile(tree, f"cell {number}", "exec"), names)
            if last is not None:
                shown = eval(compile(ast.Expression(last.value), f"cell {number}", "eval"), names)
        made: list[dict[str, Any]] = []
        if lines := printed.getvalue().splitlines(keepends=True):
            made.append({"name": "stdout", "output_type": "stream", "text": lines})
        if shown is not None:
            made.append({"data": _data(shown), "metadata": {}, "output_type": "display_data"})
        outputs.append(made)
    return outputs


def _data(shown: Any) -> dict[str, str]:
    if not isinstance(shown, Image.Image):
        return {"text/plain": repr(shown)}
    file = io.BytesIO()
    # Levels in threes are a third smaller, and look the same.
    shown.convert("RGB").point(lambda level: (level + 1) // 3 * 3).save(file, "PNG", optimize=True)
    return {"image/png": base64.b64encode(file.getvalue()).decode(), "text/plain": f"picture {shown.size}"}


def refresh(path: Path) -> None:
    """Runs a notebook in a temporary folder with a link to the demos, and writes it with its outputs."""
    notebook = json.loads(path.read_text(encoding="utf-8"))
    before = Path.cwd()
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "demos").symlink_to(ROOT / "demos")
        os.chdir(folder)
        try:
            outputs = run(code_of(notebook))
        finally:
            os.chdir(before)
    cells = (cell for cell in notebook["cells"] if cell["cell_type"] == "code")
    for number, (cell, made) in enumerate(zip(cells, outputs, strict=True), 1):
        cell.update(outputs=made, execution_count=number)
    notebook["metadata"]["wlm"] = {"code": digest_of(notebook)}
    atomic_write(path, (json.dumps(notebook, indent=1, ensure_ascii=False) + "\n").encode())
    print(f"{path.name}: {path.stat().st_size:,} bytes")


if __name__ == "__main__":
    quiet_warp()
    for each in NOTEBOOKS:
        if len(sys.argv) == 1 or each.stem in sys.argv[1:]:
            refresh(each)
