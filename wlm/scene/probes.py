"""Light of a scene's probes at points, at any hour, through one cascaded volume around the viewer."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from wlm.formats.hours import DAY
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.virtual.clock import Clock
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import basis, coefficient_bands
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import settle
from wlm.smoke.camera import VECTORS

_ROWS, _SIDE = 4096, 16  # blocks that have memory, and blocks along an axis of a window
_SQUARED = np.array([2.0 * math.pi / 3.0, math.pi / 2.0, 4.0 * math.pi / 15.0])


class DayProbes:
    """Probes at hours of a day on a device. A block of the volume has the light of all hours, so that a block that was
    decoded stays valid while the hour changes.

    Attributes:
        volume: The volume; its numbers are those of the first hour, then of the second, and so on.
    """

    def __init__(self, probes: Sequence[tuple[float, ProbeModel]], device: str = "cpu") -> None:
        """Decodes all probes: rising hours with models of 27 numbers a probe, all at the same positions."""
        decoders = [model.decoder(device) for _, model in probes]
        light = StoredLight(np.concatenate([decoder.decode_probes() for decoder in decoders], 1), device)
        live = np.logical_and.reduce([model.live for _, model in probes])
        self.volume = Volume(decoders[0].own_positions(), light, live=live, rows=_ROWS, side=_SIDE)
        self._clock = Clock(TimeAxis(np.array([hour for hour, _ in probes]), DAY, "frames"))
        self._settled = False

    def at(self, points: np.ndarray, hour: float, viewpoint: np.ndarray) -> np.ndarray:
        """Returns SH coefficients of radiance at points [M, 3] and any hour, float32 [M, 9, 3].

        Between the hours of two files they are mixed linearly, except across a switch of a lamp
        (`wlm.lightmap.virtual.clock`): until its end, the light is that before it. The volume is finest around
        `viewpoint`, [3].
        """
        if self._settled:
            self.volume.update(viewpoint)
        else:
            settle(self.volume, viewpoint)
            self._settled = True
        before, after, share = self._clock.axis.neighbours(hour)
        share = 0.0 if before in self._clock.switches else share
        values = self.volume.read(points).values.reshape(len(points), -1, 9, 3)
        return (1.0 - share) * values[:, before] + share * values[:, after]


def six_lights(coefficients: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Returns the lights of six-way lightmaps that stand for the light of all directions, from the SH of radiance [9,
    3]: float64 [6, 3] in the order of `wlm.smoke.camera.DIRECTIONS`, at least 0. Divided by 4 pi they are the factors
    of the lightmaps.

    A light from direction w takes the map of direction d times max(w . d, 0)^2 (`wlm.smoke.camera.weights`), so the
    light of map d is the integral of radiance times that square. Its factors for the bands of SH are 2 pi / 3, pi / 2
    and 4 pi / 15; irradiance, with pi, 2 pi / 3 and pi / 4, would be 1.5 times too bright under even light. The rows of
    `axes`, [3, 3], are right, up and toward the camera.
    """
    factors = basis(VECTORS @ axes, 9) * _SQUARED[coefficient_bands(9)]
    return np.maximum(factors @ np.asarray(coefficients, np.float64), 0.0)
