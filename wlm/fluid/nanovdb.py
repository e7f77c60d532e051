"""NanoVDB: the grids of a `.nvdb` file, and a grid in Warp's memory made dense."""

import math
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp

from wlm.errors import WlmError
from wlm.fluid.grids import Grid
from wlm.formats import blosc
from wlm.formats.limits import GROWTH, SURE_BYTES, check_growth
from wlm_kernels.fluid import grids as kernels

BAD_GRID = (RuntimeError, TypeError, ValueError, LookupError, OverflowError, MemoryError, struct.error, zlib.error)
"""What a NanoVDB file raises that is none, is cut short, or lies about its sizes."""

# Bytes of a file's header and of what it says of each grid; in the latter the places of the grid's bytes, those in the
# file, and its name's length.
_FILE_HEADER, _META, _GRID_BYTES, _FILE_BYTES, _NAME_LENGTH = 16, 176, 0, 8, 136
_ZIP, _BLOSC = 1, 2
# Of a grid's own header: the map's linear part and its shift, in doubles; the tree, and in that the way to its root.
_LINEAR, _SHIFT, _TREE, _ROOT = 384, 528, 672, 24
_LONGEST_NAME = 1 << 12


@dataclass(frozen=True)
class NanoVdbEntry:
    """A grid of a file, still packed.

    Attributes:
        name: As the file has it.
        data: Its bytes in the file.
        head, meta: The header of its segment, and what that says of the grid.
        size: Bytes of the grid unpacked.
        codec: 0 none, 1 zlib, 2 Blosc.
    """

    name: str
    data: memoryview
    head: bytes
    meta: bytes
    size: int
    codec: int

    def load(self, where: str, trust: bool) -> wp.Volume:
        """Unpacks it.

        Args:
            where: The file, by which messages name it.
            trust: Whether it may become as large as it says.

        Raises:
            WlmError: It becomes more than it may.
            RuntimeError, ValueError and others: `BAD_GRID`.
        """
        if self.codec and not trust:
            check_growth(where, len(self.data), self.size, GROWTH, SURE_BYTES)
        grid = self._unpacked()
        if len(grid) != self.size:
            raise ValueError(f"expected {self.size} bytes of {self.name}, found {len(grid)}")
        meta = bytearray(self.meta)
        struct.pack_into("<Q", meta, _FILE_BYTES, len(grid))
        # Which of the file's it is doesn't matter any more, and Warp would look for the others.
        return wp.Volume.load_from_nvdb(b"".join((self.head[:12], struct.pack("<2H", 1, 0), meta, grid)), device="cpu")

    def _unpacked(self) -> bytes:
        if self.codec not in (_ZIP, _BLOSC):
            return bytes(self.data)
        pieces, at, left = [], 0, self.size
        while at < len(self.data):
            (length,) = struct.unpack_from("<Q", self.data, at)
            piece = bytes(self.data[at + 8 : at + 8 + length])
            if not 0 < length == len(piece):
                raise ValueError(f"expected {length} packed bytes, found {len(piece)}")
            if self.codec == _BLOSC:
                size = blosc.unpacked_size(piece)
                if size > left:
                    raise ValueError(f"expected {self.size} bytes of {self.name}, found more")
                pieces.append(blosc.unpack(piece, size))
            else:
                pieces.append(zlib.decompressobj().decompress(piece, left + 1))
            left -= len(pieces[-1])
            at += 8 + length
        return b"".join(pieces)


def entries(data: bytes) -> Iterator[NanoVdbEntry]:
    """The grids of a file, which may have several segments, each of several grids.

    Raises:
        RuntimeError, ValueError and others: `BAD_GRID`.
    """
    view, at = memoryview(data), 0
    while at < len(data):
        head = bytes(view[at : at + _FILE_HEADER])
        if head[:7] != b"NanoVDB" or head[7:8] not in b"02":
            raise ValueError("NanoVDB signature not found")
        count, codec = struct.unpack_from("<2H", head, 12)
        at += _FILE_HEADER
        metas = []
        for _ in range(count):
            length = struct.unpack_from("<I", data, at + _NAME_LENGTH)[0]
            if not 0 < length <= _LONGEST_NAME:
                raise ValueError(f"expected a name of at most {_LONGEST_NAME} bytes, found {length}")
            metas.append(bytes(view[at : at + _META + length]))
            at += _META + length
        for meta in metas:
            size, packed = struct.unpack_from("<2Q", meta, _GRID_BYTES)
            if at + packed > len(data):
                raise ValueError(f"it ends before its byte {at + packed}")
            name = meta[_META:-1].decode("utf-8", "replace")
            yield NanoVdbEntry(name, view[at : at + packed], head, meta, size if codec else packed, codec)
            at += packed
    if not data:
        raise ValueError("it is empty")


def dense(volume: wp.Volume, name: str, most: int) -> Grid:
    """Makes a grid dense over the box of its active voxels, on its device; where there are none, over voxel 0.

    Args:
        volume: A grid of floats.
        name: By which messages name it.
        most: Voxels that its box may have.

    Raises:
        WlmError: Not of floats, or too large.
    """
    if volume.dtype is not wp.float32:
        raise WlmError(f"{name}: expected a grid of floats, found {volume.get_grid_info().type_str}")
    # Warp exposes neither the box nor the map in doubles.
    head = volume.array()[: _TREE + _ROOT + 8].numpy()
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(struct.unpack_from("<9d", head, _LINEAR)).reshape(3, 3)
    matrix[:3, 3] = struct.unpack_from("<3d", head, _SHIFT)
    root = _TREE + struct.unpack_from("<q", head, _TREE + _ROOT)[0]
    if not 0 < root <= volume.array().size - 24:
        raise WlmError(f"{name}: expected a root within the grid, found it at byte {root}")
    corners = np.frombuffer(volume.array()[root : root + 24].numpy().tobytes(), "<i4").reshape(2, 3).astype(np.int64)
    low, size = corners[0], corners[1] - corners[0] + 1
    if (size < 1).any():
        # Smoke that hasn't begun: one voxel, which is empty.
        low, size = np.zeros(3, np.int64), np.ones(3, np.int64)
    if math.prod(size.tolist()) > most:
        raise WlmError(
            f"{name}: expected a box of at most {most} voxels from a grid of {volume.array().size} bytes, "
            f"found {corners.tolist()}"
        )
    out = wp.empty(tuple(size.tolist()), dtype=float, device=volume.device)
    inputs = [volume.id, wp.vec3i(*low.tolist())]
    wp.launch(kernels.dense, out.shape, inputs, [out], device=volume.device)
    matrix[:3, 3] += matrix[:3, :3] @ low
    return Grid(name, wp.to_torch(out), matrix)
