"""BC7 mode 6 as a trainable map (neural-dynamic-gi, eq. 7 and 8), straight through its roundings."""

import torch

from reference.grids import plane

# The 4-bit interpolation weights of the BC7 format, in 64ths.
LEVELS = torch.tensor([0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64])


def straight_through(value: torch.Tensor, used: torch.Tensor) -> torch.Tensor:
    """``used`` in the forward pass, the derivative of ``value`` in the backward one."""
    return value + (used - value).detach()


def endpoint_bytes(endpoints: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The nearest storable endpoints, by trying every byte.

    Args:
        endpoints: [..., 4], any values; clamped to [0, 1].

    Returns:
        Bytes int64 [..., 4] whose lowest bits agree, and by how much (in squared bytes, [...]) the other lowest bit
        is worse: 0 is a tie, which goes to the even bytes.
    """
    v = endpoints.detach().double().clamp(0.0, 1.0) * 255.0
    found, distance = [], []
    for bit in (0, 1):
        choices = torch.arange(bit, 256, 2, device=v.device)
        nearest = choices[(v[..., None] - choices).abs().argmin(-1)]
        found.append(nearest)
        distance.append(((nearest - v) ** 2).sum(-1))
    odd = distance[1] < distance[0]
    return torch.where(odd[..., None], found[1], found[0]), (distance[1] - distance[0]).abs()


def weight_indices(weights: torch.Tensor) -> torch.Tensor:
    """The 4-bit index of each weight: the nearest of sixteen even steps."""
    return torch.floor(weights.detach().double().clamp(0.0, 1.0) * 15.0 + 0.5).long()


def texels(endpoints: torch.Tensor, weights: torch.Tensor, quantised: bool) -> torch.Tensor:
    """A whole map: float64 [S, H/4, W/4, 2, 4] and [S, H, W] -> [S, H, W, 4]."""
    if quantised:
        stored = endpoint_bytes(endpoints)[0]
        level = LEVELS.to(weights.device)[weight_indices(weights)]
        e = straight_through(endpoints, stored / 255.0)
        w = straight_through(weights, level / 64.0)
    else:
        e = straight_through(endpoints, endpoints.clamp(0.0, 1.0))
        w = straight_through(weights, weights.clamp(0.0, 1.0))
    first, second = _per_texel(e[..., 0, :]), _per_texel(e[..., 1, :])
    mixed = (1.0 - w[..., None]) * first + w[..., None] * second
    if not quantised:
        return mixed
    a, b, k = _per_texel(stored[..., 0, :]), _per_texel(stored[..., 1, :]), level[..., None]
    return straight_through(mixed, (((64 - k) * a + k * b + 32) >> 6) / 255.0)


def sample(endpoints, weights, slices, points, quantised: bool) -> torch.Tensor:
    """Bilinear samples [N, 4] of slice ``slices[i]`` at (u, v) = ``points[i]``, clamped at the border."""
    return plane(texels(endpoints, weights, quantised), slices, points, periodic=False)


def _per_texel(blocks: torch.Tensor) -> torch.Tensor:
    """[S, h, w, C] -> [S, 4 h, 4 w, C]: each block's value at its 4 x 4 texels."""
    return blocks.repeat_interleave(4, 1).repeat_interleave(4, 2)
