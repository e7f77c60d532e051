"""Reads the grids of NanoVDB files, and brings a file's grids to one lattice of cubic voxels along the axes.

A grid has a transform from its voxels to the world. A grid whose voxels are cubes along the world's axes, in any order
and direction, is only permuted and flipped. All other grids, with oblong, rotated or sheared voxels, are resampled
trilinearly at cubic voxels, whose edge is the shortest edge of the grid's voxels. The grid's box
then grows by the voxels outside it where interpolation is not 0.
"""

import math
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from wlm.errors import WlmError
from wlm.formats import blosc
from wlm.formats.limits import GROWTH, SURE_BYTES, check_growth
from wlm.interop import device_name, to_warp
from wlm_kernels.fluid import grids as kernels

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
    """The values of a file's grid in the box of its active voxels.

    Attributes:
        name: Name in error messages.
        values: float32 tensor [X, Y, Z].
        matrix: float64 [4, 4], transform of an index of `values` to the centre of this voxel in the world.
    """

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


def on_one_lattice(grids: Sequence[Grid], most: int, up: str = "y") -> tuple[Lattice, list[torch.Tensor]]:
    """Brings grids to one lattice, which covers all of them and has the voxels of the first grid, if these are cubic.

    `most` is the largest number of voxels; `up` is "x", "y" or "z", the axis of the grids' world that becomes +y.

    Returns:
        The lattice, and each grid's values on it, float32 [X, Y, Z]; 0 where a grid has none.

    Raises:
        WlmError: A grid's transform cannot be inverted, or the lattice has too many voxels.
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
        raise WlmError(f"{first.name}: expected voxel coordinates up to {_FARTHEST}, found {farthest:.4g}")
    low = np.floor(np.min([(begin - corner) / voxel for begin, _ in ends], axis=0) + _APART)
    high = np.ceil(np.max([(end - corner) / voxel for _, end in ends], axis=0) - _APART)
    size = [max(int(n), 1) for n in high - low]
    if math.prod(size) > most:
        raise WlmError(
            f"{first.name}: expected at most {most} cubic voxels with the grid's shortest edge, {voxel:.4g}, "
            f"found {' x '.join(map(str, size))}"
        )
    lattice = Lattice(voxel, tuple(map(float, corner + low * voxel)), tuple(size))
    return lattice, [_on(lattice, grid, matrix) for grid, matrix in turned]


def _turned(grid: Grid, up: str) -> np.ndarray:
    """Returns the transform [4, 4] of the corners of a grid's voxels to the world in which +y is up."""
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
    """Returns whether a transform of `_between` maps voxels exactly to voxels, so that no resampling is needed."""
    turn, shift = between
    axes = np.abs(turn).round()
    straight = np.abs(np.abs(turn) - axes).max() <= _CUBIC and (axes.sum(0) == 1).all() and (axes.sum(1) == 1).all()
    return bool(straight and np.abs(shift - shift.round()).max() <= _APART)


def _on(lattice: Lattice, grid: Grid, matrix: np.ndarray) -> torch.Tensor:
    turn, shift = _between(lattice.voxel, np.asarray(lattice.origin), matrix)
    if not _is_kept((turn, shift)):
        return _resampled(lattice, grid.values, turn, shift)
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


def _resampled(lattice: Lattice, values: torch.Tensor, turn: np.ndarray, shift: np.ndarray) -> torch.Tensor:
    out = torch.empty(lattice.shape, dtype=torch.float32, device=values.device)
    inputs = [to_warp(values.contiguous()), wp.mat33(*turn.ravel().tolist()), wp.vec3(*shift.tolist())]
    device = device_name(values.device)
    wp.launch(kernels.resample, lattice.shape, inputs, [to_warp(out)], device=device)
    return out


BAD_GRID = (RuntimeError, TypeError, ValueError, LookupError, OverflowError, MemoryError, struct.error, zlib.error)
"""Exceptions for data that is not NanoVDB, is truncated, or has wrong sizes."""

# Sizes of a file's header and of a grid's metadata; offsets in the metadata of the grid's size, its size in the file,
# and the length of its name.
_FILE_HEADER, _META, _GRID_BYTES, _FILE_BYTES, _NAME_LENGTH = 16, 176, 0, 8, 136
_ZIP, _BLOSC = 1, 2
# Offsets in a grid's header: the map's linear part and shift in doubles; the tree, and in it the offset of the root.
_LINEAR, _SHIFT, _TREE, _ROOT = 384, 528, 672, 24
_LONGEST_NAME = 1 << 12


