"""Where the light of probes comes from when a volume asks for it: an array, or a model that is decoded on demand."""

from typing import Protocol

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.probe.decode import Decoder
from wlm.probe.model import check_points
from wlm_kernels.probe import volume_frame as kernels


class Reader(Protocol):
    """Probes of one count, read again and again in place; a graph can hold a reading.

    Attributes:
        numbers: int [M], which probes; written by the caller.
        values: float [M, D], written by `run`.
    """

    numbers: wp.array
    values: wp.array

    def run(self) -> None:
        """Reads the probes; on CUDA it is queued, not awaited."""


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
        """Makes a reader of so many probes at a time."""


class ProbeDecoder(Protocol):
    """Any model of probes on a device.

    Attributes:
        device: "cpu" or "cuda:N".
    """

    device: str

    def decode_probes(self, position: np.ndarray) -> np.ndarray:
        """The light of the model's own probes, float32 [N, D]."""


class StoredLight:
    """Probes as an array: the light before a model, or an engine's own."""

    def __init__(self, values: np.ndarray, device: str = "cpu"):
        """Puts them on a device.

        Args:
            values: [N, D] or [N, C, 3].
            device: "cpu" or "cuda:N".

        Raises:
            WlmError: No such device, or a number isn't finite.
            ValueError: Another shape.
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
    def __init__(self, stored: wp.array, count: int):
        self._stored = stored
        self.numbers = wp.zeros(count, dtype=int, device=stored.device)
        self.values = wp.zeros((count, stored.shape[1]), dtype=float, device=stored.device)

    def run(self) -> None:
        kernels.take_rows(self._stored, self.numbers, self.values)


class DecodedLight:
    """Probes that a model is decoded at, where and when they are asked for."""

    def __init__(self, decoder: Decoder, position: np.ndarray):
        """Puts their places on the decoder's device.

        Args:
            decoder: The model.
            position: [N, 3], of all probes, in the unit of the model's.

        Raises:
            WlmError: A position that isn't finite.
            ValueError: Another shape.
        """
        self._decoder = decoder
        self.device, self.channels = decoder.device, decoder.model.outputs
        position = check_points(position, "N")
        self._x = wp.array(decoder.model.normalise(position), dtype=wp.vec3, device=self.device)
        self.count = len(position)

    def reader(self, count: int) -> Reader:
        return _DecodedReader(self._decoder, self._x, count)


class _DecodedReader:
    def __init__(self, decoder: Decoder, x: wp.array, count: int):
        self._decoder, self._x = decoder, x
        self._points = decoder.points(np.zeros((count, 3)))
        self.numbers = wp.zeros(count, dtype=int, device=decoder.device)
        self.values = self._points.out

    def run(self) -> None:
        kernels.take_points(self._x, self.numbers, self._points.x)
        self._decoder.run(self._points)


def light_of(decoder: ProbeDecoder, position: np.ndarray) -> Light:
    """The light of a model's own probes: decoded on demand from Gaussians, else unpacked now.

    Args:
        decoder: Of the model, on the device where the light is wanted.
        position: [N, 3], of all its probes, in the order of the fit.

    Raises:
        WlmError: The probes aren't as many as the model's, or a position isn't finite.
    """
    if isinstance(decoder, Decoder):
        return DecodedLight(decoder, position)
    return StoredLight(decoder.decode_probes(position), decoder.device)


def at_probes(light: Light, numbers: np.ndarray) -> np.ndarray:
    """The light at some probes, float32 [M, D].

    Args:
        light: Of N probes.
        numbers: int [M], 0 to N - 1.
    """
    if len(numbers) == 0:
        return np.zeros((0, light.channels), np.float32)
    reader = light.reader(len(numbers))
    with interop.stream(light.device):
        reader.numbers.assign(np.asarray(numbers, np.int32))
        reader.run()
        return reader.values.numpy()
