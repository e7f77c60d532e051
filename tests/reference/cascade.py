"""Reading a cascade by torch's own operations, with losses that autograd takes back."""

import torch
from torch.nn.functional import grid_sample


def wave(x: torch.Tensor) -> torch.Tensor:
    """Eq. 8, as the distance to the nearest even number."""
    return (x - 2.0 * torch.round(x.detach() / 2.0)).abs()


def bilinear(image: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """Reads [H, W, C], clamped, at uv [N, 2]: [N, C]."""
    grid = (2.0 * uv - 1.0)[None, None]
    found = grid_sample(image.movedim(-1, 0)[None], grid, mode="bilinear", padding_mode="border", align_corners=False)
    return found[0, :, 0].T


def sample(colour: torch.Tensor, lut: torch.Tensor | None, uv: torch.Tensor) -> torch.Tensor:
    """Eq. 7 at uv [N, 2]: [N, 3]."""
    return bilinear(colour, uv if lut is None else wave(bilinear(lut, uv)))


def image_loss(difference: torch.Tensor, weight: float) -> torch.Tensor:
    """Sums the differences [H, W, 3] and, with a weight, those of neighbours."""
    across, down = difference.diff(dim=1), difference.diff(dim=0)
    return difference.abs().sum() + weight * (across.abs().sum() + down.abs().sum())


def pair_loss(difference: torch.Tensor, weight: float) -> torch.Tensor:
    """Sums the differences [2 N, 3] and, with a weight, those of pairs."""
    one, two = difference.chunk(2)
    return difference.abs().sum() + weight * (one - two).abs().sum()