@dataclass(frozen=True)
class NanoVdbEntry:
    """A grid of a NanoVDB file, still compressed.

    Attributes:
        name: Name in the file.
        data: Compressed bytes.
        head, meta: Header of the file segment that has the grid, and the grid's metadata in it.
        size: Uncompressed size in bytes.
        codec: Compression: 0 none, 1 zlib, 2 Blosc.
    """

    name: str
    data: memoryview
    head: bytes
    meta: bytes
    size: int
    codec: int

    def load(self, where: str, trust: bool) -> wp.Volume:
        """Decompresses the grid; `where` names the file in messages. With `trust` the size that the file states is not
        checked.

        Raises:
            WlmError: The stated size is too large for the compressed size.
            RuntimeError, ValueError and others in `BAD_GRID`: The data is damaged.
        """
        if self.codec and not trust:
            check_growth(where, len(self.data), self.size, GROWTH, SURE_BYTES)
        grid = self._unpacked()
        if len(grid) != self.size:
            raise ValueError(f"grid {self.name}: expected {self.size} bytes after decompression, found {len(grid)}")
        meta = bytearray(self.meta)
        struct.pack_into("<Q", meta, _FILE_BYTES, len(grid))
        # The header must claim a single grid: Warp would look for the others.
        return wp.Volume.load_from_nvdb(b"".join((self.head[:12], struct.pack("<2H", 1, 0), meta, grid)), device="cpu")

    def _unpacked(self) -> bytes:
        if self.codec not in (_ZIP, _BLOSC):
            return bytes(self.data)
        pieces, at, left = [], 0, self.size
        while at < len(self.data):
            (length,) = struct.unpack_from("<Q", self.data, at)
            piece = bytes(self.data[at + 8 : at + 8 + length])
            if not 0 < length == len(piece):
                raise ValueError(f"grid {self.name}: expected {length} compressed bytes, found {len(piece)}")
            if self.codec == _BLOSC:
                size = blosc.unpacked_size(piece)
                if size > left:
                    raise ValueError(f"grid {self.name}: expected {self.size} bytes after decompression, found more")
                pieces.append(blosc.unpack(piece, size))
            else:
                pieces.append(zlib.decompressobj().decompress(piece, left + 1))
            left -= len(pieces[-1])
            at += 8 + length
        return b"".join(pieces)


def entries(data: bytes) -> Iterator[NanoVdbEntry]:
    """Yields the grids of a file, which may have several segments with several grids each.

    Raises:
        RuntimeError, ValueError and others in `BAD_GRID`: The data is damaged.
    """
    view, at = memoryview(data), 0
    while at < len(data):
        head = bytes(view[at : at + _FILE_HEADER])
        if head[:7] != b"NanoVDB" or head[7:8] not in b"02":
            raise ValueError(f"expected the signature of NanoVDB at byte {at}, found {head[:8]!r}")
        count, codec = struct.unpack_from("<2H", head, 12)
        at += _FILE_HEADER
        metas = []
        for _ in range(count):
            length = struct.unpack_from("<I", data, at + _NAME_LENGTH)[0]
            if not 0 < length <= _LONGEST_NAME:
                raise ValueError(f"expected a grid's name of 1 to {_LONGEST_NAME} bytes, found {length} bytes")
            metas.append(bytes(view[at : at + _META + length]))
            at += _META + length
        for meta in metas:
            size, packed = struct.unpack_from("<2Q", meta, _GRID_BYTES)
            if at + packed > len(data):
                raise ValueError(f"the file ends before byte {at + packed}, where a grid ends")
            name = meta[_META:-1].decode("utf-8", "replace")
            yield NanoVdbEntry(name, view[at : at + packed], head, meta, size if codec else packed, codec)
            at += packed
    if not data:
        raise ValueError("the file is empty")


def dense(volume: wp.Volume, name: str, most: int) -> Grid:
    """Converts a sparse grid to a dense array over the box of its active voxels, or over voxel (0, 0, 0) if none is
    active.

    Raises:
        WlmError: The grid does not contain floats, or its box has more than `most` voxels.
    """
    if volume.dtype is not wp.float32:
        raise WlmError(f"{name}: expected a grid of floats, found {volume.get_grid_info().type_str}")
    # Warp exposes neither the box nor the map in double precision.
    head = volume.array()[: _TREE + _ROOT + 8].numpy()
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(struct.unpack_from("<9d", head, _LINEAR)).reshape(3, 3)
    matrix[:3, 3] = struct.unpack_from("<3d", head, _SHIFT)
    root = _TREE + struct.unpack_from("<q", head, _TREE + _ROOT)[0]
    if not 0 < root <= volume.array().size - 24:
        raise WlmError(f"{name}: expected the root of the tree within the grid's bytes, found it at byte {root}")
    corners = np.frombuffer(volume.array()[root : root + 24].numpy().tobytes(), "<i4").reshape(2, 3).astype(np.int64)
    low, size = corners[0], corners[1] - corners[0] + 1
    if (size < 1).any():
        # No active voxel: one empty voxel.
        low, size = np.zeros(3, np.int64), np.ones(3, np.int64)
    if math.prod(size.tolist()) > most:
        raise WlmError(
            f"{name}: expected a box of at most {most} voxels from a grid of {volume.array().size} bytes, "
            f"found a box from {corners[0].tolist()} to {corners[1].tolist()}"
        )
    out = wp.empty(tuple(size.tolist()), dtype=float, device=volume.device)
    inputs = [volume.id, wp.vec3i(*low.tolist())]
    wp.launch(kernels.dense, out.shape, inputs, [out], device=volume.device)
    matrix[:3, 3] += matrix[:3, :3] @ low
    return Grid(name, wp.to_torch(out), matrix)
