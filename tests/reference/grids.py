"""Linear sampling of planes and volumes, by torch's own ``grid_sample``."""

import torch
from torch.nn.functional import grid_sample


def plane(values: torch.Tensor, slices: torch.Tensor, points: torch.Tensor, periodic: bool) -> torch.Tensor:
    """Samples plane ``slices[i]`` of [S, T, W, C] at (u, t) = ``points[i]``: [N, C]."""
    return _sample(values, slices, points, periodic)


def volume(values: torch.Tensor, slices: torch.Tensor, points: torch.Tensor, periodic: bool) -> torch.Tensor:
    """Samples volume ``slices[i]`` of [S, T, H, W, C] at (u, v, t) = ``points[i]``: [N, C]."""
    return _sample(values, slices, points, periodic)


def _sample(values: torch.Tensor, slices: torch.Tensor, points: torch.Tensor, periodic: bool) -> torch.Tensor:
    times = values.shape[1]
    if periodic:
        # The last slice comes before the first, the first after the last; time moves by one cell.
        values = torch.cat([values[:, -1:], values, values[:, :1]], 1)
        t = (points[:, -1:] * times + 1.0) / (times + 2.0)
        points = torch.cat([points[:, :-1], t], 1)
    axes = points.shape[1]
    result = torch.zeros(len(points), values.shape[-1], dtype=values.dtype, device=values.device)
    for s in slices.unique():
        chosen = (slices == s).nonzero()[:, 0]
        grid = (2.0 * points[chosen] - 1.0).reshape(1, *[1] * (axes - 1), -1, axes)
        image = values[s].movedim(-1, 0)[None]
        found = grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=False)
        result = result.index_copy(0, chosen, found.reshape(values.shape[-1], -1).T)
    return result
