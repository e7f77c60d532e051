"""Decodes Gaussians' stored codes to light in float64, as the reference for the float32 kernels."""

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import expit

from wlm.probe.gaussian.model import CENTRE, CUT, LATENT, ROTATION, SCALE
from wlm.probe.model import ProbeModel

_PAIRS = 1 << 20  # points times Gaussians per piece: about 100 MB
_SHORTEST = 1e-12  # length of a quaternion that has a direction


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
    scale = np.exp(rows[:, SCALE])
    q = np.where(np.linalg.norm(rows[:, ROTATION], axis=1, keepdims=True) < _SHORTEST, [1, 0, 0, 0], rows[:, ROTATION])
    whiten = Rotation.from_quat(q[:, [1, 2, 3, 0]]).as_matrix().transpose(0, 2, 1) / scale[:, :, None]  # S^-1 R^T
    net = [(layer[:-1], layer[-1]) for layer in (layer.astype(np.float64) for layer in content.layers())]
    out = np.empty((len(x), model.outputs))
    piece = max(1, _PAIRS // content.count)
    for start in range(0, len(x), piece):
        part = x[start : start + piece]
        away = part[:, None] - rows[:, CENTRE]
        d2 = (np.einsum("kij,nkj->nki", whiten, away) ** 2).sum(2)
        within = (away**2).sum(2) < (CUT * scale.max(1)) ** 2 if content.support == "sphere" else d2 < CUT**2
        h = np.concatenate([np.where(within, np.exp(-0.5 * d2), 0.0) @ rows[:, LATENT], part], 1)
        for weight, bias in net[:2]:
            h = expit(h @ weight + bias)
        out[start : start + piece] = h @ net[2][0] + net[2][1]
    return content.gain * out
