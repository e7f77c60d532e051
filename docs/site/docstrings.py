"""Docstrings as griffe understands them: an entry for each name, where ours has one for several."""

import re
from typing import Any

from griffe import Extension

_SECTION = re.compile(r"(?:Args|Attributes):")
_ENTRY = re.compile(r"    (\w+(?:, \w+)+): ?(.*)")


def entries(docstring: str) -> str:
    """Splits entries such as `height, width: Texels.` in the sections of arguments and attributes."""
    lines, inside, names = [], False, []
    for line in docstring.splitlines():
        if line and not line.startswith(" "):
            inside = bool(_SECTION.fullmatch(line))
        if inside and line.startswith("    ") and not line.startswith("     "):
            match = _ENTRY.fullmatch(line)
            names = match[1].split(", ") if match else []
            if match:
                lines.append((names, match[2]))
                continue
        if inside and names and line.startswith("     "):
            # It goes on below.
            lines[-1] = names, f"{lines[-1][1]} {line.strip()}"
            continue
        names = []
        lines.append(([], line))
    return "\n".join("\n".join(f"    {name}: {text}" for name in names) if names else text for names, text in lines)


class Entries(Extension):
    """Splits the entries of all docstrings."""

    def on_object(self, *, obj: Any, **_: Any) -> None:
        """Called by griffe for each object that it has loaded."""
        if obj.docstring is not None:
            obj.docstring.value = entries(obj.docstring.value)
