"""Decodes the light of a compressed model on a CPU or GPU: at the model's own probes or at any points."""

from abc import ABC, abstractmethod
from typing import Any

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.hours import DAY, neighbours
from wlm.probe.hours import check_time
from wlm.probe.model import ProbeModel
from wlm.probe.volume.light import Light
from wlm_kernels.probe.hours import mix_hours


class Decoder(ABC):
    """A model loaded onto a CPU or GPU; the base class of the decoders of all compression methods.

    Attributes:
        model, device: The model, and the name of its device.
        time: Hour of the day of the light that is decoded, from 0 to 24; None for a model of one hour.
    """

    time: float | None = None

    def __init__(self, model: ProbeModel, device: str = "cpu", *, position: np.ndarray | None = None) -> None:
        """Stores the model after checking the arguments.

        Args:
            model: The model.
            device: "cpu" or "cuda:N".
            position: [N, 3], positions of the model's probes, in the order of the fit; None: the stored ones.

        Raises:
            WlmError: The device does not exist, or the positions are not those of the model's probes.
        """
        self.model, self.device = model, interop.check_device(device)
        self._arrays: list[wp.array] = []
        self.time = float(model.times[0]) if len(model.times) else None
        self._hours: tuple[wp.array, wp.array] | None = None
        self._position = None
        if position is not None:
            self.check_own(position)
            self._position = np.array(position, np.float64)

    def _put(self, array: np.ndarray, dtype: type) -> wp.array:
        self._arrays.append(wp.array(array, dtype=dtype, device=self.device))
        return self._arrays[-1]

    @property
    def device_bytes(self) -> int:
        """The bytes of memory that the model takes on the device."""
        return sum(array.capacity for array in self._arrays)

    def _contents(self) -> list[Any]:
        """Returns the model's content at each hour, as contents of one hour."""
        content, scales = self.model.content, self.model.scales
        return [content.at(row, scales) for row in np.eye(len(scales))] if len(self.model.times) else [content]

    def _keep_hours(self, numbers: np.ndarray, mixed: wp.array) -> None:
        """Uploads the numbers at each hour, [T, P], that `set_time` mixes into a device array of P numbers."""
        if len(numbers) > 1:
            self._hours = self._put(numbers, float), mixed

    def set_time(self, time: float) -> None:
        """Sets the time of the light that is decoded from now on; at first it is the model's first hour.

        Light between two hours is linear between theirs, and the day begins again after 24 hours. A model of one hour
        has the same light at any time. On CUDA the work is queued, not awaited. A volume decodes the blocks that it has
        again, at most its budget in a frame, where their light is off by more than its `tolerance`.

        Raises:
            WlmError: The time is not finite.
        """
        check_time(time)
        if self._hours is not None:
            self.time = time % DAY
            hours, mixed = self._hours
            mix_hours(hours, *neighbours(self.model.times, DAY, time), mixed)

    def decode_hours(self, position: np.ndarray) -> np.ndarray:
        """Returns the light at points at all of T hours, float32 [M, T D], and sets the time to the first hour;
        arguments and errors are those of `decode`."""
        light = []
        for time in (*self.model.times[1:], *self.model.times[:1]) or (0.0,):
            self.set_time(time)
            light.append(self.decode(position))
        return np.concatenate(light[-1:] + light[:-1], 1)

    @abstractmethod
    def decode(self, position: np.ndarray) -> np.ndarray:
        """Returns the light at any points.

        Args:
            position: [M, 3], in the unit of the probes' positions; points outside the probes' box are moved to its
                surface.

        Returns:
            float32 [M, D], for each point as many numbers as a probe has.

        Raises:
            WlmError: A position is not finite, or the decoder needs the positions of the probes, and they are unknown.
            ValueError: The shape is different.
        """

    @abstractmethod
    def decode_probes(self) -> np.ndarray:
        """Returns the light of the model's own probes, float32 [N, D], zero for dead probes.

        Raises:
            WlmError: The decoder needs the positions of the probes, and they are unknown.
        """

    @abstractmethod
    def light(self, position: np.ndarray) -> Light:
        """Returns a source that decodes the light of probes at positions [N, 3] whenever a volume asks for it.

        Raises:
            WlmError: A position is not finite; or the model stores principal components, which are only known at its
                own probes, and `position` has other points.
        """

    def own_positions(self) -> np.ndarray:
        """Returns the positions of the model's own probes, float64 [N, 3]; raises a WlmError if none are known."""
        return self.model.stored_positions() if self._position is None else self._position

    def check_own(self, position: np.ndarray) -> None:
        """Raises a WlmError if the positions differ from those of the model's own probes in number or bounding box."""
        if not self.model.has_probes_at(np.asarray(position, np.float64)):
            expected = f"expected the positions of its own {self.model.probes} probes, in their order"
            raise WlmError(f"{self.model.name}: {expected}, got {len(position)} in another number or bounding box")
