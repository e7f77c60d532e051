"""Decodes principal components on a device: at the probes, and between probes through a volume."""

import numpy as np
import warp as wp
from scipy.spatial import cKDTree

from wlm.probe.decode import Decoder
from wlm.probe.model import ProbeModel, check_points
from wlm.probe.pca.model import Components, unit_of
from wlm.probe.sphere import ambient_numbers
from wlm.probe.volume.cascade import SIDE, Volume
from wlm.probe.volume.light import Light, at_probes
from wlm.probe.volume.walk import settle
from wlm_kernels.probe.components import decode_components

_BUDGET = 1024  # blocks that the volume decodes per frame; many, since all are awaited


class ComponentDecoder(Decoder, Light):
    """A model of principal components on a device, stored packed, and the light of its `count` probes, of `channels`
    numbers each, for a volume."""

    def __init__(self, model: ProbeModel, device: str = "cpu", *, position: np.ndarray | None = None) -> None:
        """Loads a model of principal components; arguments and errors are those of `wlm.probe.decode.Decoder`."""
        super().__init__(model, device, position=position)
        forms = self._contents()
        content, used = forms[0], forms[0].used
        assert isinstance(content, Components)
        columns = used.sum(1)
        table = np.zeros((content.clusters + 1, 2), np.int32)
        table[1:, 0], table[:-1, 1] = np.cumsum(columns), content.bits
        self._index_bits = (content.clusters - 1).bit_length()
        self._words = [self._put(words, wp.uint32) for words in content.packed()]
        self._tables = [self._put(table, wp.vec2i), self._put(content.width[used], wp.uint8)]
        self._tables.append(self._put(np.moveaxis(content.bounds, 0, 2)[used], wp.vec2))
        own = used[:, 1:] if len(content.basis) else np.zeros(0, bool)
        bases = [each.basis[own].reshape(-1, model.outputs) for each in forms]
        self._basis = self._put(bases[0], wp.dtype_from_numpy(bases[0].dtype))
        self._unit = unit_of(content.basis)
        self._keep_hours(np.stack(bases).reshape(len(bases), -1), self._basis.flatten())
        live = model.live
        row = np.where(live, np.cumsum(live) - 1, -1)
        self._row = self._put(row.astype(np.int32), int)
        self.count, self.channels = model.probes, model.outputs
        self._volume: Volume | None = None

    def decode(self, position: np.ndarray) -> np.ndarray:
        """Returns the light at any points as a renderer reads it: from the cascaded volume around a nearby viewer.
        Points that no block of the volume covers take the light of the nearest live probe."""
        points, model = check_points(position), self.model
        own = self.own_positions()
        if self._volume is None:
            self._volume = Volume(own, self.light(own), live=model.live, budget=_BUDGET, tolerance=0.0)
        volume = self._volume
        points = np.clip(points, own.min(0), own.max(0))
        values = np.empty((len(points), model.outputs), np.float32)
        covered = np.empty(len(points), bool)
        # One viewpoint for each cube of points; the finest window reaches beyond the cube on all sides.
        side = 0.5 * SIDE * volume.sizes[0]
        cube = np.floor((points - own.min(0)) / side)
        for viewpoint in np.unique(cube, axis=0):
            here = (cube == viewpoint).all(1)
            settle(volume, own.min(0) + (viewpoint + 0.5) * side)
            reading = volume.read(points[here])
            values[here], covered[here] = reading.values, reading.weight > 0.0
        if not covered.all():
            live = np.flatnonzero(model.live)
            nearest = live[cKDTree(own[live]).query(points[~covered])[1]]
            values[~covered] = at_probes(self, nearest)
        return values

    def decode_probes(self) -> np.ndarray:
        return at_probes(self, np.arange(self.model.probes))

    def light(self, position: np.ndarray) -> "ComponentDecoder":
        self.check_own(position)
        return self

    def read(self, numbers: wp.array, values: wp.array) -> None:
        group, index, codes = self._words
        words = group, index, self._index_bits, codes
        ambient = ambient_numbers(self.channels)
        decode_components(*words, *self._tables, self._basis, self._unit, self._row, numbers, ambient, values)
