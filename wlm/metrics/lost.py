"""Light that an approximation lost and a mean hides.

One texel of 16,384 that is ten thousand times the others may vanish, and PSNR, whose peak it is, still be 48 dB.
"""

import numpy as np

__all__ = ["LostLight"]

_BRIGHT = 0.5  # of the largest: what counts as among the brightest
_KEPT = 0.5  # of its own: what is left of light that isn't lost


class LostLight:
    """Counts the brightest points of some groups that lost more than half of their light.

    Attributes:
        count: Such points.
        worst: The largest of them, what it decodes to, and where; None without any.
    """

    def __init__(self) -> None:
        self.count = 0
        self.worst: tuple[float, float, str] | None = None

    def add(self, reference: np.ndarray, decoded: np.ndarray, where: str = "") -> None:
        """Looks at a group: a tile at one time, or a whole set.

        Args:
            reference, decoded: [K, C]; a point's light is the largest magnitude of its channels.
            where: Words for the group in the warning.
        """
        if not len(reference):
            return
        light, kept = (np.abs(values).max(1) for values in (reference, decoded))
        lost = (light >= _BRIGHT * light.max()) & (kept < _KEPT * light)
        if not lost.any():
            return
        self.count += int(np.count_nonzero(lost))
        worst = int(np.argmax(np.where(lost, light, 0.0)))
        if self.worst is None or light[worst] > self.worst[0]:
            self.worst = float(light[worst]), float(kept[worst]), where

    def warnings(self, name: str, point: str, group: str) -> list[str]:
        """One line if light was lost, else none.

        Args:
            name: Of what was compressed.
            point, group: Words for a point, and for what it is among the brightest of: "texel", "its tile".
        """
        if self.worst is None:
            return []
        light, kept, where = self.worst
        points = f"1 {point}" if self.count == 1 else f"{self.count} {point}s"
        return [
            f"{name}: {points} among the brightest of {group} lost more than half of the light; the largest of "
            f"{light:.4g} decodes to {kept:.4g}{where and f' ({where})'}"
        ]
