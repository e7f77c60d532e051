"""Light of a scene's probes at points, at any hour, through one cascaded volume around the viewer."""

from __future__ import annotations

import math

import numpy as np

from wlm.formats.hours import DAY
from wlm.lightmap.profile import TimeAxis
from wlm.lightmap.virtual.clock import Clock
from wlm.probe.sphere import basis, coefficient_bands
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.walk import settle
from wlm.scene.content import Scene
from wlm.smoke.camera import VECTORS

SIDE = 16
"""Blocks along an axis of a window of the volume."""

_BUDGET = 512  # blocks decoded in a frame
_SQUARED = np.array([2.0 * math.pi / 3.0, math.pi / 2.0, 4.0 * math.pi / 15.0])


class DayProbes:
    """Probes over the day on a device, whose light at any hour `volume` decodes around the viewer by their `decoder`,
    at most its budget of blocks in a frame."""

    def __init__(self, scene: Scene, device: str = "cpu") -> None:
        """Loads the probes of a scene that has some."""
        assert scene.probes is not None
        self.decoder = scene.probes.decoder(device)
        own = self.decoder.own_positions()
        light, live = self.decoder.light(own), scene.probes.live
        self.volume = Volume(own, light, live=live, side=SIDE, budget=_BUDGET, tolerance=0.0)
        self._clock = Clock(TimeAxis(scene.probe_hours, DAY, "frames"))
        self._settled = False

    def at(self, points: np.ndarray, hour: float, viewpoint: np.ndarray, *, complete: bool = False) -> np.ndarray:
        """Returns SH coefficients of radiance at points [M, 3] and any hour, float32 [M, 9, 3].

        Light is that of the hour, except across a switch of a lamp (`wlm.lightmap.virtual.clock`): until its end, it is
        the light before it. The volume is finest around `viewpoint`, [3]. With `complete`, and at the first call, all
        of it has the light of the hour; otherwise blocks may be some frames behind.
        """
        axis = self._clock.axis
        before = axis.neighbours(hour)[0]
        self.decoder.set_time(float(axis.times[before]) if before in self._clock.switches else hour)
        if self._settled and not complete:
            self.volume.update(viewpoint)
        else:
            settle(self.volume, viewpoint)
            self._settled = True
        return self.volume.read(points).values.reshape(len(points), 9, 3)


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
