"""Chooses the grids of smoke in a file, and brings them to one lattice of cubic voxels along the axes.

A grid has a transform from its voxels to the world. A grid whose voxels are cubes along the world's axes, in any order
and direction, is only permuted and flipped. All other grids, with oblong, rotated or sheared voxels, are resampled
trilinearly at cubic voxels, whose edge is the shortest edge of the grid's voxels. The grid's box
then grows by the voxels outside it where interpolation is not 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy import ndimage

from wlm.errors import WlmError, one_line
from wlm.formats.vdb import GridHead, VdbGrid

UPS = {
    "x": np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
}
"""Rotations from a world in which the axis x, y or z is up to one in which +y is up, by that axis."""

_CUBIC = 1e-5  # relative deviation of an edge from that of a cube along the axes
_FLAT = 1e-9  # least volume of a voxel with edges scaled to length 1
_FARTHEST = 1 << 30  # largest distance from the world's origin in voxels; beyond, rounding would move them
_APART = 1e-4  # offset in voxels up to which the voxels of two grids coincide


@dataclass(frozen=True, eq=False)
class Grid:
    """The values of a file's grid in the box of its active voxels, float32 tensor [X, Y, Z]; `matrix`, float64 [4, 4],
    transforms an index of them to the centre of this voxel in the world, and `name` is for error messages."""

    name: str
    values: torch.Tensor
    matrix: np.ndarray


@dataclass(frozen=True)
class Lattice:
    """A grid of cubic voxels along the world's axes.

    Attributes:
        voxel: Edge of a voxel, in the world's unit.
        origin: The corner of voxel (0, 0, 0) in the world, [3].
        shape: Voxels along each axis.
    """

    voxel: float
    origin: tuple[float, float, float]
    shape: tuple[int, int, int]


_DENSITY, _TEMPERATURE, _LEVEL_SET, _FOG = "density", "temperature", "level set", "fog volume"
_SHAPES = (_LEVEL_SET, "staggered")  # classes of grids that are no smoke
_MOST_NAMES = 32  # grids that a message lists
# Parts of names of grids that are the density of smoke, and of those that are another quantity.
_SMOKE = ("dens", "smoke", "soot", "fog", "cloud", "steam", "mist", "vapor", "vapour", "dust", "extinction")
_OTHERS = (
    *("temp", "heat", "flame", "fire", "burn", "fuel", "react", "emission", "emissive", "incandescence", "kelvin"),
    *("vel", "speed", "press", "diverg", "vort", "curl", "force", "collision", "obstacle", "mask", "distance"),
    *("sdf", "surface", "levelset", "phi", "shadow", "grad"),
)
_COLOURS = ("color", "colour", "albedo", "scatter")


def choose(
    where: str, heads: Sequence[GridHead], density: str | None = None, temperature: str | None = None
) -> tuple[str, str | None, list[str]]:
    """Chooses the grids of the density and of the temperature by their names and classes.

    The density is the grid `density`, else the only one with a name of smoke, else the only one whose name is that of
    no other quantity. A level set is chosen only by its name. `where` names the file or folder in messages. Returns the
    name of the density's grid, that of the temperature's if there is one, and warnings for grids that were chosen by
    another name than `density`.
    """
    found = one_line(", ".join(map(str, heads[:_MOST_NAMES])), 400) or "no grid"
    first = {head.name: head for head in reversed(heads)}
    for name in (density, temperature):
        if name is not None and not (name in first and first[name].is_number):
            raise WlmError(f"{where}: {name}: expected the name of one of the file's grids of floats, found {found}")
    names = list(dict.fromkeys(head.name for head in heads if head.is_number and head.group not in _SHAPES))
    warnings = []
    if density is None:
        exact = [name for name in names if name == _DENSITY] or [name for name in names if name.lower() == _DENSITY]
        other = [name for name in names if any(part in name.lower() for part in (*_OTHERS, *_COLOURS))]
        left = [name for name in names if name not in other]
        chosen = exact or [name for name in left if any(part in name.lower() for part in _SMOKE)] or left
        vectors = not exact and any(head.name.lower() == _DENSITY and not head.is_number for head in heads)
        if len(chosen) != 1 or vectors:
            usable = next((head.name for head in heads if head.is_number), None)
            name = next(iter(chosen or names), usable)
            advice = "export it as floats" if name is None else f"choose one, such as --volume density={name}"
            if vectors:
                advice = "coloured smoke is not read, since lightmaps have one albedo: export the density as floats"
            level = "; a level set is filled with smoke if it is chosen" if name not in names and name else ""
            raise WlmError(f"{where}: expected a grid of floats named density, found {found}: {advice}{level}")
        density = chosen[0]
        if not exact and density:
            more = f" (found {found}; --volume density=NAME chooses)" if len(heads) > 1 else ""
            warnings.append(f"{where}: the grid {density} is read as the density{more}")
        if coloured := [head.name for head in heads if any(part in head.name.lower() for part in _COLOURS)]:
            names_of = ", ".join(dict.fromkeys(coloured))
            warnings.append(
                f"{where}: colours ({names_of}) are not read: smoke has one albedo, such as --albedo of light"
            )
    if temperature is None and density.lower() != _TEMPERATURE:
        temperature = next((name for name in names if name.lower() == _TEMPERATURE), None)
    return density, temperature, warnings


def is_level_set(grid: VdbGrid, group: str) -> bool:
    """Tests whether a grid's values are distances to a surface: its background is above 0, and its class `group` is
    level set, or is not fog while a value is below 0."""
    return grid.background > 0 and group != _FOG and (group == _LEVEL_SET or bool(grid.values.min() < 0))


def on_one_lattice(grids: Sequence[Grid], most: int, up: str = "y") -> tuple[Lattice, list[torch.Tensor]]:
    """Brings grids to one lattice, which covers all of them and has the voxels of the first grid, if these are cubic.
    `most` is the largest number of voxels; `up` is "x", "y" or "z", the axis of the grids' world that becomes +y.

    Returns the lattice, and each grid's values on it, float32 [X, Y, Z]; 0 where a grid has none.
    """
    turned = [(grid, _turned(grid, up)) for grid in grids]
    first, matrix = turned[0]
    voxel = float(np.linalg.norm(matrix[:3, :3], axis=0).min())
    # A lattice through the first grid's corner: the grid's own voxels if they are cubes along the axes.
    corner = _ends(first, matrix, 0.0)[0]
    kept = [_is_kept(_between(voxel, corner, matrix)) for _, matrix in turned]
    ends = [_ends(grid, matrix, 0.0 if same else 0.5) for (grid, matrix), same in zip(turned, kept, strict=True)]
    farthest = float(np.abs(ends).max()) / voxel
    if not farthest <= _FARTHEST:
        raise WlmError(f"{first.name}: expected voxels within {_FARTHEST} voxels of the origin, found {farthest:.4g}")
    low = np.floor(np.min([(begin - corner) / voxel for begin, _ in ends], axis=0) + _APART)
    high = np.ceil(np.max([(end - corner) / voxel for _, end in ends], axis=0) - _APART)
    size = [max(int(n), 1) for n in high - low]
    if math.prod(size) > most:
        raise WlmError(
            f"{first.name}: expected at most {most} cubic voxels after resampling to the grid's shortest edge, "
            f"{voxel:.4g}, found {' x '.join(map(str, size))}"
        )
    lattice = Lattice(voxel, tuple(map(float, corner + low * voxel)), tuple(size))
    return lattice, [_on(lattice, grid, matrix) for grid, matrix in turned]


def _turned(grid: Grid, up: str) -> np.ndarray:
    """Returns the transform [4, 4] from voxel corners (i, j, k) of a grid to the world, turned so that +y is up."""
    matrix = np.eye(4)
    matrix[:3, :3] = UPS[up]
    matrix = matrix @ grid.matrix
    matrix[:3, 3] -= 0.5 * matrix[:3, :3].sum(1)
    edges = np.linalg.norm(matrix[:3, :3], axis=0)
    # Edges are scaled to length 1, so that the test does not depend on the size of a voxel.
    if not (np.isfinite(edges).all() and edges.all() and abs(np.linalg.det(matrix[:3, :3] / edges)) > _FLAT):
        raise WlmError(f"{grid.name}: expected an invertible transform to the world, found {grid.matrix.tolist()}")
    return matrix


def _ends(grid: Grid, matrix: np.ndarray, margin: float) -> tuple[np.ndarray, np.ndarray]:
    box = np.stack(np.meshgrid(*[(-margin, n + margin) for n in grid.values.shape], indexing="ij"), -1).reshape(8, 3)
    corners = box @ matrix[:3, :3].T + matrix[:3, 3]
    return corners.min(0), corners.max(0)


def _between(voxel: float, origin: np.ndarray, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Returns the matrix [3, 3] and shift [3] that map corners of a lattice's voxels to corners of a grid's voxels."""
    turn = np.linalg.inv(matrix[:3, :3])
    return turn * voxel, turn @ (origin - matrix[:3, 3])


