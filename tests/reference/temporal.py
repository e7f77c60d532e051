"""The whole model of a temporal tile: features, answer, loss and decoded colour (neural-dynamic-gi, 3.3 and 3.4)."""

import math

import torch

from benchmarks import plain

SIZE = 128


def centre(features: torch.Tensor) -> torch.Tensor:
    """Map features v -> (v - 1/2) sqrt(12); the encoded time (from column 12 on) as it is."""
    return torch.cat([(features[:, :12] - 0.5) * math.sqrt(12.0), features[:, 12:]], 1)


def train_features(
    maps: dict[str, torch.Tensor],
    tile: torch.Tensor,
    place: torch.Tensor,
    tau: torch.Tensor,
    encoding: torch.Tensor,
    periodic: bool,
    quantised: bool,
) -> torch.Tensor:
    """The network's inputs, before noise and centring, from maps in training.

    Args:
        maps: Keys and shapes as in `wlm.lightmap.trainer.Trainer.views`.
        tile: int [M], the tile of each sample.
        place: int [M, 2], its (y, x).
        tau: [M], its place on the time axis.
        encoding: [M, 4], gamma(t) of eq. 4.
        periodic: Whether the time axis wraps.
        quantised: Whether values are put on the levels of the file; gradients pass straight through.

    Returns:
        [M, 16].
    """
    uv = plain.bc7_texels(maps["uv_endpoints"], maps["uv_weights"], quantised=quantised)
    found = uv[tile, place[:, 0], place[:, 1]]
    uvt = plain.bc7_texels(maps["uvt_endpoints"], maps["uvt_weights"], quantised=quantised)
    v, u = ((place.double() + 0.5) / SIZE).unbind(1)
    at = torch.stack([u, v, tau], 1)
    parts = [found, plain.volume(uvt.reshape(len(uv), -1, *uvt.shape[1:]), at, layer=tile, periodic=periodic)]
    for key, axes in (("ut", [0, 2]), ("vt", [1, 2])):
        used = maps[key].clamp(0.0, 1.0)
        if quantised:
            used = torch.floor(used * 255.0 + 0.5) / 255.0
        plane = plain.straight_through(maps[key], used)
        parts.append(plain.plane(plane, at[:, axes], layer=tile, periodic=periodic))
    return torch.cat([*parts, encoding], 1)


def emphasised(
    weight: torch.Tensor, shift: torch.Tensor, spread: torch.Tensor, target: torch.Tensor, exponent: float
) -> torch.Tensor:
    """The weight of each sample and channel: times the colour over scale, at least 0.02, to a power."""
    if exponent == 0.0:
        return weight
    return weight * (shift + spread * target).clamp(min=0.02) ** exponent


def losses(answer: torch.Tensor, target: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
    """Weighted mean squared error of each tile: [N, B, 3] each -> [N]."""
    return (weight * (answer - target) ** 2).mean((1, 2))
