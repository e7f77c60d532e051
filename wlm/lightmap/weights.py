"""Networks on 8-bit levels: a byte for each weight, and a scale for each unit of a layer.

The weights into one unit share the largest magnitude m among them, a half float; a weight is q m / 127 with a whole q
from -127 to 127, rounded to a half float. Biases are half floats. The fit evaluates exactly these, straight through, so
that the file loses nothing: `wlm_kernels.lightmap.levels` puts a network on them.
"""

import numpy as np

from wlm.errors import WlmError
from wlm_kernels.lightmap.levels import LEVELS


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
        step = most.astype(np.float32) / np.float32(LEVELS)
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
        step = most.astype(np.float32) / np.float32(LEVELS)
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
