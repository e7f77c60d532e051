"""Decodes Gaussians' stored codes to light in float64, as the reference for the float32 kernels."""

import numpy as np
import torch
from scipy.special import expit

from benchmarks.plain import gaussian_sum
from wlm.probe.gaussian.model import CUT
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import ambient_numbers

_PAIRS = 1 << 20  # points times Gaussians per piece: about 100 MB


def decode64(model: ProbeModel, position: np.ndarray) -> np.ndarray:
    """Returns the light of Gaussians at points, by the sum over all Gaussians.

    Implements gaussian-probe-compression, eq. 2 to 7 and 14. The sum jumps where a Gaussian's support ends, by up to
    exp(-CUT^2 / 2) = 0.011 times the Gaussian's latent. Kernels can differ from it near this edge, in float32.

    Args:
        model: A model of Gaussians.
        position: [M, 3], in the unit of the probes' positions; points outside the probes' box are moved to its
            surface.

    Returns:
        float64 [M, D].
    """
    content = model.content
    x = np.clip((np.asarray(position, np.float64) - model.origin) / model.extent, 0.0, model.size)
    low, high = content.bounds.astype(np.float64)
    rows = low + content.code * ((high - low) / np.maximum(content.levels, 1))  # eq. 14
    net = [(layer[:-1], layer[-1]) for layer in (layer.astype(np.float64) for layer in content.layers())]
    out = np.empty((len(x), content.columns))
    piece = max(1, _PAIRS // content.count)
    for start in range(0, len(x), piece):
        part = x[start : start + piece]
        sums = gaussian_sum(torch.from_numpy(rows), torch.from_numpy(part), cut=CUT, support=content.support)
        h = np.concatenate([sums.numpy(), part], 1)
        for weight, bias in net[:2]:
            h = expit(h @ weight + bias)
        out[start : start + piece] = h @ net[2][0] + net[2][1]
    if content.relative:
        out = np.exp(np.minimum(out[:, -1:], 0.0)) * out[:, :-1]
    ambient = ambient_numbers(model.outputs)
    out[:, :ambient] = np.maximum(out[:, :ambient], 0.0)
    return content.gain * out
