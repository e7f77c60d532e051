"""The one kind of error that is meant for the user."""

_LIMIT = 2000  # characters: room for several long paths


def one_line(text: object, limit: int = _LIMIT) -> str:
    """Joins the lines of a message and cuts it to a length.

    Args:
        text: Anything whose `str` is the message.
        limit: The most characters to keep; a cut message ends in "...".

    Returns:
        The message on one line.
    """
    line = " ".join(part.strip() for part in str(text).splitlines() if part.strip())
    return line if len(line) <= limit else line[: limit - 3].rstrip() + "..."


class WlmError(Exception):
    """An error that the user can act on: one line that names the file, the field and what was expected.

    The command line shows the line alone. Wrong use of a function by a programmer is a `ValueError` or a
    `TypeError` instead.
    """

    def __init__(self, message: object) -> None:
        super().__init__(one_line(message))
