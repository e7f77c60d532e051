"""Detects light lost by compression that a mean error does not show.

PSNR can stay at 48 dB although the one texel of 16,384 that is ten thousand times brighter than the others, and
therefore sets the peak, decodes to black, or although that texel is kept and all the others decode to black.
"""

import numpy as np
import torch

_BRIGHT = 0.5  # share of the group's maximum above which a point counts as one of its brightest
_KEPT = 0.5  # share of a point's own light: a bright point below it is lost, and a larger error makes a dim point lost
_BRIGHTER = 10.0  # multiple of the median above which a bright point hides the errors of the others


class LostLight:
    """Counts the points that lost more than half of their light without a visible effect on PSNR.

    Attributes:
        count: Number of such points among the brightest of their group.
        worst: The brightest counted point: its value, decoded value and location; None if `count` is 0.
        hidden: Number of such points in groups where most points have an error of more than half of their own light
            and the maximum is at least ten times the median.
    """

    def __init__(self) -> None:
        self.count = self.hidden = 0
        self.worst: tuple[float, float, str] | None = None

    def add(self, reference: np.ndarray | torch.Tensor, decoded: np.ndarray | torch.Tensor, where: str = "") -> None:
        """Adds a group of points, such as a tile at one time of day or a whole probe set.

        Args:
            reference, decoded: [K, C], on one device; a point's light is the largest magnitude of its channels.
            where: Name of the group in the warning.
        """
        if not len(reference):
            return
        reference, decoded = torch.as_tensor(reference), torch.as_tensor(decoded)
        light, kept = _largest(reference), _largest(decoded)
        if not (largest := light.max()) > 0:
            return
        lost = (light >= _BRIGHT * largest) & (kept < _KEPT * light)
        if count := int(lost.count_nonzero()):
            self.count += count
            worst = int(torch.where(lost, light, 0.0).argmax())
            if self.worst is None or light[worst] > self.worst[0]:
                self.worst = float(light[worst]), float(kept[worst]), where
        if largest > _BRIGHTER * light.median():
            lit = light > 0
            off = int(((_largest(decoded - reference) > _KEPT * light) & lit).count_nonzero())
            if 2 * off > int(lit.count_nonzero()):
                self.hidden += off

    def warnings(self, name: str, point: str, group: str) -> list[str]:
        """Returns one line for each kind of loss that occurred.

        Args:
            name: Name of the compressed data.
            point, group: Words for a point and for its group, such as "texel" and "its tile".
        """
        lines = []
        if self.worst is not None:
            light, kept, where = self.worst
            lines.append(
                f"{name}: {_count(self.count, point)} among the brightest of {group} lost more than half of the light; "
                f"the largest of {light:.4g} decodes to {kept:.4g}{where and f' ({where})'}"
            )
        if self.hidden:
            lines.append(
                f"{name}: {_count(self.hidden, point)}, most of {group}, are off by more than half of their own light; "
                "PSNR hides it, since others are over ten times as bright"
            )
        return lines


def _largest(values: torch.Tensor) -> torch.Tensor:
    """Returns the largest channel magnitude of each row, [K]; looping over columns is faster than over rows."""
    result = values[:, 0].abs()
    for channel in range(1, values.shape[1]):
        torch.maximum(result, values[:, channel].abs(), out=result)
    return result


def _count(number: int, point: str) -> str:
    return f"1 {point}" if number == 1 else f"{number} {point}s"
