"""Networks on 8-bit levels in torch: what `wlm_kernels.lightmap.levels` does in one launch."""

import torch

LEVELS = 127


def on_levels(weights: torch.Tensor) -> torch.Tensor:
    """The 8-bit levels next to weights.

    Args:
        weights: float32 [N, inputs, units].

    Returns:
        float32 of that shape, half floats.
    """
    step = weights.abs().amax(1, keepdim=True).half().float() / LEVELS
    whole = torch.where(step > 0, torch.round(weights / step), 0.0).clamp(-LEVELS, LEVELS)
    return (whole * step).half().float()


def put_on_levels(hidden: torch.Tensor, output: torch.Tensor, inputs: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Networks with their weights on levels and their biases as they are.

    Args:
        hidden: float32 [N, I + H + 2, H], see `wlm_kernels.mlp`.
        output: float32 [N, H + 1, 3].
        inputs: I.
    """
    first, bias, second, last = hidden.split([inputs, 1, hidden.shape[2], 1], 1)
    layers = torch.cat([on_levels(first), bias, on_levels(second), last], 1)
    return layers, torch.cat([on_levels(output[:, :-1]), output[:, -1:]], 1)
