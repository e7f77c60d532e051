"""Readers with the faults that fuzzing looks for, each in its own way, to test what finds them."""

import os
import time
from collections.abc import Callable
from pathlib import Path

from wlm.errors import WlmError

from .reader import Reader

_GOOD = b"good"


def _refuse(path: Path) -> None:
    raise WlmError(f"{path}: expected something else")


def _raise(path: Path) -> None:
    raise KeyError("part")


def _control(path: Path) -> None:
    error = WlmError(path)
    # Its maker escapes them.
    error.args = (f"{path}: found \x1b[31m",)
    raise error


def _nameless(path: Path) -> None:
    raise WlmError("expected something else")


def _hog(path: Path) -> None:
    try:
        path.write_bytes(bytes(1 << 40))
    except MemoryError as error:
        raise WlmError(f"{path}: too large") from error


def _leave(path: Path) -> None:
    path.with_name("temporary").touch()


def _accept_wrong(path: Path) -> None:
    raise AssertionError("accepted, but it is not")


def _spin(path: Path) -> None:
    while True:
        path.exists()


def _reader(name: str, fault: Callable[[Path], None]) -> Reader:
    """A reader that accepts its good file, as every reader must, and has a fault with any other."""

    def read(path: Path) -> None:
        if path.read_bytes() != _GOOD:
            fault(path)

    return Reader(name, "a", lambda: (_GOOD,), lambda draw, data: b"bad", read, blind=0.0)


_PICKY = Reader("picky", "a", lambda: (_GOOD,), lambda draw, data: b"bad", _refuse, blind=0.0)
READERS = {"picky": _PICKY} | {
    name: _reader(name, fault)
    for name, fault in {
        "accepted": Path.exists,
        "refused": _refuse,
        "traceback": _raise,
        "control": _control,
        "nameless": _nameless,
        "memory": _hog,
        "left": _leave,
        "wrong": _accept_wrong,
        "spin": _spin,
        "wait": lambda path: time.sleep(3600.0),
        "crash": lambda path: os.abort(),
    }.items()
}
"""The readers by name."""
