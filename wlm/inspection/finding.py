"""What is said of a file or a folder."""

import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Finding:
    """A file, a folder, or files of a folder that belong together.

    Attributes:
        path: The file or the folder.
        what: What it holds, in a line.
        command: What takes it, "" where nothing does.
        problems: What is missing, damaged or looks wrong, a line each.
    """

    path: Path
    what: str
    command: str = ""
    problems: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """The finding as JSON values."""
        return asdict(self) | {"path": str(self.path), "problems": list(self.problems)}


def quoted(path: Path) -> str:
    """A path as a shell takes it."""
    return shlex.quote(str(path))
