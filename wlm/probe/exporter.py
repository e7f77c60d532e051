"""Probe models for engines: Gaussians, network and shader as plain files, which together need nothing of this package.

A runtime keeps Gaussians and network at 16 bits a number (gaussian-probe-compression, section 5.3.2 and table 3). The
paper's numbers are half floats. Here those of the Gaussians are the file's own codes, in as many bytes: they decode to
exactly what was trained, where a half float may move a centre by a 4096th of the box.
"""

import os
from pathlib import Path
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.export.shading import ENDINGS, check_language, translate
from wlm.formats.folder import made_parents, rounded, staged, write_index
from wlm.probe.conventions import CANONICAL
from wlm.probe.data import save_probes
from wlm.probe.day import DayModel
from wlm.probe.decode import Decoder
from wlm.probe.model import CENTRE, SCALE, ProbeModel, live_probes
from wlm.probe.shader import HEAD_WORDS, gaussian_words, probe_glsl
from wlm.probe.sphere import sh_count
from wlm.probe.transform import Transform
from wlm.probe.transform_export import LIGHT_FILE, light_bytes, transform_document, transform_glsl

FORMAT = "wlm-probe-export"
_VERSION = 1
INFO_FILE = "probe.json"
GAUSSIANS_FILE = "gaussians.bin"
NETWORK_FILE = "network.bin"
POSITIONS_FILE = "positions.bin"
_SHADER_FILES = {language: "probe" + ending for language, ending in ENDINGS.items()}
REFERENCE_FILE = "reference.json"

_FILES = {INFO_FILE, LIGHT_FILE, GAUSSIANS_FILE, NETWORK_FILE, POSITIONS_FILE, REFERENCE_FILE, *_SHADER_FILES.values()}
_REFERENCES = 64  # positions in reference.json, and one outside the box
_FOUR = 4

_ABOUT = {
    "place": "x = (position - origin) / extent, then each coordinate of x clamped to 0 ... size. The Gaussians and the "
    "network take x.",
    "gaussian": "A number is low + code * step. 10 + latent of them: centre, log of the scale s, quaternion q = w x y "
    "z of any length (zero stands for no rotation), latent. u = R(q)^T (x - centre) / s; the weight at x is "
    "exp(-|u|^2 / 2). It reaches x where |u| < cut, or for the support 'sphere' where |x - centre| < cut * max(s). "
    "The sum of weight * latent over the Gaussians that reach x is F.",
    "network": "h1 = sigmoid(W1 [F, x] + b1), h2 = sigmoid(W2 h1 + b2), values = gain * (W3 h2 + b3).",
    "lists": "To leave out Gaussians that don't reach x, make lists of them when the files are loaded: cut the box "
    "0 ... size into cubes, 4 to 16 along its longest side, and list a Gaussian with each cube that meets "
    "centre +- reach, where reach along axis a is cut * sqrt(sum over b of (R_ab s_b)^2), or for the support 'sphere' "
    "cut * max(s). Widen the cubes by a millionth, for rounding. The list of the cube that x lies in has all that "
    "reach x; the shader tests each again.",
    "values": "Of a probe, outputs numbers. Spherical harmonics: coefficient after coefficient, of each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "dead": "Probes that are zero, by number from 0 in the order of compression: engines leave them inside walls. "
    "Gaussians and network know nothing of them.",
    "positions": "If positions.bin is there: 3 unsigned 16-bit codes a probe, position = origin + extent * size * code "
    "/ 65535.",
    "reference": "reference.json has positions of the scene, the last one outside the box, and the values there.",
    "precision": "The shader computes in floats. For Gaussians far longer than thin the reference uses doubles in "
    "places: slenderness is the largest ratio of a Gaussian's scales, and 1e-7 times it is about the error of u.",
}


def export(
    model: ProbeModel | Transform,
    directory: str | os.PathLike[str],
    *,
    device: str = "cpu",
    position: np.ndarray | None = None,
    shader: str = "glsl",
) -> list[Path]:
    """Writes a model as buffers, numbers and a shader.

    `gaussians.bin` and `network.bin`, or `light.bin` of a transform, are laid out as `probe.glsl` says at its head,
    `positions.bin` is written if a model of Gaussians has positions, `reference.json` has the light at some places to
    compare with, and `probe.json` explains itself under "about".

    All files are made beside the folder and moved in together, `probe.json` last. A new export replaces an earlier
    one in its folder; other files there stay.

    Args:
        model: The model.
        directory: The folder; made if it isn't there.
        device: Where the reference is decoded.
        position: [N, 3], of a transform's own probes; None: those that are stored with it.
        shader: One of `wlm.export.shading.LANGUAGES`: `probe.glsl`, `probe.hlsl`, `probe.metal` or `probe.wgsl`.

    Returns:
        The files written, `probe.json` last.

    Raises:
        WlmError: The folder holds something other than an earlier export, or can't be written; no such device or
            language; or a number of the model isn't finite.
    """
    check_language(shader)
    folder = Path(directory)
    if isinstance(model, Transform):
        return _export_transform(model, folder, device, position, shader)
    for part in (model.net, model.bounds, model.origin, model.size, np.array([model.extent, model.gain])):
        if not np.isfinite(part).all():
            raise WlmError(f"{model.name}: cannot export: a number is NaN or infinite")
    position = _reference_positions(model)
    values = Decoder(model, device).decode(position)
    if not np.isfinite(values).all():
        raise WlmError(f"{model.name}: cannot export: it decodes to NaN or infinity")
    files = {
        GAUSSIANS_FILE: gaussian_bytes(model),
        NETWORK_FILE: network_bytes(model),
        _SHADER_FILES[shader]: translate(probe_glsl(model), shader).encode(),
    }
    if len(model.positions):
        files[POSITIONS_FILE] = np.ascontiguousarray(model.positions, "<u2").tobytes()
    return _write(folder, files, _document(model), position, values)


