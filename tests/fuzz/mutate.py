"""Changes of bytes, numbers, JSON, text and arrays, drawn from a `random.Random` and nothing else."""

import json
import math
import struct
from collections.abc import Iterator, Sequence
from random import Random
from typing import Any

import numpy as np

# Around the widths of integers and the sizes at which buffers, images and strings tend to end.
_NEAR = (8, 16, 32, 64, 128, 256, 512, 1000, 4096, 16384, 65536, 1 << 20, 1 << 24, 1 << 31, 1 << 32, 1 << 48, 1 << 63)
INTEGERS = (*range(10), *(value + shift for value in _NEAR for shift in (-1, 0, 1)))
FLOATS = (math.nan, math.inf, -math.inf, 0.0, -0.0, 1.0, -1.0, 0.5, 1e-45, 1e-30, 65504.0, 1e30, -1e30, 3.4e38, 1e300)
_SIGNED = (-1, -2, -128, -(1 << 31), -(1 << 63), 10**30, 10**400)
_TEXTS = *"x é nan 1e999 ../x /dev/zero".split(), "", " ", "x" * 5000, "\0", "a\nb", "\x1b[31m", "\u202e", "\ud800"
NAMES = ("../a.exr", "/etc/passwd", "/dev/zero", "/dev/stdin", "..", ".", "x" * 5000, "\ud800", "a.exr\n", "mask.png")
"""File names that a reader must not follow, or cannot."""

_VALUES = (*INTEGERS, *_SIGNED, *FLOATS, *_TEXTS, None, True, False, [], {}, [[]], [1, 2, 3], {"a": 1})
_TYPES = ("?", "u1", "i1", "<u2", "<i2", "<f2", "<u4", "<i4", "<f4", ">f4", "<u8", "<i8", "<f8", "<c8", "S4", "<U3")


def _some(draw: Random) -> int:
    """How many changes of one kind to make: most often one."""
    return draw.choice((1, 1, 1, 2, 2, 3, 6))


def _place(draw: Random, size: int, width: int = 1) -> int:
    """A place for `width` bytes, in the first 512 bytes more often than not: there the headers are."""
    last = max(size - width, 0)
    return draw.randint(0, min(last, 512) if draw.random() < 0.5 else last)


def _number(draw: Random, width: int, old: bytes) -> bytes:
    """`width` bytes of an interesting integer or float, or of the old integer and a little."""
    order = draw.choice(("little", "little", "little", "big"))
    kind = draw.randrange(10)
    if kind < 5:
        value = draw.choice(INTEGERS)
    elif kind < 7:
        value = int.from_bytes(old, order) + draw.choice((-16, -4, -1, 1, 2, 16, 4096))
    elif kind < 8 or width == 1:
        value = draw.getrandbits(8 * width)
    else:
        number = draw.choice(FLOATS)
        try:
            packed = struct.pack({2: "e", 4: "f", 8: "d"}[width], number)
        except OverflowError:
            packed = struct.pack({2: "e", 4: "f", 8: "d"}[width], math.inf)
        return packed
    return (value % (1 << 8 * width)).to_bytes(width, order)


def corrupt(draw: Random, data: bytes, others: Sequence[bytes] = ()) -> bytes:
    """Changes bytes blindly."""
    result = bytearray(data)
    for _ in range(_some(draw)):
        size = len(result)
        kind = draw.randrange(9)
        if not size:
            result += draw.randbytes(8)
        elif kind == 0:
            for _ in range(draw.choice((1, 1, 2, 8))):
                result[_place(draw, size)] ^= 1 << draw.randrange(8)
        elif kind == 1:
            del result[draw.randrange(size) :]
        elif kind == 2:
            result += draw.randbytes(draw.choice((1, 4, 16, 1000)))
        elif kind == 3:
            at = _place(draw, size)
            del result[at : at + draw.choice((1, 2, 4, 8, 32, 200))]
        elif kind == 4:
            at = _place(draw, size)
            result[at:at] = result[at : at + draw.choice((1, 4, 8, 32, 200))]
        elif kind == 5:
            at = _place(draw, size)
            count = min(draw.choice((1, 4, 16, 64, 512)), size - at)
            result[at : at + count] = bytes([draw.choice((0, 255, 65))]) * count
        elif kind == 6:
            other = draw.choice(others or (data,))
            count, at, start = draw.choice((8, 64, 512)), _place(draw, size), _place(draw, len(other))
            result[at : at + count] = other[start : start + count]
        else:
            width = draw.choice((1, 2, 4, 4, 8, 8))
            at = _place(draw, size, width)
            if draw.random() < 0.7:
                at -= at % min(width, 4)
            result[at : at + width] = _number(draw, width, result[at : at + width])
    return bytes(result)


