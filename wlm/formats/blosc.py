"""Blosc, in which files of volumes pack their numbers."""

import struct

import numpy as np

from wlm.formats.hdr_blocks import need

EXTRA = "smoke"
"""The extra whose package unpacks it."""

_HEADER = 16
_PADDED = 128  # bytes to which OpenVDB fills up what is shorter


def unpacked_size(packed: bytes) -> int:
    """Bytes that packed ones say that they become.

    Raises:
        ValueError: They are cut short.
    """
    if len(packed) < _HEADER:
        raise ValueError(f"expected {_HEADER} bytes of a header of Blosc, found {len(packed)}")
    return struct.unpack_from("<I", packed, 4)[0]


def unpack(packed: bytes, size: int) -> bytes:
    """Unpacks bytes of a known size.

    Raises:
        ValueError: They are damaged or of another size.
        WlmError: The package of the extra is missing.
    """
    stated = unpacked_size(packed)
    if stated != size and not size < stated <= _PADDED:
        raise ValueError(f"expected {size} bytes once unpacked, found a size of {stated}")
    if struct.unpack_from("<I", packed, 12)[0] != len(packed):
        raise ValueError(f"expected {len(packed)} bytes of Blosc, found another number")
    codecs = need("imagecodecs", EXTRA)
    out = np.empty(stated, np.uint8)
    try:
        codecs.blosc_decode(packed, numthreads=1, out=out)
    except codecs.BloscError as error:
        raise ValueError(f"Blosc: {error}") from error
    return out[:size].tobytes()
