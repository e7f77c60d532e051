"""A description of a file or a folder, and the commands that it may name."""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

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

    def to_json(self) -> dict[str, Any]:
        """Returns the finding as JSON values."""
        return {"path": str(self.path), "what": self.what, "command": self.command, "problems": list(self.problems)}


def command(*words: str | Path) -> str:
    """Returns a `wlm` command line of the words, quoted for a shell."""
    return shlex.join(["wlm", *map(str, words)])


def compress_command(*words: str | Path) -> str:
    """Returns the command line that compresses the given inputs, with options among the words."""
    return command("compress", *words, "-o", "OUT.wlm")
