"""Packs principal components into a GPU buffer, and generates the shader that decodes a probe from it."""

import numpy as np

from wlm.bundle import Bundle, filled
from wlm.probe.decode import Decoder
from wlm.probe.glsl import buffer_glsl, clamp_glsl, sh_glsl
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import sh_count
from wlm_kernels.probe.components import GROUP

_REFERENCES = 64

_ABOUT = {
    "probe": "values = m * sum over k from 1 of c_k * b_k, with the magnitude m = exp(low_0 + step_0 * code_0) and the "
    "coefficients c_k = low_k + step_k * code_k; low, step and b, and the number of codes and their bits, are those of "
    "the probe's cluster. Of spherical harmonics the first three values are clamped at 0. The directions b_k are "
    "integers divided by 127, half floats if the model has several hours, or the unit vectors where basis is false.",
    "live": "The buffer probes holds live probes only, in the order of compression: live probe i is probe i of the set "
    "less the dead probes before it.",
    "between": "To read light between probes, fill a volume from them, or take the nearest probes.",
    "reference": "live: indices of some live probes; values: their light.",
}

_KINDS = {
    "int8": {"per_word": 4, "unit": " / 127.0", "number": "float(int(word << uint(24 - d % 4 * 8)) >> 24)"},
    "float16": {"per_word": 2, "unit": "", "number": "(d % 2 == 0 ? unpackHalf2x16(word).x : unpackHalf2x16(word).y)"},
}


def component_bundle(model: ProbeModel, decoder: Decoder) -> Bundle:
    """Returns the shader, buffers and examples for a model of principal components; `decoder` decodes the examples."""
    content = model.content
    values = decoder.decode_probes()[model.live]
    chosen = np.unique(np.linspace(0, len(values) - 1, min(len(values), _REFERENCES)).astype(int))
    used, kind = content.used, content.basis.dtype.name if len(content.basis) else ""
    rows = content.basis[used[:, 1:]] if kind else np.zeros((0, model.outputs), np.int8)
    rows = np.pad(rows, ((0, 0), (0, -model.outputs % _KINDS[rows.dtype.name]["per_word"])))
    columns = used.sum(1)
    words = [
        np.array([len(values), content.clusters, (content.clusters - 1).bit_length(), columns.sum()], "<u4"),
        (np.cumsum(columns) - columns | content.bits << 16).astype("<u4"),
        np.ascontiguousarray(np.moveaxis(content.bounds, 0, 2)[used], "<f2").reshape(-1).view("<u4"),
        np.pad(content.width[used], (0, -columns.sum() % 4)).view("<u4"),
        rows.reshape(-1).view("<u4"),
        *content.packed(),
    ]
    document = {"about": _ABOUT, "live": len(values), "components": content.count, "basis": bool(kind)}
    document["clusters"] = content.clusters
    document["hour"] = {"buffer": "probes", "first_word": sum(map(len, words[:4])), "words": len(words[4])}
    reference = {"live": chosen.astype(np.int32), "values": values[chosen]}
    buffers = {"probes": np.concatenate(words)}
    shader = component_glsl(model.outputs, kind)
    return Bundle("probe", model.name, shader, document, buffers=buffers, reference=reference)


def component_glsl(outputs: int, kind: str) -> str:
    """Returns the GLSL for models with the given sizes: functions to be included below `#version`. `outputs` is the
    count of numbers per probe; `kind` is the type of the directions that the model stores, "int8" or "float16"; "" if
    they are the unit vectors. It is GLSL 4.30, which is also valid Vulkan GLSL."""
    form = _KINDS.get(kind, {"per_word": 1})
    words = -(-outputs // form["per_word"]) if kind else 0
    text = filled(
        __package__,
        "components.glsl",
        buffers=buffer_glsl("probe", "probes", 0),
        outputs=outputs,
        words=words,
        group=GROUP,
        group_words=GROUP // 32,
        directions=f"{form['per_word']} {kind} in a word, from the lowest bits" if kind else "unit vectors",
        clamp=clamp_glsl(outputs),
        body=filled(__package__, "basis.glsl" if kind else "unit.glsl", words=words, **form),
    )
    coefficients = sh_count(outputs)
    if coefficients is None:
        return text
    return text + sh_glsl("wlm_probe_sh", "int probe", "wlm_probe_values(probe, values)", coefficients)
