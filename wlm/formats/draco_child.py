"""A program that decompresses meshes by DracoPy, in a process of its own.

Google's Draco library may end its process on damaged data, and allocates what the data claims. This program imports
nothing of this package. It reads from standard input, and writes to standard output, a line of JSON and bytes:

- in: a list with the number of bytes of each mesh; the bytes of all meshes
- out: for each mesh a list of arrays: the id of the attribute (-1 for the corners of the triangles), the NumPy type,
  and the shape; the bytes of all arrays
"""

import contextlib
import json
import sys

MEMORY = 2 << 30
"""Limit of its memory, in bytes, on systems that can set one."""

SECONDS = 10
"""Limit of its CPU time, in seconds, on systems that can set one."""


def main(most: int) -> None:
    """Decompresses all meshes; ends with an error if they have more than `most` bytes together."""
    with contextlib.suppress(ImportError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        resource.setrlimit(resource.RLIMIT_CPU, (SECONDS, SECONDS))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    import DracoPy

    sizes = json.loads(sys.stdin.buffer.readline())
    heads, arrays, total = [], [], 0
    for size in sizes:
        mesh = DracoPy.decode(sys.stdin.buffer.read(size))
        found = [(each["unique_id"], each["data"]) for each in mesh.attributes] + [(-1, mesh.faces)]
        heads.append([[int(number), data.dtype.str, list(data.shape)] for number, data in found])
        arrays += [data.tobytes() for _, data in found]
        total += sum(data.nbytes for _, data in found)
        if total > most:
            raise ValueError(f"the meshes have more than {most} bytes")
    sys.stdout.buffer.write(json.dumps(heads).encode() + b"\n" + b"".join(arrays))


if __name__ == "__main__":
    main(int(sys.argv[1]))
