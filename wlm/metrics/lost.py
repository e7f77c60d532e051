"""Light that an approximation lost and a mean hides.

One texel of 16,384 that is ten thousand times the others may vanish, and PSNR, whose peak it is, still be 48 dB. Or it
stays, and the others vanish.
"""

import numpy as np
import torch

_BRIGHT = 0.5  # of the largest: what counts as among the brightest
_KEPT = 0.5  # of its own: what is left of light that isn't lost; and by how much of its own light a point is off
_BRIGHTER = 10.0  # times the median: what hides an error of the others


class LostLight:
    """Counts the points of some groups that lost more than half of their light where PSNR doesn't show it.

    Attributes:
        count: Points among the brightest of their group.
        worst: The largest of them, what it decodes to, and where; None without any.
        hidden: Points of groups most of which are off by more than half of their own light, beside something that is
            ten times as bright as the median.
    """

    def __init__(self) -> None:
        self.count = self.hidden = 0
        self.worst: tuple[float, float, str] | None = None

    def add(self, reference: np.ndarray | torch.Tensor, decoded: np.ndarray | torch.Tensor, where: str = "") -> None:
        """Looks at a group: a tile at one time, or a whole set.

        Args:
            reference, decoded: [K, C], on one device; a point's light is the largest magnitude of its channels.
            where: Words for the group in the warning.
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
        """A line for each kind of loss that there was.

        Args:
            name: Of what was compressed.
            point, group: Words for a point, and for what it is a part of: "texel", "its tile".
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
    """The largest magnitude of each row's channels [K]; column by column, which is faster than row by row."""
    result = values[:, 0].abs()
    for channel in range(1, values.shape[1]):
        torch.maximum(result, values[:, channel].abs(), out=result)
    return result


def _count(number: int, point: str) -> str:
    return f"1 {point}" if number == 1 else f"{number} {point}s"
