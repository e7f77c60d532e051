"""Reading of `.npz` files, named arrays in a ZIP file, whose headers are checked before they are inflated.

Members must be stored or deflated, as NumPy writes them: zipfile bounds the output of no other method. Arrays above
`wlm.formats.scratch.IN_MEMORY` are mapped from an unnamed temporary file.
"""

import io
import math
import os
import zipfile
from collections.abc import Callable, Iterable, Sequence
from typing import BinaryIO

import numpy as np

from wlm.errors import WlmError
from wlm.formats.limits import GROWTH, MEMBERS_BYTES, SURE_BYTES, VOLUME_BYTES, Budget
from wlm.formats.reading import damaged, open_file
from wlm.formats.scratch import room

_SUFFIX = ".npy"
_PIECE = 1 << 20  # bytes inflated at once
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_VALUE_BYTES = 4  # readers turn smaller numbers into float32


def read_npz(
    path: str | os.PathLike[str],
    choose: Callable[[Sequence[str]], Iterable[str]],
    *,
    numbers: int,
    sure: int = SURE_BYTES,
) -> dict[str, np.ndarray]:
    """Reads arrays of a `.npz` file by name; none of them contains Python objects.

    `choose` gets the names of all arrays and returns those to read. An array has at most `numbers` values; `sure` is
    its size in bytes that is allowed however small its compressed data is, see `check_growth`.
    """
    # A malicious file can make zipfile and NumPy raise nearly any exception: NumPy parses the header as Python.
    with damaged(f"{path}: cannot read the arrays", Exception), open_file(path, "the arrays") as file:
        size = os.fstat(file.fileno()).st_size
        if size > VOLUME_BYTES:
            raise WlmError(f"{path}: expected a file of at most {VOLUME_BYTES} bytes, found {size}")
        if file.read(len(np.lib.format.MAGIC_PREFIX)) == np.lib.format.MAGIC_PREFIX:
            raise WlmError(f"{path}: expected a .npz file, which names its arrays, found a .npy file of one array")
        budget = Budget(str(path), max(sure, GROWTH * size), "bytes of arrays")
        with zipfile.ZipFile(_Pieces(file)) as archive:  # type: ignore[arg-type]
            members = {info.filename.removesuffix(_SUFFIX): info for info in archive.infolist()}
            arrays = {}
            for name in choose(list(members)):
                if name not in members:
                    raise WlmError(f"{path}: the array {name} is missing; found {', '.join(members) or 'nothing'}")
                arrays[name] = _read(f"{path}: {name}", archive, members[name], numbers, budget)
            return arrays


class _Pieces:
    """A file that refuses to return more than `MEMBERS_BYTES` at once, which zipfile may ask for."""

    def __init__(self, file: BinaryIO) -> None:
        self.seek, self.tell, self.seekable, self._file = file.seek, file.tell, file.seekable, file

    def read(self, size: int = -1) -> bytes:
        data = self._file.read(size if 0 <= size <= MEMBERS_BYTES else MEMBERS_BYTES + 1)
        if len(data) > MEMBERS_BYTES:
            raise ValueError(f"expected a list of members of at most {MEMBERS_BYTES} bytes, found more")
        return data


def _read(where: str, archive: zipfile.ZipFile, info: zipfile.ZipInfo, numbers: int, budget: Budget) -> np.ndarray:
    if info.compress_type not in _METHODS:
        raise WlmError(f"{where}: expected an array that is stored or deflated, found the method {info.compress_type}")
    with archive.open(info) as member:
        # NumPy would inflate a header of any length before it checks it.
        begin = io.BytesIO(member.read(_PIECE))
        shape, by_columns, dtype = _header(where, begin)
        count = math.prod(shape)
        if count > numbers:
            raise WlmError(f"{where}: expected an array of at most {numbers} numbers, found the shape {shape}")
        size, stated = count * dtype.itemsize, info.file_size - begin.tell()
        if stated != size:
            raise WlmError(f"{where}: expected {size} bytes of numbers for the shape {shape}, found {stated}")
        budget.spend(count * max(dtype.itemsize, _VALUE_BYTES))
        flat = room((count,), dtype, where)
        unfilled = memoryview(flat.view(np.uint8)) if size else memoryview(b"")
        piece = begin.read()
        while piece and len(piece) <= len(unfilled):
            unfilled[: len(piece)] = piece
            unfilled = unfilled[len(piece) :]
            # At the end of the member, zipfile compares the checksum.
            piece = member.read(_PIECE)
        if piece or unfilled:
            raise WlmError(f"{where}: the array's data is {'longer' if piece else 'shorter'} than its header states")
        if dtype.kind == "U":
            flat.tolist()  # invalid characters fail here rather than at their first use
    return flat.reshape(shape, order="F" if by_columns else "C")


def _header(where: str, file: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Returns an array's shape, whether it is stored in Fortran order, and its type."""
    version = np.lib.format.read_magic(file)
    readers = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
    if version not in readers:
        raise WlmError(f"{where}: expected version 1.0 or 2.0 of NumPy's .npy format, found {version}")
    shape, by_columns, dtype = readers[version](file)
    if dtype.hasobject or dtype.itemsize == 0 or any(size < 0 for size in shape):
        raise WlmError(f"{where}: expected an array of plain values, found {dtype} {shape}")
    return shape, by_columns, dtype
