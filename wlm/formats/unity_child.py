"""Lists the objects of a file of Unity's as JSON, by UnityPy: run as a program of its own, which may fail as it will.

UnityPy's C code ends its process on some damaged files. Nothing of this package is imported here.
"""

import contextlib
import io
import json
import sys
from typing import Any

MEMORY = 2 << 30
"""Bytes that it may take, where the system can say so."""

SECONDS = 4
"""Of computing, likewise."""


def main(path: str, kinds: list[str]) -> None:
    """Prints for each object its type, and of those of some types the layout, where its bytes are, and their order."""
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # Not `UnityPy.load`, which unpacks whatever a file claims to be packed by.
    from UnityPy.files import SerializedFile
    from UnityPy.streams import EndianBinaryReader

    with open(path, "rb") as file:
        data = file.read()
    # It prints what it can't read.
    with contextlib.redirect_stdout(io.StringIO()):
        asset = SerializedFile(EndianBinaryReader(data), name="asset")
        found = []
        for item in asset.objects.values():
            kind = item.type.name
            tree = _tree(item.serialized_type.node) if kind in kinds else None
            found.append([kind, tree, item.byte_start, item.byte_size, asset.header.endian])
    json.dump(found, sys.stdout)


def _tree(node: Any) -> Any:
    """A layout: type, name, flags, and what it has."""
    return node and [node.m_Type, node.m_Name, node.m_MetaFlag, [_tree(each) for each in node.m_Children]]


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
