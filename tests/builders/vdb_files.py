"""OpenVDB files, written as the format has them: trees of one inner node of each kind, of leaves and of tiles."""

import struct
import zlib

import imagecodecs
import numpy as np

ZIP, ACTIVE_MASK, BLOSC = 1, 2, 4
_UUID = b"00000000-0000-0000-0000-000000000000"
_LEAF, _LOWER, _UPPER = 8, 16, 32


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _bits(mask: np.ndarray) -> bytes:
    return np.packbits(mask.ravel(), bitorder="little").tobytes()


class _Writer:
    def __init__(self, flags: int, half: bool, background: float, one: str) -> None:
        self._flags, self._one = flags, one
        self._type, self._background = "<f2" if half else {"f": "<f4", "d": "<f8"}[one], np.float32(background)

    def values(self, values: np.ndarray, active: np.ndarray) -> bytes:
        """Values [count] as the flags have them, with what isn't active in the shortest of the format's ways."""
        values, active = values.ravel(), active.ravel()
        if not self._flags & ACTIVE_MASK:
            return b"\6" + self._packed(values)
        others = np.unique(values[~active])
        bg, stored = self._background, self._packed(values[active])
        first, last = (others[0], others[-1]) if len(others) else (bg, bg)
        if len(others) > 2:
            return b"\6" + self._packed(values)
        if len(others) < 2 and first in (bg, -bg):
            return (b"\0" if first == bg else b"\1") + stored
        if len(others) < 2:
            return b"\2" + struct.pack(f"<{self._one}", first) + stored
        if set(others) == {bg, -bg}:
            return b"\3" + _bits(~active & (values == bg)) + stored
        if bg in others:
            one = first if last == bg else last
            return b"\4" + struct.pack(f"<{self._one}", one) + _bits(~active & (values == bg)) + stored
        return b"\5" + struct.pack(f"<2{self._one}", first, last) + _bits(~active & (values == last)) + stored

    def _packed(self, values: np.ndarray) -> bytes:
        data = values.astype(self._type).tobytes()
        if (not data and self._type == "<f2") or not self._flags & (ZIP | BLOSC):
            return data
        packed = zlib.compress(data) if self._flags & ZIP else imagecodecs.blosc_encode(data) if data else data
        if len(packed) >= len(data):
            return struct.pack("<q", -len(data)) + data
        return struct.pack("<q", len(packed)) + packed


def tree(
    values: np.ndarray, active: np.ndarray, flags: int, half: bool = False, background: float = 0.0, one: str = "f"
) -> bytes:
    """A tree of values [X, Y, Z] from voxel 0 on, multiples of 8 up to 128; leaves of one active value become tiles.
    `one` is "d" for doubles."""
    writer = _Writer(flags, half, background, one)
    shape = [n // _LEAF for n in values.shape]
    tiles, filled, leaves = np.full((_LOWER,) * 3, np.float32(background)), np.zeros((_LOWER,) * 3, bool), []
    children = np.zeros((_LOWER,) * 3, bool)
    for place in np.ndindex(*shape):
        part = tuple(slice(_LEAF * i, _LEAF * i + _LEAF) for i in place)
        numbers, on = values[part], active[part]
        if on.all() and numbers.min() == numbers.max():
            tiles[place], filled[place] = numbers.flat[0], True
        elif on.any() or (numbers != background).any():
            children[place] = True
            leaves.append((numbers, on))
    top = np.zeros((_UPPER,) * 3, bool)
    top[0, 0, 0] = True
    none = np.zeros_like(top)
    result = struct.pack(f"<I{one}II3i", 1, background, 0, 1, 0, 0, 0)
    result += _bits(top) + _bits(none) + writer.values(np.full(top.shape, np.float32(background)), none)
    result += _bits(children) + _bits(filled) + writer.values(tiles, filled)
    result += b"".join(_bits(on) for _, on in leaves)
    return result + b"".join(_bits(on) + writer.values(numbers, on) for numbers, on in leaves)


def scaled(*scale: float) -> bytes:
    """A map of voxels with those edges."""
    edges = np.array(scale)
    numbers = np.concatenate([edges, edges, 1 / edges, 1 / edges**2, 0.5 / edges])
    return _text("ScaleMap") + numbers.astype("<f8").tobytes()


def affine(matrix: np.ndarray) -> bytes:
    """A map of [4, 4], which takes columns."""
    return _text("AffineMap") + np.asarray(matrix, "<f8").T.tobytes()


def vdb_file(grids: dict[str, tuple[bytes, bytes, int, bool]]) -> bytes:
    """A file of grids: for each name its map, its tree, the flags and whether it has half floats. A class and a type
    may follow a name: "density|fog volume|double"."""
    data = struct.pack("<qIII?", 0x56444220, 224, 10, 0, True) + _UUID + struct.pack("<II", 0, len(grids))
    for name, (placed, nodes, flags, half) in grids.items():
        name, each, kind = name.split("|") if "|" in name else (name, "", "float")
        data += _text(name) + _text(f"Tree_{kind}_5_4_3" + "_HalfFloat" * half) + _text("")
        metadata = _text("is_saved_as_half_float") + _text("bool") + struct.pack("<I?", 1, half)
        metadata += (_text("class") + _text("string") + _text(each)) if each else b""
        head = struct.pack("<2I", flags, 1 + bool(each)) + metadata + placed
        begin = len(data) + 24
        data += struct.pack("<3q", begin, begin + len(head), begin + len(head) + len(nodes)) + head + nodes
    return data
