"""Exports light to Godot 4: as a bake with a lattice of probes, or as the original bake with its light replaced.

Godot finds the tetrahedron of probes around a moving object with a tree of planes, and mixes the light of its four
corners by barycentric weights (`lightmap_tap_sh_light`, servers/rendering). On a lattice the tree and the tetrahedra
are simple: planes between the cells split the lattice down to single cells, and the planes x = y, y = z and x = z cut
a cell into six tetrahedra (Kuhn 1960). Tetrahedra of neighbouring cells meet face to face, so that the light is
continuous. For scattered probes, planes through the faces of Delaunay tetrahedra would cut many other tetrahedra: such
a tree has 20 nodes for each tetrahedron, and Godot takes minutes to build it for 2,000 probes.
"""

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.formats.godot import lmbake_bytes, relit
from wlm.probe.conventions import from_canonical
from wlm.probe.engines.lattice import CELLS, cells_of, check_numbers, lattice_of
from wlm.probe.places import positions_of

BAKE_FILE = "light.lmbake"
_MOST_CELLS = 64
_LARGEST = float(np.finfo(np.float32).max)
_ABOUT = (
    "Assign light.lmbake to the property Light Data of a LightmapGI node that is where it was when the probes were "
    "baked, or at the scene's origin. Meshes with the global illumination mode Dynamic get light within the probes' "
    "box. If a bake was given as --original, light.lmbake has its textures and meshes and replaces it. Otherwise "
    "light.lmbake has no textures, and the probes are on a lattice: low is its lowest corner, size the side of a cell, "
    "cells the number of cells along x, y, z."
)

# The six tetrahedra of a cell: paths from its lowest corner along the axes in this order.
_ORDERS = ((0, 1, 2), (0, 2, 1), (2, 0, 1), (1, 0, 2), (1, 2, 0), (2, 1, 0))
# The tree in a cell: each node compares the coordinates of two axes. A child -1 - i is tetrahedron i.
_COMPARED = ((0, 1), (1, 2), (0, 2), (0, 2), (1, 2))
_NEXT = ((1, 3), (-1, 2), (-2, -3), (-4, 4), (-5, -6))


def write_kit(
    bundle: Bundle,
    folder: Path,
    engine: str,
    *,
    cells: int | None = None,
    original: str | os.PathLike[str] | None = None,
    axes: str | None = None,
    device: str = "cpu",
) -> dict[str, Any]:
    """Writes a model of second-order spherical harmonics in three colours as a bake of Godot 4, `light.lmbake`.

    If `original` is the `.lmbake` that was compressed, a copy of it gets the model's light. Otherwise the bake has
    probes at the corners of cubic cells that fill the probes' box, 1 to 64 `cells` along its longest side (None: 24).
    If the decoder needs the probes' positions and the model stores none, they are read from `original`. `axes` are the
    scene's axes that become Godot's (`wlm.probe.axes`); a bake has Godot's own already. Raises a WlmError if a probe
    has other than 9 coefficients, `cells` is out of range or given with an `.lmbake`, the `.lmbake` has other probes,
    the light exceeds float32, or the device does not exist."""
    model = bundle.model.at()
    bake = original if original is not None and Path(original).suffix.lower() == ".lmbake" else None
    info: dict[str, object] = {"probes": model.probes}
    if bake is None:
        position = positions_of(model, original)
        lattice = lattice_of(model, CELLS if cells is None else cells, _MOST_CELLS, position, device, axes)
        points, count = lattice.corners(), lattice.count
        values = _godot(model.name, lattice.light(points))
        if not np.abs(points).max() < _LARGEST:
            raise WlmError(f"{model.name}: cannot export: the probes' box is too large for 32-bit floats")
        content = lmbake_bytes(points, values, tetrahedra_of(count), *tree_of(lattice.low, lattice.size, count))
        info = {"probes": len(points), "low": lattice.low.tolist(), "size": lattice.size, "cells": count.tolist()}
    else:
        if cells is not None:
            raise WlmError(
                f"cells: expected none with {bake}: the light replaces that of this bake's probes, without a grid"
            )
        if axes is not None:
            raise WlmError(f"axes: expected none with {bake}: the bake's probes stay where they are")
        check_numbers(model)
        places = positions_of(model, bake)
        content = relit(bake, _godot(model.name, model.decoder(device, position=places).decode_probes()))
    (folder / BAKE_FILE).write_bytes(content)
    return {"about": _ABOUT} | info


def tetrahedra_of(count: np.ndarray) -> np.ndarray:
    """Returns six tetrahedra for each of C cells, as corner indices int32 [6 C, 4]; `count`: cells along x, y, z."""
    nx, ny, _ = (int(n) + 1 for n in count)
    step = np.array([1, nx, nx * ny])
    first = cells_of(count) @ step
    paths = np.array([[0, *np.cumsum(step[list(order)])] for order in _ORDERS])
    return (first[:, None, None] + paths).reshape(-1, 4).astype(np.int32)


def tree_of(low: np.ndarray, size: float, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Makes Godot's BSP tree, whose planes lead to the tetrahedron of a point: five in each cell of a lattice. `low`,
    `size` and `count` are attributes of the `Lattice`. Returns the planes, float64 [M, 4], and the children of each
    node, int32 [M, 2], as in `wlm.formats.godot`."""
    cells = int(np.prod(count))
    inner = cells - 1  # nodes above the cells; the cells' own nodes, five each, follow in the order of the cells
    planes, children = np.zeros((inner + 5 * cells, 4)), np.zeros((inner + 5 * cells, 2), np.int32)
    nx, ny, _ = (int(n) for n in count)
    made = 0

    def place(begin: tuple[int, ...], end: tuple[int, ...]) -> int:
        """Builds the part of the tree for the cells from `begin` to `end`; returns the index of its root."""
        nonlocal made
        sides = [last - first for first, last in zip(begin, end, strict=True)]
        axis = sides.index(max(sides))
        if sides[axis] == 1:
            return inner + 5 * (begin[0] + nx * (begin[1] + ny * begin[2]))
        node, middle = made, (begin[axis] + end[axis]) // 2
        made += 1
        planes[node, axis], planes[node, 3] = 1.0, low[axis] + size * middle
        children[node, 0] = place(tuple(middle if a == axis else n for a, n in enumerate(begin)), end)
        children[node, 1] = place(begin, tuple(middle if a == axis else n for a, n in enumerate(end)))
        return node

    place((0, 0, 0), tuple(int(n) for n in count))
    corner = low + size * cells_of(count)
    for number, ((first, second), following) in enumerate(zip(_COMPARED, _NEXT, strict=True)):
        nodes = inner + 5 * np.arange(cells) + number
        planes[nodes, first], planes[nodes, second] = math.sqrt(0.5), -math.sqrt(0.5)
        planes[nodes, 3] = math.sqrt(0.5) * (corner[:, first] - corner[:, second])
        for side, child in enumerate(following):
            children[nodes, side] = nodes - number + child if child > 0 else child - 6 * np.arange(cells)
    return planes, children


def _godot(name: str, values: np.ndarray) -> np.ndarray:
    light = from_canonical(values.reshape(len(values), -1, 3), "godot")
    if not np.abs(light).max() < _LARGEST:
        raise WlmError(f"{name}: expected light within the range of float32, got {np.abs(light).max():.3g}")
    return light.astype(np.float32)
