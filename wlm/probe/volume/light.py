"""Sources of light for a volume: an array, or a model that is decoded on demand."""

from typing import Protocol

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm_kernels.probe import volume_frame as kernels


class Reader(Protocol):
    """A reader of M probes at a time, in place, so that a CUDA graph can contain a reading.

    Attributes:
        numbers: int [M], indices of the probes to read; written by the caller.
        values: float [M, D], written by `run`.
    """

    numbers: wp.array
    values: wp.array

    def run(self) -> None:
        """Reads the probes; on CUDA the work is queued, not awaited."""


class Light(Protocol):
    """The light of N probes.

    Attributes:
        device: "cpu" or "cuda:N".
        count: N.
        channels: D.
    """

    device: str
    count: int
    channels: int

    def reader(self, count: int) -> Reader:
        """Returns a reader of `count` probes at a time."""


class StoredLight:
    """Light of probes in an array: the input of a fit, or an engine's own probes."""

    def __init__(self, values: np.ndarray, device: str = "cpu") -> None:
        """Uploads the probes.

        Args:
            values: [N, D] or [N, C, 3].
            device: "cpu" or "cuda:N".

        Raises:
            WlmError: The device does not exist, or a number is not finite.
            ValueError: The shape is different.
        """
        values = np.asarray(values, np.float32)
        if values.ndim == 3:
            values = values.reshape(len(values), -1)
        if values.ndim != 2 or values.shape[1] < 1:
            raise ValueError(f"values: expected [N, D], got {values.shape}")
        bad = np.flatnonzero(~np.isfinite(values).all(1))
        if len(bad):
            raise WlmError(f"probe {bad[0]}: expected finite numbers, got NaN or infinity")
        self.device = interop.check_device(device)
        self.count, self.channels = values.shape
        self._values = wp.array(values, dtype=float, device=self.device)

    def reader(self, count: int) -> Reader:
        return _StoredReader(self._values, count)


class _StoredReader:
    def __init__(self, stored: wp.array, count: int) -> None:
        self._stored = stored
        self.numbers = wp.zeros(count, dtype=int, device=stored.device)
        self.values = wp.zeros((count, stored.shape[1]), dtype=float, device=stored.device)

    def run(self) -> None:
        kernels.take_rows(self._stored, self.numbers, self.values)


def at_probes(light: Light, numbers: np.ndarray) -> np.ndarray:
    """Returns the light of some probes, float32 [M, D].

    Args:
        light: Light of N probes.
        numbers: int [M], indices from 0 to N - 1.
    """
    if len(numbers) == 0:
        return np.zeros((0, light.channels), np.float32)
    reader = light.reader(len(numbers))
    with interop.stream(light.device):
        reader.numbers.assign(np.asarray(numbers, np.int32))
        reader.run()
        return reader.values.numpy()
