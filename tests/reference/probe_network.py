"""The probes' network (eq. 7) and its loss (eq. 8) in float64."""

import torch


def padded(outputs: int) -> int:
    """Numbers in a row of the last layer as stored."""
    return (outputs + 3) // 4 * 4


def layers(net: torch.Tensor, inputs: int, hidden: int, outputs: int) -> list[torch.Tensor]:
    """The three layers, each [inputs + 1, outputs] with the biases as its last row; the last one is padded."""
    shapes = [(inputs + 1, hidden), (hidden + 1, hidden), (hidden + 1, padded(outputs))]
    parts = net.split([rows * columns for rows, columns in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes, strict=True)]


def loss(net, f, x, target, weight, hidden: int) -> torch.Tensor:
    """Sum over the probes and numbers of weight [D] times squared error against target [D, N].

    The network decodes the Gaussians' sums f [L, N] and the positions x [N, 3].
    """
    first, second, third = layers(net, len(f) + 3, hidden, len(target))
    h = torch.cat([f.T, x], 1)
    h = torch.sigmoid(h @ first[:-1] + first[-1])
    h = torch.sigmoid(h @ second[:-1] + second[-1])
    error = (h @ third[:-1] + third[-1])[:, : len(target)].T - target
    return (weight[:, None] * error * error).sum()
