"""NanoVDB files of one upper, one lower node and leaves, in each type of values that is read."""

import struct

import numpy as np

_TYPES = {"float": 1, "double": 2, "vec3f": 6, "fp4": 13, "fp8": 14, "fp16": 15, "fpn": 16}
_VERSION = 32 << 21 | 9 << 10
FOG, LEVEL_SET = 2, 1


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask.ravel(), bitorder="little").tobytes()


def _leaf(values: np.ndarray, kind: str, bits: int) -> bytes:
    """Values [8, 8, 8]; `bits` of a code, for fpn."""
    values = values.ravel()
    head = struct.pack("<3i4B", 0, 0, 0, 7, 7, 7, bits.bit_length() - 1 << 5) + _bits(values != 0)
    if kind == "float":
        return head + bytes(16) + values.astype("<f4").tobytes()
    if kind == "double":
        return head + bytes(48) + values.astype("<f8").tobytes()
    low = values.min()
    quantum = (values.max() - low) / (2**bits - 1) or 1.0
    codes = np.rint((values - low) / quantum).astype("<u2")
    if bits == 16:
        packed = codes
    else:
        shifts = np.arange(0, 8, bits)
        packed = (codes.reshape(-1, 8 // bits) << shifts).sum(1).astype(np.uint8)
    return head + struct.pack("<2f", low, quantum) + bytes(8) + packed.tobytes()


def raw_grid(
    values: np.ndarray,
    kind: str = "float",
    name: str = "density",
    group: int = FOG,
    bits: int = 8,
    voxel: float = 0.5,
    origin: tuple[float, float, float] = (1, 2, 3),
) -> bytes:
    """A grid of values [X, Y, Z], multiples of 8, from voxel (0, 0, 0) on, whose centre is `origin`; leaves of one
    value are tiles."""
    wide = kind == "double"
    number, top = ("<d" if wide else "<f"), (96 if wide else 64)
    bits = {"fp4": 4, "fp8": 8, "fp16": 16}.get(kind, bits)
    table = np.zeros(4096, "<i8")
    children, leaves, lower_bytes = np.zeros(4096, bool), [], 1088 + 8 * 4096
    at = lower_bytes
    for place in np.ndindex(*(n // 8 for n in values.shape)):
        part = values[tuple(slice(8 * i, 8 * i + 8) for i in place)]
        index = np.ravel_multi_index(place, (16,) * 3)
        if part.min() == part.max():
            table[index] = struct.unpack("<q", struct.pack(number, part.flat[0]).ljust(8, b"\0"))[0]
            continue
        leaf = _leaf(part, kind, bits)
        children[index], table[index] = True, at
        leaves.append(leaf + bytes(-len(leaf) % 32))
        at += len(leaves[-1])
    lower = bytes(32) + bytes(512) + _bits(children)
    lower = lower.ljust(1088, b"\0") + table.tobytes()
    upper_bytes, first = 8256 + 8 * 32768, np.zeros(32768, bool)
    first[0] = True
    offsets = np.zeros(32768, "<i8")
    offsets[0] = upper_bytes
    upper = (bytes(32) + bytes(4096) + _bits(first)).ljust(8256, b"\0") + offsets.tobytes()
    root = struct.pack("<6iI", 0, 0, 0, *(n - 1 for n in values.shape), 1).ljust(top, b"\0")
    root += struct.pack("<QqI", 0, top + 32, 0).ljust(32, b"\0")
    tree = struct.pack("<4q", 0, 0, 0, 64).ljust(64, b"\0")
    nodes = tree + root + upper + lower + b"".join(leaves)
    head = struct.pack("<8sQ2I2IQ", b"NanoVDB1", 0, _VERSION, 0, 0, 1, 672 + len(nodes)) + name.encode().ljust(
        256, b"\0"
    )
    head = head.ljust(384, b"\0") + struct.pack("<9d", *(voxel * np.eye(3)).ravel())
    head = head.ljust(528, b"\0") + struct.pack("<3d", *origin)
    return head.ljust(632, b"\0") + struct.pack("<2I", group, _TYPES[kind]).ljust(40, b"\0") + nodes


def nvdb_file(*grids: bytes, codec: int = 0, size: int | None = None) -> bytes:
    """A file of raw grids, or of grids that a codec has compressed and that have `size` bytes."""
    data = struct.pack("<8sI2H", b"NanoVDB2", _VERSION, len(grids), codec)
    for grid in grids:
        kind = struct.unpack_from("<2I", grid, 632)[::-1] if not codec else (1, FOG)
        name = (grid[40:296] if not codec else b"density").partition(b"\0")[0] + b"\0"
        meta = struct.pack("<2Q", size or len(grid), len(grid)).ljust(32, b"\0") + struct.pack("<2I", *kind)
        data += meta.ljust(136, b"\0") + struct.pack("<I", len(name)) + bytes(36) + name
    return data + b"".join(grids)