def vary_numbers(draw: Random, data: bytes, places: Sequence[tuple[int, int]]) -> bytes:
    """Replaces numbers at known places, (offset, width) each, by interesting ones."""
    result = bytearray(data)
    for _ in range(_some(draw)):
        at, width = draw.choice(places)
        result[at : at + width] = _number(draw, width, result[at : at + width])
    return bytes(result)


def _slots(value: Any) -> Iterator[tuple[Any, Any]]:
    """Every (container, key) of a tree of JSON; of long lists the first elements."""
    items = value.items() if isinstance(value, dict) else enumerate(value[:40]) if isinstance(value, list) else ()
    for key, item in items:
        yield value, key
        yield from _slots(item)


def _copied(value: Any) -> Any:
    return json.loads(json.dumps(value))


def vary_json(draw: Random, value: Any) -> Any:
    """A copy of a JSON value with some of its parts replaced, removed, renamed, exchanged or nested."""
    root = [_copied(value)]
    for _ in range(_some(draw)):
        slots = list(_slots(root))
        # The root itself now and then.
        holder, key = draw.choice(slots[1:] if len(slots) > 1 and draw.random() < 0.97 else slots)
        kind, old = draw.randrange(12), holder[key]
        if kind == 0 and holder is not root:
            del holder[key]
        elif kind == 1 and isinstance(holder, dict):
            holder[draw.choice(("x", "", "name", "__class__", f"{key}_", key.upper()))] = holder.pop(key)
        elif kind == 2:
            other, place = draw.choice(slots)
            # Copied, so that the tree stays one.
            holder[key] = _copied(other[place])
        elif kind == 3:
            for _ in range(draw.choice((1, 2, 20, 60))):
                holder[key] = [holder[key]]
        elif kind == 4 and isinstance(old, list) and old:
            holder[key] = old * draw.choice((2, 3, 100))
        elif kind <= 7 and type(old) in (int, float):
            near = (old + 1, old - 1, -old, 1000 * old, str(old), [old])
            holder[key] = draw.choice(near if abs(old) > 1e300 else (*near, old / 3, old + 0.5))
        else:
            holder[key] = _copied(draw.choice(_VALUES))
    return root[0]


def vary_text(draw: Random, text: str, fragments: Sequence[str]) -> bytes:
    """Changes lines: words replaced by `fragments` or numbers, lines repeated, moved, joined, cut or indented."""
    lines = text.split("\n")
    for _ in range(_some(draw)):
        at, kind = draw.randrange(len(lines)), draw.randrange(7)
        line = lines[at]
        new = draw.choice(fragments) if draw.random() < 0.6 else json.dumps(draw.choice(_VALUES))
        words = line.split(" ")
        key, colon, _ = line.partition(":")
        if kind <= 1:
            words[draw.randrange(len(words))] = new
            lines[at] = " ".join(words)
        elif kind == 2:
            lines[at] = f"{key}{colon} {new}"
        elif kind == 3:
            lines[at] = f"{line}\n{new}"
        elif kind == 4:
            lines[at] = f"{line}\n{lines[draw.randrange(len(lines))]}"
        elif kind == 5:
            lines[at] = draw.choice(("", "  " + line, line.strip(), line[: len(line) // 2], line + " " + line))
        else:
            lines[at] = f"{key}{draw.choice(('x', ''))}{colon}\n  {new}"
    return "\n".join(lines).encode("utf-8", "replace")


def vary_array(draw: Random, array: np.ndarray) -> np.ndarray:
    """An array of other values, another shape or another type."""
    kind = draw.randrange(8)
    if kind == 0:
        shape = [max(size + draw.choice((-1, 0, 1)), 0) for size in array.shape]
        return np.resize(array, shape) if array.size else np.zeros(shape, array.dtype)
    if kind == 1:
        return draw.choice((array.reshape(-1), array[None], array[..., None], array[:0] if array.ndim else array))
    if kind == 2:
        target = draw.choice(_TYPES[-2:] if array.dtype.kind in "SU" else _TYPES)
        try:
            with np.errstate(all="ignore"):
                return array.astype(target)
        except UnicodeError:  # bytes that are no text
            return array
    if kind == 3:
        data, dtype = array.tobytes(), np.dtype(draw.choice(_TYPES))
        return np.frombuffer(data[: len(data) - len(data) % dtype.itemsize], dtype)
    values = np.array(array).reshape(-1)
    for _ in range(draw.choice((1, 1, 3, values.size))):
        if values.size and values.dtype.kind in "fiub":
            values[draw.randrange(values.size)] = _value_of(draw, values.dtype)
    return values.reshape(array.shape)


def _value_of(draw: Random, dtype: np.dtype) -> Any:
    if dtype.kind == "f":
        with np.errstate(all="ignore"):
            return np.float64(draw.choice(FLOATS)).astype(dtype)
    if dtype.kind == "b":
        return draw.random() < 0.5
    limits = np.iinfo(dtype)
    return draw.choice((limits.min, limits.max, limits.max - 1, 0, 1, 2, 3, 4, 5, 127))
