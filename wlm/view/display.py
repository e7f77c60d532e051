"""From linear light to the screen: exposure, tone mapping, sRGB, and the colours of an error.

The same as the pages for a browser have (`wlm/export/page/assets/light.js`), so that a picture of either is that of the other.
"""

from dataclasses import dataclass

import numpy as np

from wlm.texels import filmic, to_srgb

TONES = ("clamped", "filmic")
"""What becomes of light above white: it clips, or Reinhard's curve takes 4 to white."""

_WHITE_PERCENTILE = 99.5  # as in `wlm.view.sheet`
_HEAT = np.array([[0.0, 0.0, 0.0], [0.45, 0.1, 0.5], [1.0, 0.6, 0.1], [1.0, 1.0, 1.0]])
_HEAT_AT = (0.0, 0.33, 0.66, 1.0)


@dataclass(frozen=True)
class Display:
    """How light is shown.

    Attributes:
        exposure: Factor on linear light; 1 is white after it.
        tone: One of `TONES`.
        gain: Factor on errors.
    """

    exposure: float = 1.0
    tone: str = "clamped"
    gain: float = 8.0

    def screen(self, light: np.ndarray) -> np.ndarray:
        """Linear light of any shape to display values in [0, 1], float32."""
        x = np.maximum(np.asarray(light, np.float32) * np.float32(self.exposure), np.float32(0))
        if self.tone == "filmic":
            x = filmic(x)
        return to_srgb(x)

    def picture(self, light: np.ndarray) -> np.ndarray:
        """Linear light of any shape to bytes."""
        return _bytes(self.screen(light))

    def error(self, decoded: np.ndarray, original: np.ndarray) -> np.ndarray:
        """The error of the picture on the screen, the largest of the channels times the gain, as `heat` of it.

        Args:
            decoded, original: Linear light [..., 3].

        Returns:
            uint8 [..., 3].
        """
        apart = np.abs(self.screen(decoded) - self.screen(original)).max(-1)
        return heat(apart * np.float32(self.gain))


def heat(values: np.ndarray) -> np.ndarray:
    """Black, purple, orange, white for values [...] from 0 to 1; uint8 [..., 3]."""
    values = np.clip(values, 0.0, 1.0)
    table = np.linspace(0.0, 1.0, 256)
    place = np.interp(table, _HEAT_AT, range(len(_HEAT_AT)))
    share = place % 1.0
    # Smooth between the stops.
    place = np.floor(place) + share * share * (3.0 - 2.0 * share)
    colours = np.stack([np.interp(place, range(len(_HEAT)), channel) for channel in _HEAT.T], 1)
    return _bytes(colours)[np.round(values * 255.0).astype(np.uint8)]


def white_of(light: np.ndarray) -> float:
    """The radiance that is shown as white: the 99.5th percentile; 1 where there is no light."""
    white = float(np.percentile(light, _WHITE_PERCENTILE)) if light.size else 0.0
    return white if white > 0 else float(light.max(initial=0.0)) or 1.0


def _bytes(values: np.ndarray) -> np.ndarray:
    return (values * 255.0 + 0.5).astype(np.uint8)
