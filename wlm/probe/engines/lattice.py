"""Decodes a model on a lattice of cubic cells over its probes' box, for engines that store light on lattices."""

from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.probe.decode import Decoder
from wlm.probe.model import ProbeModel

CELLS = 24
"""Default number of cells along the longest side of the box."""

NUMBERS = 27
"""Numbers of a probe with second-order spherical harmonics in three colours."""

_ROWS = 65536  # points decoded at a time


@dataclass(frozen=True)
class Lattice:
    """A lattice of cubic cells over the bounding box of a model's probes.

    Attributes:
        decoder: Decoder of the model.
        low: float64 [3], lowest corner.
        size: Side of a cell, in the unit of the probes' positions.
        count: int [3], cells along x, y and z.
    """

    decoder: Decoder
    low: np.ndarray
    size: float
    count: np.ndarray

    def centres(self) -> np.ndarray:
        """Returns the centres of the cells, float64 [nz ny nx, 3], with x varying fastest."""
        return self._places(self.count, 0.5)

    def corners(self) -> np.ndarray:
        """Returns the corners of the cells, float64 [(nz + 1) (ny + 1) (nx + 1), 3], with x varying fastest."""
        return self._places(self.count + 1, 0.0)

    def light(self, place: np.ndarray) -> np.ndarray:
        """Returns the light at points [M, 3], float32 [M, 27]."""
        return np.concatenate([self.decoder.decode(place[i : i + _ROWS]) for i in range(0, len(place), _ROWS)])

    def _places(self, count: np.ndarray, shift: float) -> np.ndarray:
        axes = [low + self.size * (np.arange(n) + shift) for low, n in zip(self.low, count, strict=True)]
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        return np.stack([x, y, z], -1).reshape(-1, 3)


def lattice_of(model: ProbeModel, cells: int, most: int, position: np.ndarray | None, device: str) -> Lattice:
    """Makes a lattice of cubic cells that covers the box of a model's probes and has the same centre.

    Args:
        model: A model of second-order spherical harmonics in three colours.
        cells: Cells along the longest side of the box, 1 to `most`.
        most: Largest number of cells along a side in the engine's format.
        position: [N, 3], positions of the model's probes, if the decoder needs them and the model stores none.
        device: Where the light is decoded.

    Raises:
        WlmError: A probe has other than 9 coefficients, `cells` is out of range, the device does not exist, or the
            decoder needs the probes' positions and none are known.
    """
    if model.outputs != NUMBERS:
        raise WlmError(f"{model.name}: expected {NUMBERS} numbers per probe (RGB SH, L0-L2), got {model.outputs}")
    if not 1 <= cells <= most:
        raise WlmError(f"cells: expected 1 to {most} along the longest side, got {cells}")
    span = model.extent * model.size
    size = float(span.max()) / cells or 1.0  # one cell if all probes coincide
    count = np.clip(np.ceil(span / size - 1e-6), 1, cells).astype(int)
    return Lattice(model.decoder(device, position=position), model.origin + span / 2 - count * size / 2, size, count)
