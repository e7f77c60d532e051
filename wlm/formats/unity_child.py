"""A program for `wlm.formats.child` that reads the arrays of a Unity file by UnityPy.

A file contains the layouts of its objects, which can describe endless work or claim any number of values: the limits of
the process end it.
"""

from collections.abc import Callable, Iterable

import numpy as np

PACKAGE, MEMORY, SECONDS = "UnityPy", 768 << 20, 2

KINDS, POSITIONS, LIGHT = "kinds", "positions", "light"
"""Names of the arrays that `encode` returns."""

PROBES, LIGHTING = "LightProbes", "LightingDataAsset"
"""Types of the objects of lighting data, of which the former hold the probes."""


def main(data: bytes) -> dict[str, np.ndarray]:
    """Reads the bytes of a serialized Unity file, and returns what `encode` returns for its objects."""
    # `UnityPy.load` would decompress by any method that a file names.
    from UnityPy.files import SerializedFile
    from UnityPy.streams import EndianBinaryReader

    asset = SerializedFile(EndianBinaryReader(data), name="asset")
    return encode((item.type.name, item.read_typetree) for item in asset.objects.values())


def encode(objects: Iterable[tuple[str, Callable[[], dict]]]) -> dict[str, np.ndarray]:
    """Collects the arrays of objects, each given by its type and a function that reads its members; a LookupError,
    TypeError or ValueError means other members.

    Returns the types of all objects, text [K]; and the positions [N, 3] and coefficients [N, 27] of light probes,
    float64.
    """
    kinds: set[str] = set()
    position, light = [], []
    for kind, read in objects:
        kinds.add(kind)
        if kind == PROBES:
            tree = read()
            position += [[each[axis] for axis in "xyz"] for each in tree["m_Data"]["m_Positions"]]
            light += [[each[f"sh[{i:2d}]"] for i in range(27)] for each in tree["m_BakedCoefficients"]]
    tables = {POSITIONS: (position, 3), LIGHT: (light, 27)}
    arrays = {name: np.array(rows, np.float64).reshape(-1, width) for name, (rows, width) in tables.items()}
    return arrays | {KINDS: np.array(sorted(kinds), str)}
