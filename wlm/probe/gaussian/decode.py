"""Decodes Gaussians on a device (gaussian-probe-compression, eq. 5 to 7 and section 5.3.2)."""

from abc import abstractmethod

import numpy as np
import warp as wp

from wlm.probe.decode import Decoder
from wlm.probe.gaussian.model import CUT, Gaussians, check_outputs
from wlm.probe.model import ProbeModel, check_points
from wlm.probe.morton import morton_keys, morton_order
from wlm.probe.sphere import ambient_numbers
from wlm.probe.volume.light import Light
from wlm_kernels.probe import cubes as probe_cubes
from wlm_kernels.probe import gaussian_sum
from wlm_kernels.probe import volume_frame as frame_kernels
from wlm_kernels.probe.decode import Region, decode_kernels


class Points:
    """Points on a device, in the order in which decoding them is fastest. `x`, vec3 [M], are the points relative to the
    probes' box, sorted by region, then by cube, whose list neighbouring threads share, then along a Z-curve (Morton
    order). `region`, int [M], is the region of each point, [0] for a model without regions; `order`, int [M], its index
    in the input. `out`, float [M, D], is written by the decoder's `run`."""

    def __init__(
        self, x: np.ndarray, cube: np.ndarray, outputs: int, device: str, region: np.ndarray | None = None
    ) -> None:
        order = morton_order(x)
        self.order = order = order[np.lexsort([each[order] for each in (cube, region) if each is not None])]
        region = np.zeros(0, np.int32) if region is None else region[order]
        self.x, self.region = wp.array(x[order], dtype=wp.vec3, device=device), wp.array(region, device=device)
        self.out = wp.zeros((len(x), outputs), dtype=float, device=device)

    def values(self) -> np.ndarray:
        """Returns the decoded light, float32 [M, D], in the order of the input."""
        result = np.empty(self.out.shape, np.float32)
        result[self.order] = self.out.numpy()
        return result


class PointDecoder(Decoder):
    """A decoder of light at any points, which are uploaded and then decoded."""

    @abstractmethod
    def points(self, position: np.ndarray) -> Points:
        """Uploads points that will be decoded often; arguments and errors are those of `decode`."""

    @abstractmethod
    def run(self, points: Points) -> None:
        """Decodes uploaded points into `Points.out`; on CUDA the work is queued, not awaited."""

    def decode(self, position: np.ndarray) -> np.ndarray:
        points = self.points(position)
        self.run(points)
        return points.values()

    def decode_probes(self) -> np.ndarray:
        values = self.decode(self.own_positions())
        values[~self.model.live] = 0.0
        return values


class GaussianDecoder(PointDecoder):
    """A model of Gaussians on a device, with a list of the Gaussians that reach each cube of a grid; `pairs` is the
    total number of entries in these lists."""

    def __init__(self, model: ProbeModel, device: str = "cpu", *, position: np.ndarray | None = None) -> None:
        """Loads a model of Gaussians; arguments and errors are those of `wlm.probe.decode.Decoder`."""
        super().__init__(model, device, position=position)
        content = model.content
        assert isinstance(content, Gaussians)
        check_outputs(model.name, content.latent, content.hidden, model.outputs, content.relative, self.device)
        self._gain = content.gain
        rows = wp.array(content.rows(), dtype=float, device=self.device)
        self._shapes = gaussian_sum.shapes(rows, CUT, content.support)
        self._cubes = probe_cubes.build(self._shapes, np.zeros(3, np.float32), model.size.astype(np.float32))
        self.pairs = self._cubes.item.shape[0]
        shared = np.concatenate([layer.ravel() for layer in content.layers()[:2]])
        last = np.stack([each.layers()[2] for each in self._contents()])
        last = np.pad(last, ((0, 0), (0, 0), (0, -last.shape[2] % 4)))
        last = last.reshape(len(last), -1).astype(np.float32)
        self._net = self._put(np.concatenate([shared.astype(np.float32), last[0]]), float)
        self._keep_hours(last, self._net[len(shared) :])
        kind = "cpu" if self.device == "cpu" else "cuda"
        sizes = content.latent, content.hidden, model.outputs, content.relative, ambient_numbers(model.outputs)
        self._kernels = decode_kernels(*sizes, kind)
        self._rows, self._packed = self._kernels.pack(rows, self._shapes, self._net)
        self._arrays += [self._rows, self._shapes, self._cubes.start, self._cubes.item]
        if self._packed is not self._net:
            self._arrays.append(self._packed)

    def set_time(self, time: float) -> None:
        super().set_time(time)
        if self._hours is not None:
            self._kernels.pack_network(self._net, self._packed)

    def region(self) -> Region:
        """Returns what decodes the model's points as one region of several."""
        made = Region()
        made.rows, made.shapes, made.cubes, made.net = self._rows, self._shapes, self._cubes, self._packed
        made.gain = self._gain
        return made

    def cubes_of(self, x: np.ndarray) -> np.ndarray:
        """Returns keys of the cubes of points, [M, 3] relative to the probes' box, along a Z-curve, uint64 [M]."""
        cell = np.clip(x / self._cubes.size, 0, np.array(list(self._cubes.counts)) - 1)
        return morton_keys(cell.astype(np.int64))

    def points(self, position: np.ndarray) -> Points:
        x = self.model.normalise(check_points(position))
        return Points(x, self.cubes_of(x), self.model.outputs, self.device)

    def run(self, points: Points) -> None:
        self.launch(points.x, points.out)

    def launch(self, x: wp.array, out: wp.array) -> None:
        """Decodes vec3 [M], points relative to the probes' box, into float [M, D]; on CUDA it is only queued."""
        if x.shape[0]:
            self._kernels.launch(self._rows, self._shapes, self._cubes, CUT, self._packed, self._gain, x, out)

    def light(self, position: np.ndarray) -> "GaussianLight":
        return GaussianLight(self, check_points(position))


class GaussianLight(Light):
    """Decodes the light of Gaussians at positions that a volume requests."""

    def __init__(self, decoder: GaussianDecoder, position: np.ndarray) -> None:
        self._decoder = decoder
        self.device, self.channels, self.count = decoder.device, decoder.model.outputs, len(position)
        self._x = wp.array(decoder.model.normalise(position), dtype=wp.vec3, device=self.device)
        self._region = wp.zeros(0, dtype=int, device=self.device)
        self._points: dict[int, wp.array] = {}

    @property
    def time(self) -> float | None:
        return self._decoder.time

    def read(self, numbers: wp.array, values: wp.array) -> None:
        count = numbers.shape[0]
        if count not in self._points:
            self._points[count] = wp.zeros(count, dtype=wp.vec3, device=self.device)
        frame_kernels.take_points(self._x, self._region, numbers, self._points[count], self._region)
        self._decoder.launch(self._points[count], values)
