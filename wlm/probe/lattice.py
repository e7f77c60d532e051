"""A model's light in cubic cells that fill the box of its probes, for engines that have light on a lattice."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.probe.decode import Decoder
from wlm.probe.model import ProbeModel
from wlm.probe.transform import Transform
from wlm.probe.transform_decode import TransformDecoder

CELLS = 24
"""Cells along the longest side of the box, where no number is given."""

NUMBERS = 27
"""Of a probe of L2 in RGB."""

_ROWS = 65536  # of points decoded at a time
_FARTHEST = 1e100


@dataclass(frozen=True)
class Lattice:
    """Cells round a model's probes, and what the model is there.

    Attributes:
        low: float64 [3], the lowest corner.
        size: Side of a cell.
        count: int [3], cells along x, y and z.
    """

    decoder: Decoder | TransformDecoder
    low: np.ndarray
    size: float
    count: np.ndarray

    def centres(self) -> np.ndarray:
        """The middles of the cells, float64 [nz ny nx, 3], x fastest."""
        return self._places(self.count, 0.5)

    def corners(self) -> np.ndarray:
        """The corners of the cells, float64 [(nz + 1) (ny + 1) (nx + 1), 3], x fastest."""
        return self._places(self.count + 1, 0.0)

    def light(self, place: np.ndarray) -> np.ndarray:
        """The light at places [M, 3], float32 [M, 27]."""
        return np.concatenate([self.decoder.decode(place[i : i + _ROWS]) for i in range(0, len(place), _ROWS)])

    def _places(self, count: np.ndarray, shift: float) -> np.ndarray:
        axes = [low + self.size * (np.arange(n) + shift) for low, n in zip(self.low, count, strict=True)]
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        return np.stack([x, y, z], -1).reshape(-1, 3)


def lattice_of(
    model: ProbeModel | Transform, cells: int, most: int, position: np.ndarray | None, device: str
) -> Lattice:
    """Fills the box of a model's probes with cells, in its middle where they don't fit.

    Args:
        model: Of L2 in RGB.
        cells: Along the longest side of the box, 1 to `most`.
        most: What the engine's format bounds them to.
        position: [N, 3], of the model's own probes, for a transform whose file has none.
        device: Where it is decoded.

    Raises:
        WlmError: Another number of coefficients, cells out of range, no such device, or positions that aren't known.
    """
    if model.outputs != NUMBERS:
        raise WlmError(f"{model.name}: expected L2 in RGB, {NUMBERS} numbers a probe, got {model.outputs}")
    if not 1 <= cells <= most:
        raise WlmError(f"cells: expected 1 to {most} along the longest side, got {cells}")
    if isinstance(model, Transform):
        position = model.stored_positions() if position is None else position
        decoder: Decoder | TransformDecoder = model.decoder(device, position=position)
        corner, span = position.min(0), np.ptp(position, axis=0)
    else:
        decoder, corner, span = Decoder(model, device), model.origin, model.extent * model.size
    size = float(span.max()) / cells or 1.0  # all probes in one place: one cell
    count = np.clip(np.ceil(span / size - 1e-6), 1, cells).astype(int)
    return Lattice(decoder, corner + span / 2 - count * size / 2, size, count)


def read_cells(path: Path, document: dict[str, Any], most: int) -> tuple[np.ndarray, np.ndarray]:
    """Reads the cells of an export: `box`, its two corners, and `resolution`, the cells along x, y and z.

    Args:
        path: Of the document, for messages.
        document: What it says.
        most: Cells along an axis.

    Returns:
        float64 [2, 3] and int [3].

    Raises:
        WlmError: One of them is missing or wrong.
    """
    try:
        box, cells = np.array(document.get("box"), np.float64), np.array(document.get("resolution"))
    except (TypeError, ValueError, OverflowError) as error:
        raise WlmError(f"{path}: box, resolution: expected numbers, got others") from error
    if box.shape != (2, 3) or not (np.abs(box) < _FARTHEST).all() or not (box[1] > box[0]).all():
        raise WlmError(f"{path}: box: expected two corners, the lower first")
    if cells.shape != (3,) or cells.dtype.kind != "i" or not ((cells >= 1) & (cells <= most)).all():
        raise WlmError(f"{path}: resolution: expected three numbers of 1 to {most}")
    return box, cells


def grid_places(box: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Centres of the cells, float64 [nz * ny * nx, 3], x fastest.

    Args:
        box: [2, 3], lowest and highest corner.
        count: [3], cells along x, y and z.
    """
    axes = [low + (high - low) * (np.arange(n) + 0.5) / n for low, high, n in zip(*box, count, strict=True)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    return np.stack([x, y, z], -1).reshape(-1, 3)
