"""Blosc decompression, for volume files."""

import struct

import numpy as np

from wlm.formats.hdr_blocks import need

EXTRA = "smoke"
"""The optional extra with the package that decompresses Blosc."""

_HEADER = 16
_PADDED = 128  # OpenVDB pads shorter data to this number of bytes


def unpacked_size(packed: bytes) -> int:
    """Returns the decompressed size that the header states, in bytes. Raises a ValueError if the data is cut short."""
    if len(packed) < _HEADER:
        raise ValueError(f"expected a Blosc header of {_HEADER} bytes, found {len(packed)}")
    return struct.unpack_from("<I", packed, 4)[0]


def unpack(packed: bytes, size: int) -> bytes:
    """Decompresses data of a known decompressed size. Raises a ValueError if the data is damaged or has another size.
    Raises a WlmError if the package imagecodecs is missing."""
    stated = unpacked_size(packed)
    if stated != size and not size < stated <= _PADDED:
        raise ValueError(f"expected a decompressed size of {size} bytes, found {stated}")
    (length,) = struct.unpack_from("<I", packed, 12)
    if length != len(packed):
        raise ValueError(f"expected {length} bytes of Blosc data, as its header states, found {len(packed)}")
    codecs = need("imagecodecs", EXTRA)
    out = np.empty(stated, np.uint8)
    try:
        codecs.blosc_decode(packed, numthreads=1, out=out)
    except codecs.BloscError as error:
        raise ValueError(f"Blosc: {error}") from error
    return out[:size].tobytes()
