"""The runtime path: light of a model's own probes and of any other points, on a device."""

from abc import ABC, abstractmethod

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.probe.model import ProbeModel
from wlm.probe.volume.light import Light


class Decoder(ABC):
    """A model on a device; the base of each method's decoder.

    Attributes:
        model, device: The arguments.
    """

    def __init__(self, model: ProbeModel, device: str = "cpu", *, position: np.ndarray | None = None) -> None:
        """Checks the arguments.

        Args:
            model: The model.
            device: "cpu" or "cuda:N".
            position: [N, 3], of the model's own probes, in the order of the fit; None: those stored with the model.

        Raises:
            WlmError: The device does not exist, or the positions are not those of the model's probes.
        """
        self.model, self.device = model, interop.check_device(device)
        self._position = None
        if position is not None:
            self.check_own(position)
            self._position = np.array(position, np.float64)

    @property
    @abstractmethod
    def device_bytes(self) -> int:
        """Bytes of memory that the model takes on the device."""

    @abstractmethod
    def decode(self, position: np.ndarray) -> np.ndarray:
        """Computes the light at any points.

        Args:
            position: [M, 3], in the unit of the probes' positions; points outside the probes' box are moved to its
                surface.

        Returns:
            float32 [M, D].

        Raises:
            WlmError: A position is not finite, or the model needs the positions of its probes and has none.
            ValueError: The shape is different.
        """

    @abstractmethod
    def decode_probes(self) -> np.ndarray:
        """Computes the light of the model's own probes, float32 [N, D], zero where a probe is dead.

        Raises:
            WlmError: The method needs the positions of the probes, and there are none.
        """

    @abstractmethod
    def light(self, position: np.ndarray) -> Light:
        """Returns the light of probes at positions [N, 3] for a volume, decoded on demand.

        Raises:
            WlmError: A position is not finite, or the model is not of Gaussians and these are not its own probes.
        """

    def own_positions(self) -> np.ndarray:
        """Returns the positions of the model's own probes, float64 [N, 3]; a WlmError if none are known."""
        return self.model.stored_positions() if self._position is None else self._position

    def check_own(self, position: np.ndarray) -> None:
        """Raises a WlmError if the number or the box of positions is not that of the model's own probes."""
        if not self.model.has_probes_at(np.asarray(position, np.float64)):
            expected = f"expected the positions of its own {self.model.probes} probes, in their order"
            raise WlmError(f"{self.model.name}: {expected}")
