"""Reading a cascade by torch's own operations, with losses that autograd takes back."""

import torch

from benchmarks.plain import texture


def wave(x: torch.Tensor) -> torch.Tensor:
    """Eq. 8, as the distance to the nearest even number."""
    return (x - 2.0 * torch.round(x.detach() / 2.0)).abs()


def sample(colour: torch.Tensor, lut: torch.Tensor | None, uv: torch.Tensor) -> torch.Tensor:
    """Eq. 7 at uv [N, 2]: [N, 3]."""
    return texture(colour, uv if lut is None else wave(texture(lut, uv)))


def image_loss(difference: torch.Tensor, weight: float) -> torch.Tensor:
    """Sums the differences [H, W, 3] and, with a weight, those of neighbours."""
    across, down = difference.diff(dim=1), difference.diff(dim=0)
    return difference.abs().sum() + weight * (across.abs().sum() + down.abs().sum())


def pair_loss(difference: torch.Tensor, weight: float) -> torch.Tensor:
    """Sums the differences [2 N, 3] and, with a weight, those of pairs."""
    one, two = difference.chunk(2)
    return difference.abs().sum() + weight * (one - two).abs().sum()