def _export_transform(
    model: Transform, folder: Path, device: str, position: np.ndarray | None, shader: str
) -> list[Path]:
    own = model.stored_positions() if position is None else np.asarray(position, np.float64)
    decoder = model.decoder(device, position=None if position is None else own)
    live = live_probes(model.dead, model.probes)
    place = own[live]
    content, numbers = light_bytes(model, place, decoder.decode_probes()[live])
    # Half-way between probes that are neighbours in the file, and outside.
    chosen = np.unique(np.linspace(0, len(place) - 1, min(len(place), _REFERENCES)).astype(int))
    between = 0.5 * (place[chosen] + place[np.minimum(chosen + 1, len(place) - 1)])
    points = np.concatenate([between, place.max(0)[None] + 0.25 * np.ptp(place, axis=0).max() + 0.25])
    text = translate(transform_glsl(len(place), model.outputs), shader)
    files = {LIGHT_FILE: content, _SHADER_FILES[shader]: text.encode()}
    document = transform_document(model, len(place), numbers)
    if isinstance(model, DayModel):
        document |= {"time": model.time, "times": list(model.times)}
    return _write(folder, files, document, points, decoder.decode(points))


def _write(
    folder: Path, files: dict[str, bytes], document: dict[str, Any], position: np.ndarray, values: np.ndarray
) -> list[Path]:
    """Writes the files, the reference and the document, which lists them."""
    sizes = {name: len(content) for name, content in files.items()}
    document = {"format": FORMAT, "version": _VERSION} | document | {"bytes": sizes}
    with made_parents(folder), staged(folder, INFO_FILE, FORMAT, _FILES.__contains__) as temporary:
        for name, content in files.items():
            (temporary / name).write_bytes(content)
        save_probes(temporary / REFERENCE_FILE, position, values)
        write_index(temporary / INFO_FILE, document)
    return [folder / name for name in (*files, REFERENCE_FILE, INFO_FILE)]


def gaussian_bytes(model: ProbeModel) -> bytes:
    """What `gaussians.bin` holds.

    Raises:
        WlmError: The probes' box has no floats.
    """
    words = gaussian_words(model.profile.latent)
    codes = np.zeros((model.count, 2 * words), "<u2")
    codes[:, : model.codes.shape[1]] = model.codes
    with np.errstate(over="ignore"):
        head = np.array([*model.origin, model.extent, *model.size, model.gain, model.profile.cut], "<f4")
    if not (np.isfinite(head).all() and head[3] > 0):
        raise WlmError(f"{model.name}: cannot export: the probes' box is too large or too small for floats")
    count = np.array([model.count], "<u4")
    numbers = np.concatenate([model.bounds[0], model.steps]).astype("<f4")
    return head.tobytes() + count.tobytes() + numbers.tobytes() + codes.tobytes()


def network_bytes(model: ProbeModel) -> bytes:
    """What `network.bin` holds: the network in 4 x 4 blocks, as the shader reads it."""
    pieces = []
    for layer in model.layers():
        inputs, outputs = len(layer) - 1, layer.shape[1]
        # The biases first, then a row for each input.
        padded = np.zeros((1 + _up(inputs), _up(outputs)), "<f2")
        padded[0, :outputs], padded[1 : inputs + 1, :outputs] = layer[-1], layer[:-1]
        # [1 + I, O / 4, 4] to [O / 4, 1 + I, 4].
        pieces.append(padded.reshape(len(padded), -1, _FOUR).swapaxes(0, 1).tobytes())
    return b"".join(pieces)


def _up(count: int) -> int:
    return -(-count // _FOUR) * _FOUR


def _reference_positions(model: ProbeModel) -> np.ndarray:
    """Centres of Gaussians, spread evenly over their numbers, and a place outside the box; float64 [M, 3]."""
    chosen = np.unique(np.linspace(0, model.count - 1, min(model.count, _REFERENCES)).astype(int))
    inside = model.rows()[chosen, CENTRE].astype(np.float64)
    return model.origin + model.extent * np.concatenate([inside, model.size[None] + 0.25])


def _document(model: ProbeModel) -> dict[str, Any]:
    profile = model.profile
    scale = np.exp(model.rows()[:, SCALE]).astype(np.float64)
    return {
        "about": _ABOUT,
        "name": model.name,
        "source": model.source,
        "probes": model.probes,
        "outputs": model.outputs,
        "coefficients": sh_count(model.outputs),
        "convention": CANONICAL,
        "gaussians": model.count,
        "latent": profile.latent,
        "hidden": profile.hidden,
        "support": profile.support,
        "cut": profile.cut,
        "origin": model.origin.tolist(),
        "extent": model.extent,
        "size": model.size.tolist(),
        "gain": model.gain,
        "low": rounded(model.bounds[0]),
        "step": rounded(model.steps),
        "first_gaussian_word": HEAD_WORDS + 2 * model.bounds.shape[1],
        "words_per_gaussian": gaussian_words(profile.latent),
        "slenderness": float(f"{(scale.max(1) / scale.min(1)).max():.3g}"),
        "dead": np.flatnonzero(model.dead).tolist(),
    }
