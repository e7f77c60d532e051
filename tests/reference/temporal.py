"""The whole model of a temporal tile: features, answer, loss and decoded colour (neural-dynamic-gi, 3.3 and 3.4)."""

import math

import torch

from wlm.ops import plain

SIZE = 128


def byte_levels(values: torch.Tensor, quantised: bool) -> torch.Tensor:
    """A plane's values as used: clamped, or the nearest of 256 levels; straight through."""
    used = values.clamp(0.0, 1.0)
    if quantised:
        used = torch.floor(used * 255.0 + 0.5) / 255.0
    return plain.straight_through(values, used)


def features_of(
    uv: torch.Tensor,
    temporal: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None,
    tile: torch.Tensor,
    place: torch.Tensor,
    tau: torch.Tensor,
    encoding: torch.Tensor,
    periodic: bool,
) -> torch.Tensor:
    """The network's inputs, before noise and centring.

    Args:
        uv: Texels of F_uv, [N, 128, 128, 4].
        temporal: Texels of F_uvt [N, S, R, R, 4], F_ut and F_vt [N, rows, columns, 2]; None for static tiles.
        tile: int [M], the tile of each sample.
        place: int [M, 2], its (y, x).
        tau: [M], its place on the time axis.
        encoding: [M, 4], gamma(t) of eq. 4.
        periodic: Whether the time axis wraps.

    Returns:
        [M, 16], or [M, 4] for static tiles.
    """
    found = uv[tile, place[:, 0], place[:, 1]]
    if temporal is None:
        return found
    uvt, ut, vt = temporal
    v, u = ((place.double() + 0.5) / SIZE).unbind(1)
    parts = [
        found,
        plain.volume(uvt, torch.stack([u, v, tau], 1), layer=tile, periodic=periodic),
        plain.plane(ut, torch.stack([u, tau], 1), layer=tile, periodic=periodic),
        plain.plane(vt, torch.stack([v, tau], 1), layer=tile, periodic=periodic),
        encoding,
    ]
    return torch.cat(parts, 1)


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
    """`features_of` from maps in training; keys and shapes as in `wlm.lightmap.trainer.Trainer.views`."""
    uv = plain.bc7_texels(maps["uv_endpoints"], maps["uv_weights"], quantised=quantised)
    temporal = None
    if "uvt_weights" in maps:
        uvt = plain.bc7_texels(maps["uvt_endpoints"], maps["uvt_weights"], quantised=quantised)
        planes = (byte_levels(maps[key], quantised) for key in ("ut", "vt"))
        temporal = (uvt.reshape(len(uv), -1, *uvt.shape[1:]), *planes)
    return features_of(uv, temporal, tile, place, tau, encoding, periodic)


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
