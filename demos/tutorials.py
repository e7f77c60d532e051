"""Follows the tutorials as they are printed: their files, commands and snippets, in order.

    python demos/tutorials.py            # into demos/out/tutorials/NAME, for `make pictures`

A line of four spaces and a command is run, a block of Python too; a block of HTML or YAML is the file that the sentence
before it names. `npm install` and a web server are left to the reader.
"""

from __future__ import annotations

import argparse
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
_STEP = re.compile(
    r"^    (?P<command>(?:wlm|cp) [^\n]*?)(?: +#[^\n]*)?$"
    r"|^```python\n(?P<python>.*?)^```$"
    r"|`(?P<file>[\w.-]+)`[^`\n]*:\n\n```(?:html|yaml)\n(?P<content>.*?)^```$",
    re.M | re.S,
)


def steps(document: Path) -> Iterator[tuple[str, str]]:
    """Yields the steps of a document: ("command", line), ("python", code), or a file's name and its content."""
    for match in _STEP.finditer(document.read_text(encoding="utf-8")):
        if match["file"]:
            yield match["file"], match["content"]
        else:
            yield ("command", match["command"]) if match["command"] else ("python", match["python"])


def follow(document: Path, folder: Path) -> None:
    """Follows a document in an empty folder with a link to the demos.

    Raises:
        subprocess.CalledProcessError: A command or a snippet failed.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    (folder / "demos").symlink_to(ROOT / "demos")
    for kind, text in steps(document):
        print(f"{document.stem}: {text.splitlines()[0]}", flush=True)
        if kind == "command":
            words = shlex.split(text)
            program = [sys.executable, "-m", "wlm"] if words[0] == "wlm" else words[:1]
            subprocess.run([*program, *words[1:]], cwd=folder, check=True)
        elif kind == "python":
            subprocess.run([sys.executable, "-c", text], cwd=folder, check=True)
        else:
            (folder / kind).write_text(text, encoding="utf-8")


def main() -> None:
    """Reads the command line and follows the tutorials."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", help="tutorials by name; default all")
    parser.add_argument("--out", type=Path, default=ROOT / "demos" / "out" / "tutorials", help="the folder to write to")
    args = parser.parse_args()
    for document in TUTORIALS:
        if not args.names or document.stem in args.names:
            follow(document, args.out / document.stem)


if __name__ == "__main__":
    main()
