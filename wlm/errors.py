"""The error class for messages to the user."""

_LIMIT = 2000  # characters: enough for several long paths

# Control characters, which a terminal interprets, and bidirectional marks, which can hide part of the text.
_CONTROLS = (*range(0x20), *range(0x7F, 0xA0))
_MARKS = (0x061C, 0x200E, 0x200F, *range(0x2028, 0x202F), *range(0x2066, 0x206A))
_ESCAPES = {code: f"\\x{code:02x}" for code in _CONTROLS} | {code: f"\\u{code:04x}" for code in _MARKS}
_ESCAPES[ord("\t")] = " "


def printable(text: str) -> str:
    r"""Escapes control characters and lone surrogates, because names can come from untrusted files.

    Args:
        text: One line.

    Returns:
        The text with `\x1b` in place of an escape character, for example.
    """
    return text.translate(_ESCAPES).encode("utf-8", "backslashreplace").decode()


def one_line(text: object, limit: int = _LIMIT) -> str:
    """Joins the lines of a message, escapes control characters, and truncates the result to `limit` characters, "..."
    at its end.
    """
    line = printable(" ".join(part.strip() for part in str(text).splitlines() if part.strip()))
    return line if len(line) <= limit else line[: limit - 3].rstrip() + "..."


class WlmError(Exception):
    """An error that the user can act on: one line that names the file, the field and what was expected.

    The command line shows the line alone. Wrong use of a function by a programmer is a `ValueError` or a
    `TypeError` instead.
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))
