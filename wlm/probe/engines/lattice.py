"""Decodes a model on a lattice of cubic cells over its probes' box, for engines that store light on lattices."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.formats.folder import write_index
from wlm.probe.axes import read_axes, turned
from wlm.probe.decode import Decoder
from wlm.probe.model import ProbeModel
from wlm.probe.places import positions_of

CELLS = 24
"""Default number of cells along the longest side of the box."""

NUMBERS = 27
"""Numbers of a probe with second-order spherical harmonics in three colours."""

_ROWS = 65536  # points decoded at a time


@dataclass(frozen=True)
class Lattice:
    """A lattice of cubic cells over the bounding box of a model's probes.

    Attributes:
        name: Name of the model, for messages.
        decoder: Decoder of the model.
        low: float64 [3], lowest corner.
        size: Side of a cell, in the unit of the probes' positions.
        count: int [3], cells along x, y and z.
        axes: float64 [3, 3], from the axes of the model to those of the lattice (`wlm.probe.axes`).
    """

    name: str
    decoder: Decoder
    low: np.ndarray
    size: float
    count: np.ndarray
    axes: np.ndarray

    def centres(self) -> np.ndarray:
        """Returns the centres of the cells, float64 [nz ny nx, 3], with x varying fastest."""
        return self.low + self.size * (cells_of(self.count) + 0.5)

    def corners(self) -> np.ndarray:
        """Returns the corners of the cells, float64 [(nz + 1) (ny + 1) (nx + 1), 3], with x varying fastest."""
        return self.low + self.size * cells_of(self.count + 1)

    def light(self, place: np.ndarray) -> np.ndarray:
        """Returns the light at points [M, 3], float32 [M, 27]."""
        own = place @ self.axes
        values = np.concatenate([self.decoder.decode(own[i : i + _ROWS]) for i in range(0, len(own), _ROWS)])
        return turned(values, self.axes)


def cells_of(count: np.ndarray) -> np.ndarray:
    """Returns the indices of nx, ny, nz = `count` cells along x, y and z, int [nz ny nx, 3], with x varying fastest."""
    return np.indices(count[::-1])[::-1].reshape(3, -1).T


def lattice_of(
    model: ProbeModel, cells: int, most: int, position: np.ndarray | None, device: str, axes: str | None
) -> Lattice:
    """Makes a lattice of cubic cells that covers the box of a model's probes and has the same centre.

    Args:
        model: A model of second-order spherical harmonics in three colours.
        cells: Cells along the longest side of the box, 1 to `most`.
        most: Largest number of cells along a side in the engine's format.
        position: [N, 3], positions of the model's probes, if the decoder needs them and the model stores none.
        device: Where the light is decoded.
        axes: Axes of the model that become those of the lattice, see `wlm.probe.axes`; None: the same.

    Raises:
        WlmError: A probe has other than 9 coefficients, `cells` or `axes` is wrong, the device does not exist, or the
            decoder needs the probes' positions and none are known.
    """
    check_numbers(model)
    if not 1 <= cells <= most:
        raise WlmError(f"cells: expected 1 to {most} grid cells along the longest side of the probes' box, got {cells}")
    matrix = read_axes(axes)
    span = np.abs(matrix) @ (model.extent * model.size)
    middle = matrix @ (model.origin + model.extent * model.size / 2)
    size = float(span.max()) / cells or 1.0  # one cell if all probes coincide
    count = np.clip(np.ceil(span / size - 1e-6), 1, cells).astype(int)
    decoder = model.decoder(device, position=position)
    return Lattice(model.name, decoder, middle - count * size / 2, size, count, matrix)


def check_numbers(model: ProbeModel) -> None:
    """Raises a WlmError if the model's probes are not second-order spherical harmonics in three colours."""
    if model.outputs != NUMBERS:
        raise WlmError(f"{model.name}: expected {NUMBERS} numbers per probe (RGB SH, L0-L2), got {model.outputs}")


def lattice_kit(
    form: str, index: str, about: str, most: int, write: Callable[[Path, Lattice, np.ndarray], dict[str, Any]]
) -> Callable[..., dict[str, Any]]:
    """Makes the function `write_kit` of an engine that stores light at the centres of a lattice's cells.

    Args:
        form: Value of `format` in the index, by which a folder is recognised.
        index: Name of the index, a JSON file.
        about: Explanation of the files, an entry of the index.
        most: Largest number of cells along a side in the engine's format.
        write: Writes the other files to a folder, given the lattice and the light at the centres of its cells, float32
            [nz ny nx, 27], x fastest; returns further entries of the index. Raises a WlmError if the light exceeds the
            range of the engine's numbers.
    """

    def write_kit(
        bundle: Bundle,
        folder: Path,
        engine: str,
        *,
        cells: int = CELLS,
        original: str | os.PathLike[str] | None = None,
        axes: str | None = None,
        device: str = "cpu",
    ) -> dict[str, Any]:
        """Writes second-order spherical harmonics at the centres of cubic cells that fill the probes' box. There are
        `cells` cells along its longest side, 1 to the engine's limit. `original` is the file that was compressed,
        required if the decoder needs positions and the model stores none. `axes` are the scene's axes that become the
        engine's (`wlm.probe.axes`). Raises a WlmError if a probe has other than 9 coefficients, `cells` is out of
        range, the light exceeds the range of the engine's numbers, or the device does not exist."""
        lattice = lattice_of(bundle.model.at(), cells, most, positions_of(bundle.model, original), device, axes)
        document = {"format": form, "version": 1, "about": about, "name": lattice.name}
        document |= {"resolution": lattice.count.tolist()}
        write_index(folder / index, document | write(folder, lattice, lattice.light(lattice.centres())))
        return {"about": about}

    return write_kit
