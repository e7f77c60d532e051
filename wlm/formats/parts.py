"""Validation of the parts of a file against a table of types, shapes and ranges, before they are used.

The digest of an artifact detects damage but not malice, since anyone can compute it. So the content of a part is
checked as if the file had no digest.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wlm.errors import one_line

_PIECE = 1 << 20  # numbers checked at once, which bounds the memory of masks


@dataclass(frozen=True)
class Part:
    """The requirements for one array of a file, called a part.

    It has a NumPy type, or one of several, and a shape, in which None allows any length. A part without elements is
    left out of the file; the file may lack an `optional` part, which is then empty along its first axis. `least` and
    `most` are the smallest and largest allowed number, None for no bound, and NaN violates any; `finite` tells whether
    floats must be finite.
    """

    dtype: type | tuple[type, ...]
    shape: tuple[int | None, ...]
    optional: bool = False
    least: float | None = None
    most: float | None = None
    finite: bool = True


def check_parts(tensors: Mapping[str, np.ndarray], table: Mapping[str, Part]) -> dict[str, np.ndarray]:
    """Checks the tensors of a file against its table of parts, which has all parts that the file may have.

    Returns every part of the table; parts that the file leaves out are empty. A ValueError means that a part is unknown
    or missing, has another type or shape, contains NaN or infinity, or is out of range.
    """
    if extra := tensors.keys() - table.keys():
        raise ValueError(f"part {one_line(min(extra), 60)} is unknown")
    return {name: check_part(tensors, name, part) for name, part in table.items()}


def check_part(tensors: Mapping[str, np.ndarray], name: str, part: Part) -> np.ndarray:
    """Checks and returns one tensor of a file, before `check_parts` can check others whose shapes depend on it."""
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
        # The negated comparison makes NaN out of range.
        if part.least is not None and not low >= part.least:
            raise ValueError(f"part {name}: expected {_range(part)}, found {low:g}")
        if part.most is not None and not high <= part.most:
            raise ValueError(f"part {name}: expected {_range(part)}, found {high:g}")
    return value


def all_finite(value: np.ndarray) -> bool:
    """Whether an array has neither NaN nor infinity."""
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
