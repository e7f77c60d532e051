"""The nearest endpoints that BC7 mode 6 can store, found by trying them all."""

import torch


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
