"""The shape that every rival has, whichever system it is compared with."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

_Payload = TypeVar("_Payload")


@dataclass(frozen=True, eq=False)
class Rival:
    """An input that went through one method.

    Attributes:
        name: The method, a key of its module's `RIVALS`.
        bytes: Size of everything that a decoder needs.
        encode_seconds: Wall-clock time on the CPU from the input to these bytes.
        decode_seconds: Wall-clock time on the CPU from these bytes to `decoded`; None where it isn't measured. A GPU
            decodes block formats in its texture unit: this says nothing of what they cost there.
        decoded: What the system's evaluation scores: a lightmap float32 [H, W, 3], an atlas' `Sampler`, probes
            float32 [N, D].
        option: Settings that the method chose, for a table.
        size: Rows and columns of its texture; None where it has none.
    """

    name: str
    bytes: int
    encode_seconds: float
    decode_seconds: float | None
    decoded: Any
    option: str = ""
    size: tuple[int, int] | None = None

    def to_json(self) -> dict[str, Any]:
        """What a report says of it besides its score."""
        names = ("name", "option", "encode_seconds", "decode_seconds")
        return {name: getattr(self, name) for name in names}


def measure(
    name: str,
    encode: Callable[[], _Payload],
    decode: Callable[[_Payload], Any],
    *,
    bytes: Callable[[_Payload], int] = len,
    option: Callable[[_Payload], str] = lambda payload: "",
) -> Rival:
    """Encodes and decodes, and takes the time of both.

    Args:
        name: The method.
        encode: Makes the payload.
        decode: Reads it.
        bytes: The payload's size.
        option: What to tell of it.
    """
    start = time.perf_counter()
    payload = encode()
    encoded = time.perf_counter()
    decoded = decode(payload)
    end = time.perf_counter()
    return Rival(name, bytes(payload), encoded - start, end - encoded, decoded, option(payload))
