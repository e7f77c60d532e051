"""A process that runs cases: it imports once, answers with a line a case, and may be killed by any of them.

    python -m tests.fuzz.worker MODULE SECONDS WAIT MEMORY

It takes jobs as lines of JSON: `{"reader": NAME, "first": INDEX, "count": N}`. It answers `"ready"` once the reader has
accepted its good files, so that kernels are compiled and packages imported before anything is timed, and then
`[index, outcome, detail]` for each case.
"""

import importlib
import json
import os
import shutil
import sys
import tempfile
import traceback
import unicodedata
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from .limits import Limits, out_of_memory
from .reader import Reader

ROOT = Path(__file__).resolve().parents[2]

FAILURES = ("traceback", "wrong", "message", "left", "memory", "time", "crash")
"""Outcomes that must not be: another error than `WlmError`; accepted against the format; a `WlmError` that isn't one
plain line; files left behind; memory or time beyond the limit; death by a signal."""

_MOST_MESSAGE = 2000  # characters


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case."""

    index: int
    kind: str
    detail: str

    @property
    def failed(self) -> bool:
        return self.kind in FAILURES


def judge(reader: Reader, path: Path, limits: Limits) -> tuple[str, str]:
    """Reads a file that lies alone, or beside what belongs to it, in a folder; gives an outcome and its detail."""
    from wlm.errors import WlmError

    folder = path.parent
    before = sorted(folder.rglob("*"))
    try:
        with limits.held():
            reader.read(path)
    except WlmError as error:
        kind, detail = "refused", str(error)
        if out_of_memory(error):
            kind = "memory"
        elif fault := _fault(detail, folder):
            kind, detail = "message", f"{fault}: {detail!r}"
    except AssertionError as error:
        kind, detail = "wrong", str(error)
    except Exception as error:
        kind = "memory" if out_of_memory(error) else "traceback"
        detail = f"{_place(error)}: {type(error).__name__}: {error}"
    else:
        kind, detail = "accepted", ""
    if left := sorted(set(folder.rglob("*")) - set(before)):
        kind, detail = "left", ", ".join(str(each.relative_to(folder)) for each in left)
    return kind, detail[:600]


def _fault(message: str, folder: Path) -> str:
    """Returns the fault of an error message; empty if it is one plain line that names the file."""
    bad = {char for char in message if unicodedata.category(char) in ("Cc", "Cs", "Zl", "Zp")}
    if bad:
        return f"control characters {sorted(map(ascii, bad))}"
    if not message or len(message) > _MOST_MESSAGE:
        return f"{len(message)} characters"
    return "" if str(folder) in message else "does not name the file"


def _place(error: BaseException) -> str:
    """The last line of our own code that an error went through."""
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if f"{os.sep}wlm" in frame.filename]
    frames = frames or traceback.extract_tb(error.__traceback__)
    file = Path(frames[-1].filename)
    return f"{file.relative_to(ROOT) if file.is_relative_to(ROOT) else file.name}:{frames[-1].lineno}"


class _Bench:
    """The folders in which cases are read."""

    def __init__(self, readers: dict[str, Reader], root: Path, limits: Limits) -> None:
        self.readers, self.root, self.limits = readers, root, limits
        self.ready: set[str] = set()

    def _folder(self, name: str) -> Path:
        return self.root / name

    def prepare(self, name: str) -> None:
        """Checks that a reader accepts its good files; imports and compiles what it needs."""
        if name in self.ready:
            return
        reader = self.readers[name]
        for number, seed in enumerate(reader.seeds()):
            # Without limits: the first call of a kernel compiles it.
            path = self._write(name, seed)
            try:
                reader.read(path)
            except Exception as error:
                raise AssertionError(f"{name}: expected seed {number} to be accepted: {error}") from error
        self.ready.add(name)

    def _write(self, name: str, data: bytes) -> Path:
        """Lays a case's file into the reader's folder, beside what belongs to it."""
        folder = self._folder(name)
        if not folder.exists():
            folder.mkdir()
            for beside, content in self.readers[name].beside().items():
                (folder / beside).write_bytes(content)
        path = folder / self.readers[name].file
        path.write_bytes(data)
        return path

    def run(self, name: str, index: int) -> tuple[str, str]:
        """Makes and reads one case."""
        reader = self.readers[name]
        result = judge(reader, self._write(name, reader.case(index)), self.limits)
        if result[0] in FAILURES:
            # Whatever it left must not be there for the next.
            shutil.rmtree(self._folder(name))
        return result


def main(module: str, limits: Limits) -> None:
    """Runs the jobs that come on stdin until there are no more."""
    answers = os.fdopen(os.dup(1), "w")
    silence = os.open(os.devnull, os.O_WRONLY)
    # What libraries print is of no interest, and must not be taken for an answer.
    os.dup2(silence, 1)
    sys.path.append(str(ROOT / "tests"))
    warnings.simplefilter("ignore")
    readers = importlib.import_module(module).READERS
    os.dup2(silence, 2)
    with tempfile.TemporaryDirectory(prefix="wlm-fuzz-") as root:
        bench = _Bench(readers, Path(root), limits)
        for line in sys.stdin:
            _serve(bench, json.loads(line), answers)


def _serve(bench: _Bench, job: dict, answers: TextIO) -> None:
    def answer(value: object) -> None:
        answers.write(json.dumps(value) + "\n")
        answers.flush()

    try:
        bench.prepare(job["reader"])
        answer("ready")
        for index in range(job["first"], job["first"] + job["count"]):
            answer([index, *bench.run(job["reader"], index)])
    except Exception:
        # Of the harness: what a reader raises is an outcome.
        answer({"error": traceback.format_exc()})


if __name__ == "__main__":
    main(sys.argv[1], Limits(float(sys.argv[2]), float(sys.argv[3]), int(sys.argv[4])))
