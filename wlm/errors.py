"""The error class for messages to the user, and which errors are those of a broken package."""

import sys
from traceback import walk_tb
from types import FrameType

_LIMIT = 2000  # characters: enough for several long paths

# Control characters, which a terminal interprets, and bidirectional marks, which can hide part of the text.
_CONTROLS = (*range(0x20), *range(0x7F, 0xA0))
_MARKS = (0x061C, 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A))
_ESCAPES = {code: f"\\x{code:02x}" for code in _CONTROLS} | {code: f"\\u{code:04x}" for code in _MARKS}
_ESCAPES[ord("\t")] = " "


def printable(text: str) -> str:
    r"""Escapes control characters and lone surrogates in a line, because names can come from untrusted files; an escape
    character becomes `\x1b`, for example."""
    return text.translate(_ESCAPES).encode("utf-8", "backslashreplace").decode()


def one_line(text: object, limit: int = _LIMIT) -> str:
    """Joins the lines of a message, escapes control characters, and truncates the result to `limit` characters, "..."
    at its end."""
    line = printable(" ".join(part.strip() for part in str(text).splitlines() if part.strip()))
    return line if len(line) <= limit else line[: limit - 3].rstrip() + "..."


def counted(number: int, noun: str, plural: str = "") -> str:
    """Returns a number of things in words: "1 texel", "2 texels"; `plural` is that of nouns without a final s."""
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"


class WlmError(Exception):
    """An error that the user can act on: one line that names the file, the field and what was expected. The command
    line shows the line alone. Wrong use of a function by a programmer is a `ValueError` or a `TypeError` instead."""

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))


def broken_package(error: BaseException) -> str:
    """Returns the name of the package whose import raised an error: one that is missing, or whose files or shared
    libraries are damaged or do not fit together; "" if the error has another cause."""
    if isinstance(error, ImportError) and error.name:
        found = error.name
    elif isinstance(error, SyntaxError):
        found = _package_of(error.filename or "")
    elif isinstance(error, ImportError) and type(error) not in (ImportError, ModuleNotFoundError):
        found = type(error).__module__  # the class of a package that imports its parts on demand, as imagecodecs does
    else:
        # Code of a module at its top level runs while it is imported.
        names = [str(frame.f_globals.get("__name__")) for frame, _ in walk_tb(error.__traceback__) if _is_top(frame)]
        found = next((name for name in names if not _own(name)), "wlm")
    return "" if _own(found) else found.split(".")[0]


def _is_top(frame: FrameType) -> bool:
    return frame.f_code.co_name == "<module>"


def _own(module: str) -> bool:
    return module.split(".", 1)[0] in ("", "__main__", "wlm", "wlm_kernels")


def _package_of(file: str) -> str:
    """Returns the name of the package in a folder of `sys.path` that a Python file belongs to, "" if none."""
    inside = [file.removeprefix(f"{folder}/") for folder in sys.path if folder and file.startswith(f"{folder}/")]
    return min(inside, key=len).split("/")[0].removesuffix(".py") if inside else ""
