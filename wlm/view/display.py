"""Conversion of linear light to screen colours: exposure, tone mapping, sRGB, and false colours of an error.

The HTML pages convert in the same way (`wlm/export/page/assets/light.js`), so that both show the same picture.
"""

from dataclasses import dataclass

import numpy as np

from wlm.texels import filmic, to_srgb

TONES = ("clamped", "filmic")
"""How light above white is shown: it is clipped, or an extended Reinhard curve maps 4 to white."""

_WHITE_PERCENTILE = 99.5
_HEAT = np.array([[0.0, 0.0, 0.0], [0.45, 0.1, 0.5], [1.0, 0.6, 0.1], [1.0, 1.0, 1.0]])
_HEAT_AT = (0.0, 0.33, 0.66, 1.0)


@dataclass(frozen=True)
class Display:
    """How linear light is converted to screen colours: by a factor `exposure`, after which 1 is white, and one of
    `TONES`; `gain` is a factor on errors."""

    exposure: float = 1.0
    tone: str = "clamped"
    gain: float = 8.0

    def screen(self, light: np.ndarray) -> np.ndarray:
        """Converts linear light of any shape to display values in [0, 1], float32."""
        x = np.maximum(np.asarray(light, np.float32) * np.float32(self.exposure), np.float32(0))
        if self.tone == "filmic":
            x = filmic(x)
        return to_srgb(x)

    def picture(self, light: np.ndarray) -> np.ndarray:
        """Converts linear light of any shape to sRGB bytes, uint8."""
        return _bytes(self.screen(light))

    def error(self, decoded: np.ndarray, original: np.ndarray) -> np.ndarray:
        """Returns false colours (`heat`), uint8 [..., 3], of the displayed error of linear light [..., 3]: the largest
        difference of a channel times `gain`."""
        apart = np.abs(self.screen(decoded) - self.screen(original)).max(-1)
        return heat(apart * np.float32(self.gain))


def heat(values: np.ndarray) -> np.ndarray:
    """Maps values [...] from 0 to 1 to colours uint8 [..., 3]: black, purple, orange, white."""
    values = np.clip(values, 0.0, 1.0)
    table = np.linspace(0.0, 1.0, 256)
    place = np.interp(table, _HEAT_AT, range(len(_HEAT_AT)))
    share = place % 1.0
    # Smoothstep between the stops.
    place = np.floor(place) + share * share * (3.0 - 2.0 * share)
    colours = np.stack([np.interp(place, range(len(_HEAT)), channel) for channel in _HEAT.T], 1)
    return _bytes(colours)[np.round(values * 255.0).astype(np.uint8)]


def white_of(light: np.ndarray) -> float:
    """Chooses the radiance that is shown as white: the 99.5th percentile; 1 if there is no light."""
    white = float(np.percentile(light, _WHITE_PERCENTILE)) if light.size else 0.0
    return white if white > 0 else float(light.max(initial=0.0)) or 1.0


def _bytes(values: np.ndarray) -> np.ndarray:
    return (values * 255.0 + 0.5).astype(np.uint8)
