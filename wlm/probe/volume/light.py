"""Sources of probes' light for a volume: an array, or a model that is decoded on demand."""

from typing import Protocol

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm_kernels.probe import volume_frame as kernels

ABSENT = -np.inf
"""Light of a probe that is not in memory yet; its blocks wait."""


class Light(Protocol):
    """A source of the light of `count` probes of `channels` numbers each, on a device, "cpu" or "cuda:N". `time` is the
    hour of the day of the light that `read` writes, from 0 to 24; None if it never changes."""

    device: str
    count: int
    channels: int

    @property
    def time(self) -> float | None: ...

    @property
    def waiting(self) -> bool:
        """Whether light that was asked for is still coming."""
        return False

    def prepare(self, numbers: np.ndarray | None = None) -> None:
        """Brings light into memory: that of the probes `numbers`, int [M], at once; None, before a frame: what earlier
        frames lacked, as far as it has come. Raises a WlmError if a part of the model is damaged."""
        return

    def read(self, numbers: wp.array, values: wp.array) -> None:
        """Writes the light of some probes, or `ABSENT`; on CUDA the work is queued, not awaited.

        The first call for M probes may allocate memory, so only later calls can be captured in a CUDA graph.

        Args:
            numbers: int [M], indices of probes; -1: no probe, nothing is written or it has no meaning.
            values: float [M, D], written.
        """


class StoredLight(Light):
    """Light of probes in an array: the input of a fit, or an engine's own probes."""

    time = None

    def __init__(self, values: np.ndarray, device: str = "cpu") -> None:
        """Uploads the probes, `values` [N, D] or [N, C, 3], to the device "cpu" or "cuda:N". Raises a WlmError if the
        device does not exist, or a number is not finite. Raises a ValueError if the shape is different."""
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

    def read(self, numbers: wp.array, values: wp.array) -> None:
        kernels.take_rows(self._values, numbers, values)


def at_probes(light: Light, numbers: np.ndarray) -> np.ndarray:
    """Returns the light of some probes, float32 [M, D].

    Args:
        light: Light of N probes.
        numbers: int [M], indices from 0 to N - 1.
    """
    if len(numbers) == 0:
        return np.zeros((0, light.channels), np.float32)
    with interop.stream(light.device):
        light.prepare(numbers)
        on_device = wp.array(np.asarray(numbers, np.int32), dtype=int, device=light.device)
        values = wp.empty((len(numbers), light.channels), dtype=float, device=light.device)
        light.read(on_device, values)
        return values.numpy()
