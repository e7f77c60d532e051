"""Smoke without its empty parts: the cubes of 8^3 voxels in which there is any, for files that are soon written."""

from collections.abc import Sequence

import torch
from torch.nn.functional import pad

EDGE = 8
"""Voxels along a brick's edge."""


def gather(fields: Sequence[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
    """Takes the bricks in which any of some fields isn't 0.

    Args:
        fields: [X, Y, Z] each, of one shape, on one device.

    Returns:
        Their numbers int32 [N], rising, x the slowest axis; and each field's bricks [N, 8, 8, 8], 0 beyond the box.
    """
    margins = [part for n in reversed(fields[0].shape) for part in (0, -n % EDGE)]
    cut = []
    for field in fields:
        padded = pad(field, margins) if any(margins) else field
        x, y, z = (n // EDGE for n in padded.shape)
        cut.append(padded.reshape(x, EDGE, y, EDGE, z, EDGE))
    some = torch.stack([(part != 0).any(5).any(3).any(1) for part in cut]).any(0)
    return torch.nonzero(some.flatten())[:, 0].int(), [part.permute(0, 2, 4, 1, 3, 5)[some] for part in cut]


def scatter(numbers: torch.Tensor, bricks: torch.Tensor, shape: Sequence[int]) -> torch.Tensor:
    """What `gather` took, in its place: [X, Y, Z] of a shape, 0 elsewhere; the numbers are within it."""
    counts = [-(-n // EDGE) for n in shape]
    whole = torch.zeros([n * EDGE for n in counts], dtype=bricks.dtype, device=bricks.device)
    x, y, z = torch.unravel_index(numbers.long(), counts)
    whole.view(counts[0], EDGE, counts[1], EDGE, counts[2], EDGE)[x, :, y, :, z, :] = bricks
    return whole[tuple(slice(n) for n in shape)].contiguous()
