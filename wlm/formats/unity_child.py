"""A program that lists the objects of a Unity file as JSON by UnityPy, in a process of its own.

UnityPy's C code ends its process on some damaged files. This program imports nothing of this package.
"""

import contextlib
import io
import json
import sys
from typing import Any

MEMORY = 2 << 30
"""Limit of its memory, in bytes, on systems that can set one."""

SECONDS = 4
"""Limit of its CPU time, in seconds, on systems that can set one."""


def main(path: str, kinds: list[str]) -> None:
    """Prints the type of each object, and for some types the layout, the location of the bytes and their order."""
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # `UnityPy.load` would decompress by any method that a file names.
    from UnityPy.files import SerializedFile
    from UnityPy.streams import EndianBinaryReader

    with open(path, "rb") as file:
        data = file.read()
    # UnityPy prints messages about data that it cannot read.
    with contextlib.redirect_stdout(io.StringIO()):
        asset = SerializedFile(EndianBinaryReader(data), name="asset")
        found = []
        for item in asset.objects.values():
            kind = item.type.name
            tree = _tree(item.serialized_type.node) if kind in kinds else None
            found.append([kind, tree, item.byte_start, item.byte_size, asset.header.endian])
    json.dump(found, sys.stdout)


def _tree(node: Any) -> Any:
    """Returns a layout as a list: type, name, flags, and the list of the children's layouts."""
    return node and [node.m_Type, node.m_Name, node.m_MetaFlag, [_tree(each) for each in node.m_Children]]


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
