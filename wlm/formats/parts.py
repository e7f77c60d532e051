"""A file's parts held against a table: their types, shapes and ranges, before anything is made of them.

The digest of an artifact says that it is whole, not who made it: anyone can write one that fits. So what a part holds
is believed no more than a file without a digest would be.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wlm.errors import one_line

_PIECE = 1 << 20  # numbers that are looked at in one go, so that a mask of a large part takes no memory to speak of


@dataclass(frozen=True)
class Part:
    """One part of a file: a row of its table of parts.

    Attributes:
        dtype: NumPy type, or the types of which it is one.
        shape: Sizes; None where any size will do. A part with a size of 0 is left out of the file.
        optional: Whether the file may lack it; it is then empty along its first axis.
        least, most: Bounds of its numbers; None: any. NaN is within none.
        finite: Whether floats must be finite.
    """

    dtype: type | tuple[type, ...]
    shape: tuple[int | None, ...]
    optional: bool = False
    least: float | None = None
    most: float | None = None
    finite: bool = True


def check_parts(tensors: Mapping[str, np.ndarray], table: Mapping[str, Part]) -> dict[str, np.ndarray]:
    """Checks the tensors of a file against its table of parts.

    Args:
        tensors: By name, as read.
        table: By name, all parts that the file may have.

    Returns:
        Every part of the table; those that the file leaves out are empty.

    Raises:
        ValueError: A part is none of the table, is missing, of another type or shape, holds NaN or infinity, or is out
            of its range.
    """
    if extra := tensors.keys() - table.keys():
        raise ValueError(f"part {one_line(min(extra), 60)} is none of the file's")
    return {name: check_part(tensors, name, part) for name, part in table.items()}


def check_part(tensors: Mapping[str, np.ndarray], name: str, part: Part) -> np.ndarray:
    """Checks one tensor of a file, as `check_parts`: for those that say how large the others are."""
    kinds = part.dtype if isinstance(part.dtype, tuple) else (part.dtype,)
    value = tensors.get(name)
    if value is None:
        if part.optional:
            return np.zeros((0, *(size or 0 for size in part.shape[1:])), kinds[0])
        if 0 in part.shape:
            return np.zeros([size or 0 for size in part.shape], kinds[0])
        raise ValueError(f"part {name} is missing")
    sizes = value.shape
    fits = sizes == part.shape or (
        len(sizes) == len(part.shape)
        and all(expected in (None, size) for size, expected in zip(sizes, part.shape, strict=True))
    )
    if value.dtype not in kinds or not fits:
        types = " or ".join(np.dtype(kind).name for kind in kinds)
        shape = ", ".join("any" if size is None else str(size) for size in part.shape)
        raise ValueError(f"part {name} is {value.dtype} {sizes}, expected {types} ({shape})")
    if part.finite and not all_finite(value):
        raise ValueError(f"part {name}: expected finite numbers, found NaN or infinity")
    if value.size and (part.least is not None or part.most is not None):
        low, high = np.minimum.reduce(value, axis=None), np.maximum.reduce(value, axis=None)
        # This way round NaN is out of range.
        if part.least is not None and not low >= part.least:
            raise ValueError(f"part {name}: expected {_range(part)}, found {low:g}")
        if part.most is not None and not high <= part.most:
            raise ValueError(f"part {name}: expected {_range(part)}, found {high:g}")
    return value


def all_finite(value: np.ndarray) -> bool:
    """Whether an array holds neither NaN nor infinity."""
    if value.dtype.kind != "f":
        return True
    if value.size <= _PIECE:
        return bool(np.isfinite(value).all())
    flat = value.reshape(-1)
    return all(np.isfinite(flat[start : start + _PIECE]).all() for start in range(0, flat.size, _PIECE))


def _range(part: Part) -> str:
    if part.most is None:
        return f"numbers of at least {part.least:g}"
    return f"numbers of at most {part.most:g}" if part.least is None else f"{part.least:g} to {part.most:g}"
