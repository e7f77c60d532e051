"""Packs Gaussians and their network into GPU buffers, in the layout that the shader reads.

The paper stores half floats (gaussian-probe-compression, section 5.3.2). Here a number of a Gaussian is the model's
16-bit code, as many bytes, which decodes exactly to the model's number; a weight of the network is a half float.
"""

import numpy as np

from wlm.bundle import Bundle
from wlm.errors import WlmError
from wlm.formats.folder import rounded
from wlm.probe.decode import Decoder
from wlm.probe.gaussian.model import CENTRE, CUT, SCALE, Gaussians, padded_size
from wlm.probe.gaussian.shader import HEAD_WORDS, gaussian_words, probe_glsl
from wlm.probe.model import ProbeModel

_REFERENCES = 64  # positions of the reference, and one outside the box
_FOUR = 4

_ABOUT = {
    "position": "x = (position - origin) / extent, then each coordinate of x is clamped to 0 ... size. The Gaussians "
    "and the network take x.",
    "gaussian": "A number is low + code * step. A Gaussian has 10 + latent numbers: centre, logarithm of the scale s, "
    "quaternion q = w x y z of any length (length zero is no rotation), latent. u = R(q)^T (x - centre) / s; the "
    "weight at x is exp(-|u|^2 / 2). The support is |u| < cut, or |x - centre| < cut * max(s) for the support "
    "'sphere'. F is the sum of weight * latent over the Gaussians whose support contains x.",
    "network": "h1 = sigmoid(W1 [F, x] + b1), h2 = sigmoid(W2 h1 + b2), y = W3 h2 + b3, values = gain * y. If "
    "magnitude is true, y has one number more, the last, and values = gain * exp(min(last, 0)) * y. Of spherical "
    "harmonics the first three values are clamped at 0.",
    "lists": "To skip Gaussians that do not reach x, build lists of them at loading time: cut the box 0 ... size into "
    "cubes, 4 to 16 along its longest side, and list a Gaussian with each cube that meets centre +- reach, where reach "
    "along axis a is cut * sqrt(sum over b of (R_ab s_b)^2), or cut * max(s) for the support 'sphere'. Widen the cubes "
    "by a millionth for rounding. The list of the cube that contains x has all Gaussians that reach x; the shader "
    "tests each of them again.",
    "reference": "position: points of the scene, the last one outside the box; values: the light there.",
    "precision": "The shader computes in floats. For Gaussians far longer than thin the reference uses doubles in "
    "some places: slenderness is the largest ratio of a Gaussian's scales, and about 1e-7 times it is the error of u.",
}


def gaussian_bundle(model: ProbeModel, decoder: Decoder) -> Bundle:
    """Returns the shader, buffers and examples for a model of Gaussians; `decoder` computes the examples' light. Raises
    a WlmError if the probes' box exceeds float32."""
    content = model.content
    position = _reference_positions(model, content)
    scale = np.exp(content.rows()[:, SCALE]).astype(np.float64)
    document = {
        "about": _ABOUT,
        "gaussians": content.count,
        "latent": content.latent,
        "hidden": content.hidden,
        "support": content.support,
        "magnitude": content.relative,
        "cut": CUT,
        "gain": content.gain,
        "low": rounded(content.bounds[0]),
        "step": rounded(content.steps),
        "first_gaussian_word": HEAD_WORDS + 2 * content.bounds.shape[1],
        "words_per_gaussian": gaussian_words(content.latent),
        "slenderness": float(f"{(scale.max(1) / scale.min(1)).max():.3g}"),
    }
    network = _network_words(content)
    words = padded_size(content.hidden, content.columns) // 2
    document["hour"] = {"buffer": "network", "first_word": len(network) - words, "words": words}
    buffers = {"gaussians": _gaussian_words(model, content), "network": network}
    reference = {"position": position, "values": decoder.decode(position)}
    return Bundle("probe", model.name, probe_glsl(content), document, buffers=buffers, reference=reference)


def _gaussian_words(model: ProbeModel, content: Gaussians) -> np.ndarray:
    """Returns the buffer `gaussians`, uint32; its layout is at the head of the shader."""
    words = gaussian_words(content.latent)
    codes = np.zeros((content.count, 2 * words), "<u2")
    codes[:, : content.code.shape[1]] = content.code
    with np.errstate(over="ignore"):
        head = np.array([*model.origin, model.extent, *model.size, content.gain, CUT], "<f4")
    if not (np.isfinite(head).all() and head[3] > 0):
        raise WlmError(f"{model.name}: cannot export: the probes' box is too large or too small for float32")
    numbers = np.concatenate([content.bounds[0], content.steps]).astype("<f4")
    count = np.array([content.count], "<u4")
    return np.concatenate([head.view("<u4"), count, numbers.view("<u4"), codes.reshape(-1).view("<u4")])


def _network_words(content: Gaussians) -> np.ndarray:
    """Returns the buffer `network`, uint32: the network in 4 x 4 blocks of half floats, as the shader reads them."""
    pieces = []
    for layer in content.layers():
        inputs, outputs = len(layer) - 1, layer.shape[1]
        # The biases first, then a row for each input.
        padded = np.zeros((1 + -(-inputs // _FOUR) * _FOUR, -(-outputs // _FOUR) * _FOUR), "<f2")
        padded[0, :outputs], padded[1 : inputs + 1, :outputs] = layer[-1], layer[:-1]
        # [1 + I, O / 4, 4] to [O / 4, 1 + I, 4].
        pieces.append(padded.reshape(len(padded), -1, _FOUR).swapaxes(0, 1).reshape(-1))
    return np.concatenate(pieces).view("<u4")


def _reference_positions(model: ProbeModel, content: Gaussians) -> np.ndarray:
    """Returns points to decode as examples, float64 [M, 3]: some Gaussians' centres, and a point outside the box."""
    chosen = np.unique(np.linspace(0, content.count - 1, min(content.count, _REFERENCES)).astype(int))
    inside = content.rows()[chosen, CENTRE].astype(np.float64)
    return model.origin + model.extent * np.concatenate([inside, model.size[None] + 0.25])
