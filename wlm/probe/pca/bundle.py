"""Packs principal components into a GPU buffer, and generates the shader that decodes a probe from it."""

import numpy as np

from wlm.bundle import Bundle
from wlm.probe.decode import Decoder
from wlm.probe.glsl import buffer_glsl, clamp_glsl, sh_glsl
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import sh_count

_REFERENCES = 64

_ABOUT = {
    "probe": "values = m * sum over k of c_k * b_k, with the magnitude m = exp(low_0 + step_0 * code_0) and the "
    "coefficients c_k = low_k + step_k * code_k for k from 1 to the number of components; low, step and b are those of "
    "the probe's cluster. Of spherical harmonics the first three values are clamped at 0. Codes have the bits that the "
    "buffer states. The basis vectors b_k are half floats, or the unit vectors where basis is false.",
    "live": "The buffer probes holds live probes only, in the order of compression: live probe i is probe i of the set "
    "less the dead probes before it.",
    "between": "To read light between probes, fill a volume from them, or take the nearest probes.",
    "reference": "live: indices of some live probes; values: their light.",
}

_TEMPLATE = """\
// Decodes light probes from principal components. For GLSL 4.30 and later, with or without Vulkan; include it below
// #version. It fits every model of {outputs} numbers per probe and {count} components{unit}. The document
// has the formula; see "about" there.
//
// Buffer probes, 32-bit words, little-endian:
//   0    number of live probes, an integer
//   1    number of clusters C, an integer
//   2    {columns} words, one for each code of a probe: its first bit among those of the probe (16 bits), and its width
//   {first}   for each cluster {numbers} words: the lowest value and the step of the magnitude's logarithm and of each
//        coefficient, half floats
//   {first} + {numbers} C   for each cluster {count_basis} basis vectors of {words} words: half floats, two in a word,
//        the low half first
//   {first} + {stride} C   the bits of one probe after another, from the lowest bit of a word: its cluster, the code of
//        its magnitude, and those of its coefficients
//
// It is a storage buffer, unless WLM_PROBE_PROBES(i) is defined before this file as another way to read word i.

{buffers}
const int WLM_PROBE_OUTPUTS = {outputs};
const int WLM_PROBE_COMPONENTS = {count};

int wlm_probe_count()
{{
    return int(WLM_PROBE_PROBES(0));
}}

// Code of a live probe: its cluster (column 0), or that of its magnitude (1) or of a coefficient.
uint wlm_probe_code(int probe, int column)
{{
    uint place = WLM_PROBE_PROBES(2 + column);
    uint last = WLM_PROBE_PROBES({first} - 1);
    int bits = int((last & 65535u) + (last >> 16u));
    int width = int(place >> 16u);
    if (width == 0)
        return 0u;
    // The bits of 32 probes end with a word.
    int bit = probe % 32 * bits + int(place & 65535u);
    int word = {first} + {stride} * int(WLM_PROBE_PROBES(1)) + probe / 32 * bits + bit / 32;
    uint code = WLM_PROBE_PROBES(word) >> uint(bit % 32);
    if (bit % 32 + width > 32)
        code |= WLM_PROBE_PROBES(word + 1) << uint(32 - bit % 32);
    return code & ((1u << uint(width)) - 1u);
}}

// Logarithm of the magnitude of a live probe of a cluster (number 0), or one of its coefficients.
float wlm_probe_number(int probe, int cluster, int number)
{{
    vec2 bounds = unpackHalf2x16(WLM_PROBE_PROBES({first} + cluster * {numbers} + number));
    return bounds.x + bounds.y * float(wlm_probe_code(probe, 1 + number));
}}

// The numbers of a live probe.
void wlm_probe_values(int probe, out float values[WLM_PROBE_OUTPUTS])
{{
    int cluster = int(wlm_probe_code(probe, 0));
    float magnitude = exp(wlm_probe_number(probe, cluster, 0));
{body}{clamp}
}}
"""

_BASIS = """\
    int basis = {first} + {numbers} * int(WLM_PROBE_PROBES(1)) + cluster * {basis_words};
    for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d)
        values[d] = 0.0;
    for (int k = 0; k < WLM_PROBE_COMPONENTS; ++k) {{
        float coefficient = magnitude * wlm_probe_number(probe, cluster, 1 + k);
        for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d) {{
            vec2 pair = unpackHalf2x16(WLM_PROBE_PROBES(basis + k * {words} + d / 2));
            values[d] += coefficient * (d % 2 == 0 ? pair.x : pair.y);
        }}
    }}"""

_UNIT = """\
    for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d)
        values[d] = magnitude * wlm_probe_number(probe, cluster, 1 + d);"""


def component_bundle(model: ProbeModel, decoder: Decoder) -> Bundle:
    """Returns the shader, buffers and examples for a model of principal components; `decoder` decodes the examples."""
    content = model.content
    values = decoder.decode_probes()[model.live]
    chosen = np.unique(np.linspace(0, len(values) - 1, min(len(values), _REFERENCES)).astype(int))
    halves = np.zeros((len(content.basis), -(-model.outputs // 2) * 2), "<f2")
    halves[:, : model.outputs] = content.basis
    place = content.places()
    words = [
        np.array([len(content.code), content.clusters], "<u4"),
        (place[:, 0] | place[:, 1] << 16).astype("<u4"),
        np.ascontiguousarray(np.moveaxis(content.bounds, 0, 2), "<f2").reshape(-1).view("<u4"),
        halves.reshape(-1).view("<u4"),
        content.packed(),
    ]
    has_basis = bool(len(content.basis))
    shader = component_glsl(content.count, model.outputs, has_basis)
    document = {"about": _ABOUT, "live": len(values), "components": content.count, "basis": has_basis}
    document["clusters"] = content.clusters
    first = 4 + content.count + content.clusters * (1 + content.count)
    document["hour"] = {"buffer": "probes", "first_word": first, "words": halves.size // 2}
    reference = {"live": chosen.astype(np.int32), "values": values[chosen]}
    buffers = {"probes": np.concatenate(words)}
    return Bundle("probe", model.name, shader, document, buffers=buffers, reference=reference)


def component_glsl(count: int, outputs: int, basis: bool) -> str:
    """Returns the GLSL for models with the given sizes: functions to be included below `#version`.

    Args:
        count: Number of components of a cluster.
        outputs: Numbers per probe.
        basis: Whether the model stores a basis; if not, its directions are the unit vectors.

    Returns:
        GLSL 4.30, which is also valid Vulkan GLSL.
    """
    words = -(-outputs // 2)
    layout = {"first": 4 + count, "words": words, "numbers": 1 + count, "basis_words": count * words}
    layout["stride"] = layout["numbers"] + (layout["basis_words"] if basis else 0)
    text = _TEMPLATE.format(
        buffers=buffer_glsl("probe", "probes", 0),
        outputs=outputs,
        count=count,
        columns=2 + count,
        count_basis=count if basis else 0,
        unit="" if basis else ", without a basis",
        clamp=clamp_glsl(outputs),
        body=_BASIS.format(**layout) if basis else _UNIT,
        **layout,
    )
    coefficients = sh_count(outputs)
    if coefficients is None:
        return text
    return text + sh_glsl("wlm_probe_sh", "int probe", "wlm_probe_values(probe, values)", coefficients)
