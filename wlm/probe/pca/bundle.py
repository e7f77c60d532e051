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
    "coefficients c_k = low_k + step_k * code_k for k from 1 to the number of components. Of spherical harmonics the "
    "first three values are clamped at 0. Codes are bytes. The basis vectors b_k are half floats, or the unit vectors "
    "where basis is false.",
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
//   1    {columns} words, one for each column of codes: its lowest value and its step, half floats
//   {first}   {count_basis} basis vectors of {words} words: half floats, two in a word, the low half first
//   {codes}   codes, {columns} bytes per probe, four in a word, the lowest byte first: magnitude, then coefficients
//
// It is a storage buffer, unless WLM_PROBE_PROBES(i) is defined before this file as another way to read word i.

{buffers}
const int WLM_PROBE_OUTPUTS = {outputs};
const int WLM_PROBE_COLUMNS = {columns};

int wlm_probe_count()
{{
    return int(WLM_PROBE_PROBES(0));
}}

// Number in a column of codes of a live probe.
float wlm_probe_number(int probe, int column)
{{
    int place = probe * WLM_PROBE_COLUMNS + column;
    uint code = (WLM_PROBE_PROBES({codes} + place / 4) >> uint(8 * (place % 4))) & 255u;
    vec2 bounds = unpackHalf2x16(WLM_PROBE_PROBES(1 + column));
    return bounds.x + bounds.y * float(code);
}}

// The numbers of a live probe.
void wlm_probe_values(int probe, out float values[WLM_PROBE_OUTPUTS])
{{
    float magnitude = exp(wlm_probe_number(probe, 0));
{body}{clamp}
}}
"""

_BASIS = """\
    for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d)
        values[d] = 0.0;
    for (int k = 0; k < WLM_PROBE_COLUMNS - 1; ++k) {{
        float coefficient = magnitude * wlm_probe_number(probe, 1 + k);
        for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d) {{
            vec2 pair = unpackHalf2x16(WLM_PROBE_PROBES({first} + k * {words} + d / 2));
            values[d] += coefficient * (d % 2 == 0 ? pair.x : pair.y);
        }}
    }}"""

_UNIT = """\
    for (int d = 0; d < WLM_PROBE_OUTPUTS; ++d)
        values[d] = magnitude * wlm_probe_number(probe, 1 + d);"""


def component_bundle(model: ProbeModel, decoder: Decoder) -> Bundle:
    """Returns the shader, buffers and examples for a model of principal components; `decoder` decodes the examples."""
    content = model.content
    values = decoder.decode_probes()[model.live]
    chosen = np.unique(np.linspace(0, len(values) - 1, min(len(values), _REFERENCES)).astype(int))
    halves = np.zeros((len(content.basis), -(-model.outputs // 2) * 2), "<f2")
    halves[:, : model.outputs] = content.basis
    codes = np.zeros(-(-content.code.size // 4) * 4, np.uint8)
    codes[: content.code.size] = content.code.reshape(-1)
    words = [
        np.array([len(content.code)], "<u4"),
        np.ascontiguousarray(content.bounds.T, "<f2").reshape(-1).view("<u4"),
        halves.reshape(-1).view("<u4"),
        codes.view("<u4"),
    ]
    has_basis = bool(len(content.basis))
    shader = component_glsl(content.count, model.outputs, has_basis)
    document = {"about": _ABOUT, "live": len(values), "components": content.count, "basis": has_basis}
    reference = {"live": chosen.astype(np.int32), "values": values[chosen]}
    buffers = {"probes": np.concatenate(words)}
    return Bundle("probe", model.name, shader, document, buffers=buffers, reference=reference)


def component_glsl(count: int, outputs: int, basis: bool) -> str:
    """Returns the GLSL for models with the given sizes: functions to be included below `#version`.

    Args:
        count: Number of components.
        outputs: Numbers per probe.
        basis: Whether the model stores a basis; if not, its directions are the unit vectors.

    Returns:
        GLSL 4.30, which is also valid Vulkan GLSL.
    """
    columns, words = 1 + count, -(-outputs // 2)
    first = 1 + columns
    layout = {"first": first, "words": words, "codes": first + (count * words if basis else 0)}
    text = _TEMPLATE.format(
        buffers=buffer_glsl("probe", "probes", 0),
        outputs=outputs,
        count=count,
        columns=columns,
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
