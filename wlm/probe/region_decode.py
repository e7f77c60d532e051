"""The runtime path of a file of many regions: whole, or those regions alone that are asked for.

The light between probes is the kriging of the nearest ones, of whatever regions: no border is seen.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.probe.kriging import NEIGHBOURS, Kriging
from wlm.probe.model import check_points, live_probes
from wlm.probe.regions import RegionModel, members
from wlm.probe.transform import CODES
from wlm.probe.transform_decode import TransformDecoder


class Region(NamedTuple):
    """The live probes of a region: positions, float64 [n, 3], and numbers, float32 [n, D]."""

    position: np.ndarray
    values: np.ndarray


class RegionDecoder(TransformDecoder):
    """A model of many regions.

    `decode` unpacks the regions that points lie in or near, and keeps the last of them. `points`, `run` and
    `decode_probes` are those of `TransformDecoder`, for which all are unpacked.
    """

    def __init__(self, model: RegionModel, device: str = "cpu", *, position: np.ndarray | None = None, kept: int = 16):
        """Loads the head of a model.

        Args:
            model: The model.
            device: "cpu" or "cuda:0".
            position: [N, 3], of the model's own probes; None: those stored with it, if there are.
            kept: Regions that are kept unpacked; each takes 4 (D + 6) bytes a probe.

        Raises:
            WlmError: No such device, or other positions.
        """
        super().__init__(model, device, lazily=True)
        self._kept, self._unpacked = max(kept, 1), dict[int, Region]()
        self._own: np.ndarray | None = None
        self._members: list[np.ndarray] = []
        if position is not None:
            self._given(np.asarray(position, np.float64))
        self._boxes = model.boxes()

    def region(self, number: int) -> Region:
        """The live probes of one region.

        Raises:
            WlmError: No positions are known, they aren't the model's own, or the region is damaged.
        """
        if number in self._unpacked:
            self._unpacked[number] = self._unpacked.pop(number)  # the last used is the last
            return self._unpacked[number]
        if self._own is None:
            if not self.model.has_positions:
                raise WlmError(f"{self.model.name}: the file has no positions; expected those of its probes first")
            model = self.model.region(number)
            position, values = model.stored_positions(), model.stored_values
        else:
            part, dead = self._members[number], self.model.dead
            model = self.model.region(number, dead[part] if dead.size and not self.model.has_positions else None)
            position = self._own[part]
            values = model.values_at(position)
        live = live_probes(model.dead, model.probes)
        self._unpacked[number] = Region(position[live], values[live])
        while len(self._unpacked) > self._kept:
            del self._unpacked[next(iter(self._unpacked))]
        return self._unpacked[number]

    def decode(self, position: np.ndarray) -> np.ndarray:
        """Light at any points by kriging of the live probes, float32 [M, D].

        Args:
            position: [M, 3], in the unit of the probes' positions; those outside the live probes' box are moved to its
                nearest point.

        Raises:
            WlmError: A position that isn't finite, no positions are known, or a region is damaged.
            ValueError: Another shape.
        """
        if self._values is not None:
            return super().decode(position)
        point = check_points(position)
        point = np.clip(point, self._boxes[:, 0].min(0), self._boxes[:, 1].max(0))
        out = np.empty((len(point), self.model.outputs), np.float32)
        model = self.model
        code = np.clip((point - model.origin) / model.extent * CODES, 0, CODES).astype(np.uint16)
        for number, part in enumerate(members(model.split.labels(code), model.split.regions)):
            if len(part):
                out[part] = self._between(number, point[part])
        return out

    def decode_probes(self, position: np.ndarray | None = None) -> np.ndarray:
        """All of the model's own probes, as `TransformDecoder.decode_probes`."""
        return super().decode_probes(self._own if position is None else position)

    def points(self, position: np.ndarray):
        """Puts points on the device, as `TransformDecoder.points`; unpacks all regions."""
        if self._values is None and (self._own is not None or self.model.has_positions):
            self.decode_probes()
        return super().points(position)

    def _given(self, position: np.ndarray) -> None:
        self._own = position
        self._members = members(self.model.labels_of(position), self.model.split.regions)

    def _between(self, first: int, point: np.ndarray) -> np.ndarray:
        """Light at points of one region, float64 [m, D]."""
        near = {first}
        place, values = self.region(first)
        asked = min(NEIGHBOURS + 1, len(place))
        reach = cKDTree(place).query(point, k=asked)[0].reshape(len(point), asked)[:, -1]
        if asked <= NEIGHBOURS:
            reach = np.full(len(point), np.inf)  # too few to tell
        for number, (low, high) in enumerate(self._boxes):
            away = np.linalg.norm(np.maximum(np.maximum(low - point, point - high), 0.0), axis=1)
            if (away <= reach).any():
                near.add(number)
        chosen = [self.region(number) for number in sorted(near)]
        place = np.concatenate([region.position for region in chosen])
        values = np.concatenate([region.values for region in chosen])
        low = place.min(0)
        index, weight = Kriging(place - low).weights(point - low)
        return np.einsum("mkd,mk->md", values[index], weight)
