"""The runtime path: light at points from a compressed model (gaussian-probe-compression, eq. 5 to 7, section 5.3.2)."""

from typing import Literal

import numpy as np
import warp as wp

from wlm import interop
from wlm.errors import WlmError
from wlm.probe.model import ProbeModel, check_outputs, check_points
from wlm.probe.start import morton_order
from wlm_kernels.probe import cubes as probe_cubes
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe import network as probe_network
from wlm_kernels.probe.decode import decode_kernels

Culling = Literal["box", "sphere", "exact", "none"]
CULLINGS = ("exact", "box", "sphere", "none")
"""How a cube's list of Gaussians is made; see `Decoder`."""


class Points:
    """Points on a device, in the order in which decoding them is quickest.

    Attributes:
        x: vec3 [M], normalised, along a Z-curve.
        order: int [M], the place that each had in the input.
        out: float [M, D], filled by `Decoder.run`.
    """

    def __init__(self, position: np.ndarray, model: ProbeModel, device: str):
        x = model.normalise(position)
        self.order = morton_order(x)
        self.x = wp.array(x[self.order], dtype=wp.vec3, device=device)
        self.out = wp.zeros((len(x), model.outputs), dtype=float, device=device)

    def values(self) -> np.ndarray:
        """The decoded light, float32 [M, D], in the order of the input."""
        result = np.empty(self.out.shape, np.float32)
        result[self.order] = self.out.numpy()
        return result


class Decoder:
    """A model on a device.

    The lists of Gaussians by cube are made once, here. All ways to make them give the same values but for rounding,
    for what a Gaussian reaches is tested again at each point; they differ in how many Gaussians a list has in vain.

    Attributes:
        model, device: The arguments.
        pairs: Entries in all lists.
    """

    def __init__(
        self,
        model: ProbeModel,
        device: str = "cpu",
        *,
        culling: Culling = "exact",
        cut: float | None = None,
        support: Literal["ellipsoid", "sphere"] | None = None,
        cube: float | None = None,
    ):
        """Loads a model.

        Args:
            model: The model.
            device: "cpu" or "cuda:0".
            culling: Which cubes list a Gaussian: those that its ellipsoid meets ("exact"), that the box round it
                meets ("box"), that the sphere of its longest axis meets ("sphere", the paper's); "none": one list of
                all.
            cut, support: Where a Gaussian ends; None: where the fit took it to end. Others cost accuracy.
            cube: Side of a cube, normalised; None: chosen from the Gaussians' sizes.

        Raises:
            WlmError: No such device.
        """
        self.model, self.device = model, interop.check_device(device)
        kind = "cpu" if self.device == "cpu" else "cuda"
        p, count = model.profile, model.count
        check_outputs(model.name, p, model.outputs, self.device)
        self._cut = p.cut if cut is None else cut
        sphere = (p.support if support is None else support) == "sphere"
        if sphere and culling != "none":
            # What is reached is a sphere; the box round it is no smaller, and its ellipsoid would lose some of it.
            culling = "sphere"
        self._rows = wp.array(model.rows(), dtype=float, device=self.device)
        self._shapes = gaussian_sum.shapes(self._rows, self._cut, "sphere" if sphere else "ellipsoid")
        low, high = np.zeros(3, np.float32), model.size.astype(np.float32)
        if culling == "none":
            self._cubes = probe_cubes.everything(count, self.device)
        else:
            self._cubes = probe_cubes.build(self._shapes, low, high, cube, test=culling)
        self.pairs = self._cubes.item.shape[0]
        first, second, third = (layer.astype(np.float32) for layer in model.layers())
        third = np.pad(third, ((0, 0), (0, probe_network.padded(model.outputs) - model.outputs)))
        net = np.concatenate([first.ravel(), second.ravel(), third.ravel()])
        self._net = wp.array(net, dtype=float, device=self.device)
        self._kernels = decode_kernels(p.latent, p.hidden, model.outputs, kind)

    @property
    def device_bytes(self) -> int:
        """Memory that the model takes on the device."""
        arrays = (self._rows, self._shapes, self._net, self._cubes.start, self._cubes.item)
        return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays)

    def points(self, position: np.ndarray) -> Points:
        """Puts points on the device, to be decoded often.

        Args:
            position: [M, 3], in the unit of the probes' positions; those outside the probes' box are moved to its
                nearest point.

        Raises:
            WlmError: A position that isn't finite.
            ValueError: Another shape.
        """
        return Points(check_points(position), self.model, self.device)

    def run(self, points: Points) -> None:
        """Decodes points where they lie; on CUDA it is queued, not awaited."""
        if points.x.shape[0]:
            self._kernels.launch(
                self._rows,
                self._shapes,
                self._cubes,
                self._cut,
                self._net,
                self.model.gain,
                points.x,
                points.out,
            )

    def decode(self, position: np.ndarray) -> np.ndarray:
        """Light at any points, float32 [M, D]; arguments and errors are those of `points`."""
        points = self.points(position)
        self.run(points)
        return points.values()

    def decode_probes(self, position: np.ndarray | None = None) -> np.ndarray:
        """The model's own probes.

        Args:
            position: [N, 3], as they were compressed and in that order; None: those stored with the model.

        Returns:
            float32 [N, D], zero where a probe is dead.

        Raises:
            WlmError: Another number of positions, or none stored.
        """
        model = self.model
        if position is None:
            position = model.stored_positions()
        if len(position) != model.probes:
            raise WlmError(f"{model.name}: expected the positions of {model.probes} probes, got {len(position)}")
        values = self.decode(position)
        if len(model.dead):
            values[model.dead] = 0.0
        return values
