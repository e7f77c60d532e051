"""The decode in float64, from a model's stored codes to light: what the kernels are compared with."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from wlm.probe.model import CENTRE, LATENT, ROTATION, SCALE, ProbeModel

_PAIRS = 1 << 20  # points times Gaussians in one piece: some 100 MB
_SHORTEST = 1e-12  # of a quaternion that has a direction


def decode64(model: ProbeModel, position: np.ndarray) -> np.ndarray:
    """Light at points (gaussian-probe-compression, eq. 2 to 7 and 14), by the sum over all Gaussians.

    The sum jumps where a Gaussian ends: by up to exp(-cut^2 / 2), 0.011 at a cut of 3, times its latent. A point that
    float32 puts on the other side of an edge differs by that.

    Args:
        model: The model.
        position: [M, 3], in the unit of the probes' positions; those outside the probes' box are moved to its
            nearest point.

    Returns:
        float64 [M, D].
    """
    p = model.profile
    x = np.clip((np.asarray(position, np.float64) - model.origin) / model.extent, 0.0, model.size)
    rows = _rows(model)
    scale = np.exp(rows[:, SCALE])
    q = np.where(np.linalg.norm(rows[:, ROTATION], axis=1, keepdims=True) < _SHORTEST, [1, 0, 0, 0], rows[:, ROTATION])
    whiten = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix().transpose(0, 2, 1) / scale[:, :, None]  # S^-1 R^T
    net = [(layer[:-1], layer[-1]) for layer in (layer.astype(np.float64) for layer in model.layers())]
    out = np.empty((len(x), model.outputs))
    piece = max(1, _PAIRS // model.count)
    for start in range(0, len(x), piece):
        part = x[start : start + piece]
        away = part[:, None] - rows[:, CENTRE]
        d2 = (np.einsum("kij,nkj->nki", whiten, away) ** 2).sum(2)
        if p.support == "sphere":
            within = (away**2).sum(2) < (p.cut * scale.max(1)) ** 2
        else:
            within = d2 < p.cut**2
        h = np.concatenate([np.where(within, np.exp(-0.5 * d2), 0.0) @ rows[:, LATENT], part], 1)
        for weight, bias in net[:2]:
            h = expit(h @ weight + bias)
        out[start : start + piece] = h @ net[2][0] + net[2][1]
    return model.gain * out


def _rows(model: ProbeModel) -> np.ndarray:
    """Eq. 14, float64 [K, 10 + L]."""
    low, high = model.bounds.astype(np.float64)
    return low + model.codes * ((high - low) / np.maximum(model.levels, 1))
