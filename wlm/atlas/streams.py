"""Parts of an artifact as zlib streams; their shapes stand in its settings."""

import math
import zlib
from collections.abc import Mapping

import numpy as np

from wlm.errors import one_line
from wlm.formats.deflate import inflate
from wlm.formats.parts import Part, check_part

_LEVEL = 9
_FREE, _MOST = 1 << 26, 64
_MOST_AXES = 4

Shapes = dict[str, list[int]]
"""Of each part that is a stream."""


def deflated(parts: Mapping[str, np.ndarray]) -> tuple[dict[str, np.ndarray], Shapes]:
    """Compresses parts.

    Args:
        parts: By name.

    Returns:
        Each part as a stream, uint8 [bytes], or as it was where a stream would be larger, or so much smaller that a
        reader would refuse it; and the shapes of those that are streams.
    """
    result, shapes = dict(parts), {}
    for name, part in parts.items():
        stream = zlib.compress(np.ascontiguousarray(part, part.dtype.newbyteorder("<")).tobytes(), _LEVEL)
        if len(stream) < part.nbytes <= _limit(len(stream)):
            result[name], shapes[name] = np.frombuffer(stream, np.uint8), list(part.shape)
    return result, shapes


def inflated(tensors: Mapping[str, np.ndarray], shapes: Shapes, table: Mapping[str, Part]) -> dict[str, np.ndarray]:
    """Reads `deflated` parts; `check_parts` then checks them as any others.

    Args:
        tensors: As read.
        shapes: Of those that are streams.
        table: Their types.

    Raises:
        ValueError: A stream is damaged, none of the file's, or claims far more than it can hold.
    """
    result = dict(tensors)
    for name, shape in shapes.items():
        if name not in table or name not in tensors:
            raise ValueError(f"setting parts: {one_line(name, 60)} is none of the file's")
        stream = check_part(tensors, name, Part(np.uint8, (None,)))
        dtype = np.dtype(table[name].dtype).newbyteorder("<")
        size = math.prod(shape) * dtype.itemsize
        if len(shape) > _MOST_AXES or size > _limit(len(stream)):
            raise ValueError(f"part {name}: {shape}: expected what {len(stream)} bytes can hold")
        data = inflate(stream.tobytes(), size, f"part {name}", f"{size} bytes")
        result[name] = np.frombuffer(data, dtype).reshape(shape).astype(dtype.newbyteorder("="), copy=False)
    return result


def _limit(size: int) -> int:
    """Most bytes that a stream of some bytes may become."""
    return _FREE + _MOST * size
