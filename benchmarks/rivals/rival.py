"""The result of a rival compression method, with its sizes and times, and how these are measured."""

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
        name: Name of the method, a key of `RIVALS` in its module.
        bytes: Size in bytes of everything that a decoder needs.
        encode_seconds: Wall-clock time to compress, on the CPU unless the method is given a device.
        decode_seconds: Wall-clock time to decompress on the same device; None: not timed. For block formats it says
            nothing about a GPU, whose texture unit decodes them.
        decoded: The decompressed data whose error is measured: a lightmap float32 [H, W, 3], a `Sampler` of an atlas,
            or probes float32 [N, D].
        option: Settings that the method chose, as the results table prints them.
        size: Rows and columns of the method's texture; None if it has no texture.
        disk_bytes: Size in bytes after lossless compression, as kept on disk; None if not measured.
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
    """Encodes and decodes with a method, measures both times, and returns the `Rival`.

    Args:
        name: Name of the method.
        encode: Function that makes the encoded payload.
        decode: Function that decodes a payload.
        bytes: Function that returns a payload's size in bytes.
        disk_bytes: Function that returns a payload's size in bytes on disk; this lossless compression is not timed.
        option: Function that returns the settings of a payload as text.
    """
    start = time.perf_counter()
    payload = encode()
    encoded = time.perf_counter()
    decoded = decode(payload)
    end = time.perf_counter()
    rival = Rival(name, bytes(payload), encoded - start, end - encoded, decoded, option(payload))
    return rival if disk_bytes is None else replace(rival, disk_bytes=disk_bytes(payload))


def need_bc() -> None:
    """Imports the packages of BC codecs, which would otherwise count as encode time; a `WlmError` if one is missing."""
    for package in ("ispc_texcomp", "imagecodecs"):
        need(package, EXTRA)


def disk_size(data: bytes) -> int:
    """Returns the size in bytes of data under zstd, as in KTX2 files and game packages; at most its plain size.

    Raises:
        WlmError: imagecodecs, of the extra `baselines`, is missing.
    """
    return min(len(data), len(need("imagecodecs", EXTRA).zstd_encode(data, level=_ZSTD_LEVEL)))
