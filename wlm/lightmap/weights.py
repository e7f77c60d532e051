"""Networks on 8-bit levels: a byte for each weight, and a scale for each unit of a layer.

The weights into one unit share the largest magnitude m among them, a half float; a weight is q m / 127 with a whole q
from -127 to 127, rounded to a half float. Biases are half floats. The fit evaluates exactly these, straight through, so
that the file loses nothing.
"""

import numpy as np
import torch

from wlm.errors import WlmError

_LEVELS = 127


def on_levels(weights: torch.Tensor) -> torch.Tensor:
    """The 8-bit levels next to weights.

    Args:
        weights: float32 [N, inputs, units].

    Returns:
        float32 of that shape, half floats.
    """
    step = weights.abs().amax(1, keepdim=True).half().float() / _LEVELS
    whole = torch.where(step > 0, torch.round(weights / step), 0.0).clamp(-_LEVELS, _LEVELS)
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


def pack_net(net: np.ndarray, inputs: int, hidden: int) -> np.ndarray:
    """The bytes of a network on levels: the whole numbers of all weights, then largest magnitudes and biases.

    Args:
        net: float16 [P], see `LightmapModel.net`.
        inputs, hidden: I and H.

    Raises:
        WlmError: A weight isn't on its level.
    """
    whole, halves = [], []
    for weights, bias in _layers(net, inputs, hidden):
        most = np.abs(weights).max(0)
        step = most.astype(np.float32) / np.float32(_LEVELS)
        q = np.rint(np.divide(weights, step, out=np.zeros(weights.shape, np.float32), where=step > 0))
        if not np.array_equal((q * step).astype(np.float16), weights):
            raise WlmError("net: expected weights on 8-bit levels, found others")
        whole.append(q.astype(np.int8).ravel())
        halves += [most, bias]
    # The high bytes of half floats are alike, the low ones noise.
    tail = np.concatenate(halves).astype("<f2").view(np.uint8).reshape(-1, 2).T.ravel()
    return np.concatenate([np.concatenate(whole).view(np.uint8), tail])


def packed_bytes(inputs: int, hidden: int) -> int:
    """Length of what `pack_net` gives."""
    return (inputs + hidden + 3) * hidden + 2 * 2 * (2 * hidden + 3)


def unpack_net(data: np.ndarray, inputs: int, hidden: int) -> np.ndarray:
    """The network that `pack_net` packed, float16 [P]."""
    shapes = (inputs, hidden), (hidden, hidden), (hidden, 3)
    count = sum(rows * units for rows, units in shapes)
    whole = data[:count].view(np.int8)
    halves = np.ascontiguousarray(data[count:].reshape(2, -1).T).view("<f2").ravel()
    parts, at, place = [], 0, 0
    for rows, units in shapes:
        most, bias = halves[place : place + 2 * units].reshape(2, units)
        step = most.astype(np.float32) / np.float32(_LEVELS)
        q = whole[at : at + rows * units].reshape(rows, units).astype(np.float32)
        with np.errstate(over="ignore", invalid="ignore"):  # what isn't finite is refused with the other parts
            parts += [(q * step).astype(np.float16).ravel(), bias]
        at, place = at + rows * units, place + 2 * units
    return np.concatenate(parts).astype(np.float16)


def _layers(net: np.ndarray, inputs: int, hidden: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights [inputs, units] and biases [units] of each layer."""
    split = (inputs + hidden + 2) * hidden
    rows, output = net[:split].reshape(-1, hidden), net[split:].reshape(-1, 3)
    return [
        (rows[:inputs], rows[inputs]),
        (rows[inputs + 1 : -1], rows[-1]),
        (output[:-1], output[-1]),
    ]
