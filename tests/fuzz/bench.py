"""Reads cases within limits of time and memory."""

import os
import resource
import shutil
import signal
import traceback
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .reader import Reader

ROOT = Path(__file__).resolve().parents[2]

FAILURES = ("traceback", "wrong", "message", "left", "memory")
"""Outcomes that must not be: another error than `WlmError`; accepted against the format; a `WlmError` that isn't one
plain line; files left behind; memory beyond the limit. Time beyond the limit ends the process."""

_MOST_MESSAGE = 2000  # characters


@dataclass(frozen=True)
class Limits:
    """The limits of a case in seconds of the processor, in seconds, and in bytes, held by the system: nothing that the
    case does in C or Python gets round them."""

    seconds: float = 5.0
    wait: float = 60.0
    memory: int = 2 << 30

    @contextmanager
    def held(self) -> Iterator[None]:
        """Holds this process to the time and the memory."""
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + self.memory, hard))
        timers = {signal.ITIMER_PROF: self.seconds, signal.ITIMER_REAL: self.wait}
        for timer, seconds in timers.items():
            signal.setitimer(timer, seconds)
        try:
            yield
        finally:
            for timer in timers:
                signal.setitimer(timer, 0.0)
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY if hard < 0 else hard, hard))


@dataclass(frozen=True)
class Outcome:
    """The outcome of a case."""

    index: int
    kind: str
    detail: str

    @property
    def failed(self) -> bool:
        return self.kind in FAILURES


class Bench:
    """A table of readers by name, and the folders in which their cases are read."""

    def __init__(self, root: str | Path, limits: Limits, readers: Mapping[str, Reader]) -> None:
        self._root, self._limits, self._readers = Path(root), limits, readers

    def prepare(self, name: str) -> None:
        """Checks that a reader accepts its good files; imports and compiles what it needs, without limits."""
        reader = self._readers[name]
        for number, seed in enumerate(reader.seeds()):
            try:
                reader.read(self.write(name, seed))
            except Exception as error:
                raise AssertionError(f"{name}: expected seed {number} to be accepted: {error}") from error

    def write(self, name: str, data: bytes) -> Path:
        """Lays a case's file into the reader's folder, beside what belongs to it."""
        folder, reader = self._root / name, self._readers[name]
        if not folder.exists():
            folder.mkdir(parents=True)
            for beside, content in reader.beside().items():
                (folder / beside).write_bytes(content)
        path = folder / reader.file
        path.write_bytes(data)
        return path

    def run(self, name: str, index: int) -> Outcome:
        """Makes and reads one case."""
        path = self.write(name, self._readers[name].case(index))
        kind, detail = self._judge(self._readers[name], path)
        if kind in FAILURES:
            # Whatever it left must not be there for the next.
            shutil.rmtree(path.parent)
        return Outcome(index, kind, detail[:600])

    def _judge(self, reader: Reader, path: Path) -> tuple[str, str]:
        from wlm.errors import WlmError

        before = set(path.parent.rglob("*"))
        try:
            with self._limits.held():
                reader.read(path)
        except WlmError as error:
            kind, detail = "refused", str(error)
            if _out_of_memory(error):
                kind = "memory"
            elif fault := _fault(detail, path.parent):
                kind, detail = "message", f"{fault}: {detail!r}"
        except AssertionError as error:
            kind, detail = "wrong", str(error)
        except Exception as error:
            kind = "memory" if _out_of_memory(error) else "traceback"
            detail = f"{_place(error)}: {type(error).__name__}: {error}"
        else:
            kind, detail = "accepted", ""
        if left := sorted(set(path.parent.rglob("*")) - before):
            kind, detail = "left", ", ".join(str(each.relative_to(path.parent)) for each in left)
        return kind, detail


def _out_of_memory(error: BaseException | None) -> bool:
    """Whether an error, or one that it was made of, says that memory could not be had."""
    while error is not None:
        if isinstance(error, MemoryError) or (isinstance(error, RuntimeError) and "alloc" in str(error).lower()):
            return True
        error = error.__cause__ or error.__context__
    return False


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
