"""Direction to the sun at a given hour, day and latitude."""

import math

import numpy as np

_OBLIQUITY = math.radians(23.44)
_SOLSTICE = 10  # days from December's solstice to the year's end
_YEAR = 365.25


def sun_direction(hour: float, latitude: float, day: int, north: float = 0.0, period: float = 24.0) -> np.ndarray:
    """Returns the direction to the sun, float64 [3], of unit length, y up; y < 0 at night.

    The model is a circular orbit with the sun highest at half the period; its error is at most 2 degrees. `hour` is
    solar time, `latitude` in degrees, north positive, `day` that of the year; north is turned by `north` degrees from
    -z towards -x.
    """
    declination = math.asin(-math.sin(_OBLIQUITY) * math.cos(2.0 * math.pi * (day + _SOLSTICE) / _YEAR))
    angle = 2.0 * math.pi * hour / period - math.pi  # 0 at noon, negative before it
    phi, turn = math.radians(latitude), math.radians(north)
    east = -math.cos(declination) * math.sin(angle)
    up = math.sin(phi) * math.sin(declination) + math.cos(phi) * math.cos(declination) * math.cos(angle)
    northward = math.cos(phi) * math.sin(declination) - math.sin(phi) * math.cos(declination) * math.cos(angle)
    # Before the rotation by `north`, east is +x and north is -z.
    x = east * math.cos(turn) - northward * math.sin(turn)
    z = -east * math.sin(turn) - northward * math.cos(turn)
    return np.array([x, up, z])
