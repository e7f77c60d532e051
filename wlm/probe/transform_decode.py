"""The runtime path of a transform's file: its probes as they are stored, and the light between them."""

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.probe.kriging import Kriging
from wlm.probe.model import check_points, live_probes
from wlm.probe.transform import Transform
from wlm_kernels.probe.mixture import mix


class PlacedPoints:
    """Points on a device, each with the probes that its light is made of.

    Attributes:
        index, weight: int and float [M, K].
        out: float [M, D], filled by `TransformDecoder.run`.
    """

    def __init__(self, index: np.ndarray, weight: np.ndarray, outputs: int, device: str):
        self.index = wp.array(index.astype(np.int32), dtype=int, device=device)
        self.weight = wp.array(weight.astype(np.float32), dtype=float, device=device)
        self.out = wp.zeros((len(index), outputs), dtype=float, device=device)

    def values(self) -> np.ndarray:
        """The decoded light, float32 [M, D]."""
        return self.out.numpy()


class TransformDecoder:
    """A model of a transform on a device.

    It is unpacked where its probes' places are known: here, if the file has them or they are given, else by
    `decode_probes`. All numbers of all probes are then on the device.

    Attributes:
        model, device: The arguments.
    """

    def __init__(
        self, model: Transform, device: str = "cpu", *, position: np.ndarray | None = None, lazily: bool = False
    ):
        """Loads a model.

        Args:
            model: The model.
            device: "cpu" or "cuda:0".
            position: [N, 3], of the model's own probes; None: those stored with it, if there are.
            lazily: Whether stored positions wait until they are asked for.

        Raises:
            WlmError: No such device, or other positions.
        """
        self.model, self.device = model, interop.check_device(device)
        self._values: np.ndarray | None = None
        if position is not None:
            self._place(position)
        elif model.has_positions and not lazily:
            self._hold(model.stored_values, model.stored_positions())

    @property
    def device_bytes(self) -> int:
        """Memory that the model takes on the device; 0 as long as the places are not known."""
        return 0 if self._values is None else self._rows.size * 4

    def points(self, position: np.ndarray) -> PlacedPoints:
        """Puts points on the device, to be decoded often.

        Args:
            position: [M, 3], in the unit of the probes' positions; those outside the live probes' box are moved to its
                nearest point.

        Raises:
            WlmError: A position that isn't finite, or the model's own places are not known yet.
            ValueError: Another shape.
        """
        position = check_points(position)
        if self._values is None:
            raise WlmError(f"{self.model.name}: the file has no positions; expected those of its probes first")
        inside = np.clip(position, self._low, self._high) - self._low
        return PlacedPoints(*self._kriging.weights(inside), self.model.outputs, self.device)

    def run(self, points: PlacedPoints) -> None:
        """Decodes points where they lie; on CUDA it is queued, not awaited."""
        if points.index.shape[0]:
            mix(self._rows, points.index, points.weight, points.out)

    def decode(self, position: np.ndarray) -> np.ndarray:
        """Light at any points by kriging of the live probes, float32 [M, D]; arguments and errors as for `points`."""
        points = self.points(position)
        self.run(points)
        return points.values()

    def decode_probes(self, position: np.ndarray | None = None) -> np.ndarray:
        """The model's own probes, as they are stored.

        Args:
            position: [N, 3], as they were compressed and in that order; None: those stored with the model.

        Returns:
            float32 [N, D], zero where a probe is dead.

        Raises:
            WlmError: Other positions, or none are known.
        """
        if position is not None and not self.model.has_probes_at(np.asarray(position, np.float64)):
            count = self.model.probes
            raise WlmError(f"{self.model.name}: expected the positions of its own {count} probes, in their order")
        if self._values is None:
            self._place(self.model.stored_positions() if position is None else position)
        return self._values.copy()

    def _place(self, position: np.ndarray) -> None:
        position = np.asarray(position, np.float64)
        self._hold(self.model.values_at(position), position)

    def _hold(self, values: np.ndarray, position: np.ndarray) -> None:
        model = self.model
        live = live_probes(model.dead, model.probes)
        self._low, self._high = position[live].min(0), position[live].max(0)
        self._kriging = Kriging(position[live] - self._low)
        self._rows = wp.array(values[live], dtype=float, device=self.device)
        self._values = values
