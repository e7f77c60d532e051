"""A description of a file or a folder, and the commands that it may name."""

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wlm.errors import printable

UNREADABLE = "cannot be read"
"""Description of unreadable files and folders."""


@dataclass(frozen=True)
class Finding:
    """Description of a file, of a folder, or of files in a folder that belong together.

    Attributes:
        path: The file or the folder.
        what: The content, in one line.
        command: A command that reads it and works as written; "" where there is none.
        problems: Missing or damaged files and suspicious values, one line each.
    """

    path: Path
    what: str
    command: str = ""
    problems: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        # Names in them may contain line breaks.
        object.__setattr__(self, "what", printable(self.what))
        object.__setattr__(self, "problems", tuple(map(printable, self.problems)))

    def to_json(self) -> dict[str, Any]:
        """Returns the finding as JSON values."""
        return {"path": str(self.path), "what": self.what, "command": self.command, "problems": list(self.problems)}


def command(*words: str | Path) -> str:
    """Returns a `wlm` command line of the words, quoted for a shell: sh, or bash for names with control characters."""
    return " ".join(["wlm", *map(_quoted, words)])


def compress_command(*words: str | Path) -> str:
    """Returns the command line that compresses the given inputs, with options among the words."""
    return command("compress", *words, "-o", "OUT.wlm")


def _quoted(word: str | Path) -> str:
    # A path that begins with a dash would be read as an option.
    text = f"./{word}" if isinstance(word, Path) and str(word)[0] == "-" else str(word)
    if printable(text) == text:
        return shlex.quote(text)
    plain = (chr(byte) if 32 <= byte < 127 and byte not in b"'\\" else f"\\x{byte:02x}" for byte in os.fsencode(text))
    return f"$'{''.join(plain)}'"