def _is_kept(between: tuple[np.ndarray, np.ndarray]) -> bool:
    """Returns whether a matrix and shift between voxels only permute, flip and move them by whole voxels."""
    turn, shift = between
    axes = np.abs(turn).round()
    straight = np.abs(np.abs(turn) - axes).max() <= _CUBIC and (axes.sum(0) == 1).all() and (axes.sum(1) == 1).all()
    return bool(straight and np.abs(shift - shift.round()).max() <= _APART)


def _on(lattice: Lattice, grid: Grid, matrix: np.ndarray) -> torch.Tensor:
    turn, shift = _between(lattice.voxel, np.asarray(lattice.origin), matrix)
    if not _is_kept((turn, shift)):
        # The index of a voxel is its centre minus a half.
        offset = shift + 0.5 * turn.sum(1) - 0.5
        options = {"output_shape": lattice.shape, "order": 1, "mode": "grid-constant"}
        return torch.from_numpy(ndimage.affine_transform(grid.values.numpy(), turn, offset, **options))
    signs = turn.round().astype(int)
    order = np.abs(signs).argmax(0).tolist()  # the grid's axis for each axis of the lattice
    begin = (shift + 0.5 * signs.sum(1) - 0.5).round().astype(int)  # the grid's voxel at the lattice's first voxel
    backwards = [axis for axis in range(3) if signs[order[axis], axis] < 0]
    values = grid.values.permute(order).flip(backwards)
    first = [
        begin[order[axis]] + 1 - values.shape[axis] if axis in backwards else -begin[order[axis]] for axis in range(3)
    ]
    if not any(first) and tuple(values.shape) == lattice.shape:
        return values.contiguous()
    out = torch.zeros(lattice.shape, dtype=torch.float32, device=values.device)
    out[tuple(slice(int(a), int(a) + n) for a, n in zip(first, values.shape, strict=True))] = values
    return out
