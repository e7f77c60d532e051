"""Light probes as Godot 4 has them: a bake of a lattice of them, or the bake that came in with other light.

Godot finds the tetrahedron of probes that a moving object is in by a tree of planes, and takes the light of its four
corners by barycentric weights (`lightmap_tap_sh_light`, servers/rendering). On a lattice both are plain: planes between
the cells down to one cell, in it the planes x = y, y = z and x = z, which cut it into six tetrahedra (Kuhn 1960); those
of neighbours meet face to face, so that light is continuous. Planes through the faces of Delaunay tetrahedra between
scattered probes cut so many others that the tree has 20 nodes for each; Godot's own takes minutes for 2,000 probes.
"""

import math
import os
from pathlib import Path

import numpy as np

from wlm.errors import WlmError
from wlm.formats.folder import made_parents, staged, write_index
from wlm.formats.godot import lmbake_bytes, relit
from wlm.probe.conventions import from_canonical
from wlm.probe.data import load_positions
from wlm.probe.lattice import CELLS, NUMBERS, lattice_of
from wlm.probe.model import ProbeModel
from wlm.probe.transform import Transform

FORMAT = "wlm-godot-light"
_VERSION = 1
INFO_FILE = "light.json"
BAKE_FILE = "light.lmbake"
_MOST_CELLS = 64
_LARGEST = float(np.finfo(np.float32).max)
_ABOUT = (
    "light.lmbake goes on the property Light Data of a LightmapGI node that stands where it stood when the probes were "
    "baked, or at the scene's origin. Meshes whose global illumination mode is Dynamic get light in the probes' box. "
    "A bake that was given as --original is in it with its textures and meshes: put it in its place. Else it has none, "
    "and the probes are on a lattice: its lowest corner, the side of a cell, and the cells along x, y and z."
)

# Which of the six tetrahedra of a cell: from its lowest corner along the axes in this order.
_ORDERS = ((0, 1, 2), (0, 2, 1), (2, 0, 1), (1, 0, 2), (1, 2, 0), (2, 1, 0))
# The tree in a cell: a node is over where the first axis is farther along than the second. Tetrahedra are -1 - number.
_COMPARED = ((0, 1), (1, 2), (0, 2), (0, 2), (1, 2))
_NEXT = ((1, 3), (-1, 2), (-2, -3), (-4, 4), (-5, -6))


def export_godot(
    model: ProbeModel | Transform,
    directory: str | os.PathLike[str],
    *,
    bake: str | os.PathLike[str] | None = None,
    cells: int | None = None,
    position: np.ndarray | None = None,
    device: str = "cpu",
) -> list[Path]:
    """Writes a model's light as a bake of Godot 4: `light.lmbake`, and `light.json`, which explains it.

    Args:
        model: Of L2 in RGB.
        directory: The folder; made if it isn't there. A new export replaces an earlier one.
        bake: The `.lmbake` that was compressed: it keeps all but its light. None: probes on the corners of cubic cells
            that fill the probes' box, with what `Decoder.decode` gives there.
        cells: Of these, along the longest side of the box, 1 to 64; None: 24.
        position: [N, 3], of the model's own probes, for a transform whose file has none, without a bake.
        device: Where it is decoded.

    Returns:
        The files written, `light.json` last.

    Raises:
        WlmError: Another number of coefficients, cells out of range or beside a bake, a bake of other probes, light
            beyond floats, no such device, or the folder can't be written.
    """
    info: dict[str, object] = {"probes": model.probes}
    if bake is None:
        lattice = lattice_of(model, CELLS if cells is None else cells, _MOST_CELLS, position, device)
        points, count = lattice.corners(), lattice.count
        values = _godot(model.name, lattice.light(points))
        if not np.abs(points).max() < _LARGEST:
            raise WlmError(f"{model.name}: cannot export: the probes' box is too large for floats")
        tetrahedra = tetrahedra_of(count)
        content = lmbake_bytes(points, values, tetrahedra, *tree_of(lattice.low, lattice.size, count))
        info = {
            "probes": len(points),
            "low": lattice.low.tolist(),
            "size": lattice.size,
            "cells": count.tolist(),
        }
    else:
        if cells is not None:
            raise WlmError(f"cells: expected none beside {bake}, whose probes have their places")
        if model.outputs != NUMBERS:
            raise WlmError(f"{model.name}: expected L2 in RGB, {NUMBERS} numbers a probe, got {model.outputs}")
        places = load_positions(bake)
        if not model.has_probes_at(places):
            raise WlmError(f"{bake}: expected the {model.probes} probes of {model.name}, in their order")
        content = relit(bake, _godot(model.name, model.decoder(device).decode_probes(places)))
    folder = Path(directory)
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, {INFO_FILE, BAKE_FILE}.__contains__) as temporary:
        (temporary / BAKE_FILE).write_bytes(content)
        document = {"format": FORMAT, "version": _VERSION, "about": _ABOUT, "name": model.name}
        write_index(temporary / INFO_FILE, document | info)
    return [folder / BAKE_FILE, folder / INFO_FILE]


def tetrahedra_of(count: np.ndarray) -> np.ndarray:
    """Six tetrahedra in each of the cells [3] along x, y and z, int32 [6 C, 4] between their corners, x fastest."""
    nx, ny, _ = (int(n) + 1 for n in count)
    step = np.array([1, nx, nx * ny])
    z, y, x = (axis.ravel() for axis in np.meshgrid(*(np.arange(n) for n in count[::-1]), indexing="ij"))
    first = np.stack([x, y, z], 1) @ step
    paths = np.array([[0, *np.cumsum(step[list(order)])] for order in _ORDERS])
    return (first[:, None, None] + paths).reshape(-1, 4).astype(np.int32)


def tree_of(low: np.ndarray, size: float, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The tree of planes over the tetrahedra of `tetrahedra_of`.

    Args:
        low, size, count: Of the `Lattice`.

    Returns:
        Planes, float64 [M, 4], and children, int32 [M, 2], as `wlm.formats.godot` takes them.
    """
    cells = int(np.prod(count))
    inner = cells - 1  # nodes above the cells', which are five each and follow in the cells' order
    planes, children = np.zeros((inner + 5 * cells, 4)), np.zeros((inner + 5 * cells, 2), np.int32)
    nx, ny, _ = (int(n) for n in count)
    made = 0

    def place(begin: tuple[int, ...], end: tuple[int, ...]) -> int:
        """Makes the nodes above a block of cells; returns the topmost."""
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
    z, y, x = (axis.ravel() for axis in np.meshgrid(*(np.arange(n) for n in count[::-1]), indexing="ij"))
    corner = low + size * np.stack([x, y, z], 1)
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
        raise WlmError(f"{name}: expected light that floats hold, got {np.abs(light).max():.3g}")
    return light.astype(np.float32)
