"""How much of a network's correction is taken of one light, told from the whole picture: all of it, or often nothing.

A network errs most where smoke is like none that it has learned from, and the picture says little of how deep the smoke
is. A correction that does harm on average costs more than one that is left out, so a gate is fitted such that harm
counts `HARM` times what is gained, on lights that the network hasn't learned from. It is a sum of a few facts of the
light: what smoke and light are like, and how large the correction is.
"""

from collections.abc import Mapping, Sequence

import torch

from wlm.smoke.transport.features import Inputs

FACTS = 17
"""Of a light at an albedo."""

FAINT = 0.03
"""Light below which an error counts the same."""

GAINS = (0.0, 0.25, 0.5, 0.75)
"""Shares of a correction at which `fit_gate` is told what is gained."""

HARM = 200.0

FIT = {"gate_mean": (FACTS,), "gate_spread": (FACTS,), "gate_weights": (FACTS,), "gate_bias": (1,)}
"""Shapes of a gate's arrays."""

_SURE, _MOST = 0.6, 0.5  # of a gate from 0 to 1, up to which nothing is taken; the most of a correction that is
_FARTHEST = 4.0  # standard deviations, beyond which facts count as there
_BASES = (0, 1, 2)  # among the features light of the light itself, of the opposite one, from all around
_THICKNESS = 5
_DECILES = 2.563  # standard deviations between the first and the last
_STEPS, _RATE, _DECAY, _JITTER = 3000, 5e-2, 0.05, 0.15


def facts(inputs: Inputs, filtered: torch.Tensor, correction: torch.Tensor, albedos: Sequence[float]) -> torch.Tensor:
    """What a gate is told, [N, FACTS]; means are over the smoke that is seen, whatever is around it.

    Args:
        inputs: Of a light.
        filtered: float32 tensor [N, H, W], R by the filter, at some albedos.
        correction: As `filtered`, what the network adds.
        albedos: These.
    """
    opacity = inputs.opacity
    whole = opacity.sum().clamp(min=1e-3)

    def mean(planes: torch.Tensor) -> torch.Tensor:
        return (planes * opacity).sum((-2, -1)) / whole

    bounded = filtered + FAINT
    share, thickness = correction / bounded, inputs.features[_THICKNESS]
    one, square = torch.ones_like(inputs.depth), mean(filtered.square())
    alike = [inputs.cosine * one, inputs.cosine**2 * one, inputs.depth, mean(opacity)]
    alike += [mean(thickness), mean(thickness.square()).sqrt()]
    own = [mean(share), mean(share.square()).sqrt(), mean(share.abs())]
    own += [mean(inputs.features[base] / bounded) for base in _BASES]
    own += [mean(filtered), square / mean(filtered).clamp(min=1e-3).square()]
    powers = [mean(correction.square()), mean(correction * filtered)]
    relative, along = (power / square.clamp(min=1e-9) for power in powers)
    own += [relative.sqrt(), along]
    own += [torch.stack([10.0 * (albedo - 0.9) * one for albedo in albedos])]
    return torch.cat([torch.stack(alike).expand(len(albedos), -1), torch.stack(own, -1)], -1)


def gate(arrays: Mapping[str, torch.Tensor], told: torch.Tensor) -> torch.Tensor:
    """Shares of corrections that are taken, [N], of `facts` [N, FACTS] and the arrays of `fit_gate`."""
    sure = (_normal(arrays, told) @ arrays["gate_weights"] + arrays["gate_bias"]).sigmoid()
    # Less than it was fitted for: two thirds as much leaves nine tenths of the gain, and room for what is unlike all.
    return _MOST * ((sure - _SURE) / (1.0 - _SURE)).clamp(min=0.0)


def fit_gate(told: torch.Tensor, gains: torch.Tensor, *, seed: int = 0) -> dict[str, torch.Tensor]:
    """Fits a gate.

    Args:
        told: float32 tensor [R, FACTS], of lights that the network hasn't learned from, at albedos.
        gains: float32 tensor [R, 4], dB that each gains by `GAINS` of its correction.
        seed: Of the jitter of facts, against a gate that knows these lights alone.

    Returns:
        Arrays of `FIT` by name.
    """
    # Of most lights: a few are far from all others.
    low, mean, high = torch.quantile(told, torch.tensor([0.1, 0.5, 0.9], device=told.device), dim=0)
    spread = ((high - low) / _DECILES).clamp(min=1e-3)
    arrays = {"gate_mean": mean, "gate_spread": spread}
    weights, bias = torch.zeros(FACTS, device=told.device), torch.zeros(1, device=told.device)
    optimiser = torch.optim.AdamW([weights.requires_grad_(), bias.requires_grad_()], lr=_RATE, weight_decay=_DECAY)
    random = torch.Generator().manual_seed(seed)
    known, rows = _normal(arrays, told), torch.arange(len(told), device=told.device)
    for _ in range(_STEPS):
        jitter = torch.randn(known.shape, generator=random).to(known)
        at = ((known + _JITTER * jitter) @ weights + bias).sigmoid() * (len(GAINS) - 1)
        below = at.detach().long().clamp(max=len(GAINS) - 2)
        gained = torch.lerp(gains[rows, below], gains[rows, below + 1], at - below)
        loss = HARM * (-gained).clamp(min=0.0).mean() - gained.mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    return arrays | {"gate_weights": weights.detach(), "gate_bias": bias.detach()}


def _normal(arrays: Mapping[str, torch.Tensor], told: torch.Tensor) -> torch.Tensor:
    """Facts in standard deviations; one that isn't a number counts as usual."""
    return torch.nan_to_num((told - arrays["gate_mean"]) / arrays["gate_spread"]).clamp(-_FARTHEST, _FARTHEST)
