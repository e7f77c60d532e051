"""Storage of new UVs of triangles' corners: each place once, and triangles that share texels once.

A place has 16 bits along each axis. Triangles of a group read the same texels, in one of the six orders of the corners:
a stored triangle is three places in rising order, and each triangle of the mesh refers to one and states its order.
Places and stored triangles are in the order of their first use. Bytes of equal weight are stored together, which packs
better.
"""

import itertools
from collections.abc import Mapping

import numpy as np

from wlm.formats.parts import Part

STEPS = 65535.0
"""The integer that is a coordinate of 1."""

PARTS = {
    "uv_place": Part(np.uint8, (2, 2, None), optional=True),
    "uv_triangle": Part(np.uint8, (4, 3, None), optional=True),
    "uv_index": Part(np.uint8, (4, None), optional=True),
    "uv_order": Part(np.uint8, (None,), optional=True, most=5),
}

_ORDERS = np.array(list(itertools.permutations(range(3))))


def snapped(uv: np.ndarray) -> np.ndarray:
    """Rounds UVs in [0, 1] to the nearest places that a file can store, float32."""
    return (np.rint(np.asarray(uv, np.float64) * STEPS) / STEPS).astype(np.float32)


def encode_corners(uv: np.ndarray) -> dict[str, np.ndarray]:
    """Encodes corners.

    Args:
        uv: float32 [F, 3, 2], `snapped`.

    Returns:
        The parts; none for no corners.

    Raises:
        ValueError: The corners are not at places that a file can store.
    """
    if not len(uv):
        return {}
    if not np.array_equal(snapped(uv), uv):
        raise ValueError("uv: expected places of 16 bits")
    place = np.rint(uv.reshape(-1, 2).astype(np.float64) * STEPS).astype(np.int64)
    place, corner = _by_first_use(place)
    triangle = corner.reshape(-1, 3)
    order = np.argsort(triangle, axis=1, kind="stable")
    stored, index = _by_first_use(np.take_along_axis(triangle, order, 1))
    # Steps modulo 65,536 become signed 16-bit integers, which are stored with the sign as the lowest bit (zigzag).
    step = np.diff(place, axis=0, prepend=0).astype(np.int16).astype(np.int32)
    folded = (step << 1) ^ (step >> 31)
    return {
        "uv_place": _planes(folded.T.astype("<u2")),
        "uv_triangle": _planes(stored.T.astype("<u4")),
        "uv_index": _planes(index.astype("<u4")),
        "uv_order": (2 * order[:, 0] + (order[:, 1] > order[:, 2])).astype(np.uint8),
    }


def decode_corners(parts: Mapping[str, np.ndarray]) -> np.ndarray:
    """Decodes `encode_corners`.

    Args:
        parts: Checked against `PARTS`.

    Returns:
        float32 [F, 3, 2]; [0, 3, 2] where the parts are empty.

    Raises:
        ValueError: A part is missing or has another length, or names a triangle or place that isn't there.
    """
    sizes = [parts[name].size for name in PARTS]
    if not any(sizes):
        return np.empty((0, 3, 2), np.float32)
    if not all(sizes):
        raise ValueError(f"part {list(PARTS)[sizes.index(0)]} is missing")
    folded, stored, index = (_joined(parts[name]) for name in ("uv_place", "uv_triangle", "uv_index"))
    if len(index) != len(parts["uv_order"]):
        raise ValueError("part uv_order: expected a number for each of part uv_index")
    place = np.cumsum(((folded >> 1) ^ -(folded & 1)).T, axis=0) & 0xFFFF
    for name, values, count in (("uv_triangle", stored, len(place)), ("uv_index", index, stored.shape[1])):
        if values.size and values.max() >= count:
            raise ValueError(f"part {name}: expected numbers below {count}, found {values.max()}")
    triangle = np.empty((len(index), 3), np.int64)
    np.put_along_axis(triangle, _ORDERS[parts["uv_order"]], stored.T[index], 1)
    return (place[triangle] / STEPS).astype(np.float32).reshape(-1, 3, 2)


def _by_first_use(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the distinct rows in the order of their first use, and the index of each row among them."""
    _, first, number = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    rank = np.argsort(np.argsort(first))
    return rows[np.sort(first)], rank[number.reshape(-1)]


def _planes(values: np.ndarray) -> np.ndarray:
    """Splits numbers into bytes [itemsize, ...], the lowest first."""
    return np.moveaxis(np.ascontiguousarray(values).view(np.uint8).reshape(*values.shape, -1), -1, 0)


def _joined(planes: np.ndarray) -> np.ndarray:
    """Inverts `_planes`, int64."""
    return sum(plane.astype(np.int64) << (8 * number) for number, plane in enumerate(planes))
