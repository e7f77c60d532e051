"""The MLP with two hidden layers, in torch's own functions."""

import torch
from torch.nn.functional import gelu

APPROXIMATION = {"exact": "none", "tanh": "tanh", "fast": "tanh"}


def mlp(hidden: torch.Tensor, output: torch.Tensor, x: torch.Tensor, kind: str = "exact") -> torch.Tensor:
    """Evaluates N networks.

    Args:
        hidden: [N, I + 1 + H + 1, H]: the transposed first matrix, its bias, the transposed second, its bias.
        output: [N, H + 1, 3]: the transposed third matrix and its bias.
        x: [N, B, I].
        kind: "exact", "tanh" or "fast" GELU.

    Returns:
        [N, B, 3].
    """
    inputs, width = x.shape[-1], hidden.shape[-1]
    first, bias_1, second, bias_2 = hidden.split([inputs, 1, width, 1], 1)
    third, bias_3 = output.split([width, 1], 1)
    h1 = gelu(x @ first + bias_1, approximate=APPROXIMATION[kind])
    h2 = gelu(h1 @ second + bias_2, approximate=APPROXIMATION[kind])
    return h2 @ third + bias_3
