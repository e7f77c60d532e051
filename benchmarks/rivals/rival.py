"""The result of a rival of any system, and its measurement."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from wlm.formats.hdr_blocks import need

EXTRA = "baselines"
"""The extra with the packages of block codecs, video and zstd."""

_ZSTD_LEVEL = 19  # the strongest without the options for which a decoder needs much memory

_Payload = TypeVar("_Payload")


@dataclass(frozen=True, eq=False)
class Rival:
    """An input compressed and decoded by one method.

    Attributes:
        name: The method, a key of its module's `RIVALS`.
        bytes: Size of everything that a decoder needs.
        encode_seconds: Wall-clock time from the input to these bytes, on the CPU unless the method is given a device.
        decode_seconds: Wall-clock time from these bytes to `decoded`, likewise; None where it isn't measured. A GPU
            decodes block formats in its texture unit: this says nothing of what they cost there.
        decoded: What the system's evaluation scores: a lightmap float32 [H, W, 3], an atlas' `Sampler`, probes
            float32 [N, D].
        option: Settings that the method chose, for a table.
        size: Rows and columns of its texture; None where it has none.
        disk_bytes: Size of the same after lossless compression, where it is kept on a disk; None where that isn't
            measured.
    """

    name: str
    bytes: int
    encode_seconds: float
    decode_seconds: float | None
    decoded: Any
    option: str = ""
    size: tuple[int, int] | None = None
    disk_bytes: int | None = None


def measure(
    name: str,
    encode: Callable[[], _Payload],
    decode: Callable[[_Payload], Any],
    *,
    bytes: Callable[[_Payload], int] = len,
    disk_bytes: Callable[[_Payload], int] | None = None,
    option: Callable[[_Payload], str] = lambda payload: "",
) -> Rival:
    """Encodes and decodes, and takes the time of both.

    Args:
        name: The method.
        encode: Makes the payload.
        decode: Reads it.
        bytes: The payload's size.
        disk_bytes: Its size on a disk; compressing for that takes no part in the times.
        option: Describes the settings of the payload.
    """
    start = time.perf_counter()
    payload = encode()
    encoded = time.perf_counter()
    decoded = decode(payload)
    end = time.perf_counter()
    rival = Rival(name, bytes(payload), encoded - start, end - encoded, decoded, option(payload))
    return rival if disk_bytes is None else replace(rival, disk_bytes=disk_bytes(payload))


def disk_size(data: bytes) -> int:
    """Returns the size of some bytes under zstd, as in KTX2 files and packages of engines, or uncompressed if smaller.

    Raises:
        WlmError: imagecodecs, of the extra `baselines`, is missing.
    """
    return min(len(data), len(need("imagecodecs", EXTRA).zstd_encode(data, level=_ZSTD_LEVEL)))
