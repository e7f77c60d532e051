"""A program for `wlm.formats.child` that decompresses meshes by DracoPy (Google's Draco library)."""

import json

import numpy as np

PACKAGE, MEMORY, SECONDS = "DracoPy", 2 << 30, 10


def main(data: bytes, most: str) -> dict[str, np.ndarray]:
    """Decompresses all meshes; `data` is a line of JSON, the number of bytes of each mesh, and then their bytes.

    Returns the arrays of mesh i by the names "i,j": j is the id of an attribute, or -1 for the corners of the
    triangles. A ValueError means that these have more than `most` bytes.
    """
    import DracoPy

    head, _, body = data.partition(b"\n")
    arrays, at = {}, 0
    for number, size in enumerate(json.loads(head)):
        mesh = DracoPy.decode(body[at : at + size])
        at += size
        arrays |= {f"{number},{each['unique_id']}": each["data"] for each in mesh.attributes}
        arrays[f"{number},-1"] = mesh.faces
        if sum(each.nbytes for each in arrays.values()) > int(most):
            raise ValueError(f"the meshes have more than {most} bytes")
    return arrays
