"""A transform's probes for engines: places, light and lists of neighbours in one buffer, and a shader that reads it.

What is exported is unpacked: the light of each live probe as half floats, which a GPU reads at random. Between probes
the shader does what `wlm.probe.kriging` does, with the neighbours found in the cells of a grid round a point.
"""

from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.probe.conventions import CANONICAL
from wlm.probe.kriging import FEW, NEIGHBOURS, SILL, SLIGHT, TAPER
from wlm.probe.shader import SH
from wlm.probe.sphere import sh_count
from wlm.probe.transform import TransformModel

LIGHT_FILE = "light.bin"
HEAD_WORDS = 15
_PROBES_A_CELL = 4.0  # cells there are, about: live probes over this
_MOST_CELLS = 64  # along an axis

ABOUT = {
    "light": "Words of 32 bits, little-endian, laid out as probe.glsl says at its head. Live probes alone, in the "
    "order of compression: probe i of the set is the probe i - (dead probes before it) there.",
    "between": "w solves, over the nearest neighbours, (sill - |x_i - x_j| / r + [i = j] (e_i + slight)) w = sill - "
    "t_i + l, sum of w = 1, with t_i = |x - x_i| / r, r the distance of the nearest one left out, e_i = taper t_i^4 / "
    "(1 - t_i^2). Values are the sum of w_i times those of probe i. x is moved to the nearest point of the live "
    "probes' box before.",
    "cells": "The box from low, in cubes of one side. The list of a cube holds the probes in it.",
    "values": "Of a probe, outputs numbers. Spherical harmonics: coefficient after coefficient, of each red, green and "
    "blue; orthonormal real basis in the order 1; y, z, x; xy, yz, 3z2-1, xz, x2-y2; all signs plus, of radiance.",
    "dead": "Probes that are zero, by number from 0 in the order of compression: engines leave them inside walls.",
    "time": "Of a file of several hours: the time of this export, and the hours that the file holds. Between two "
    "hours their light is mixed linearly, after the last comes the first.",
    "reference": "reference.json has positions of the scene, the last one outside the box, and the values there.",
}

_TEMPLATE = """\
// Light between probes, from their nearest neighbours by kriging. For GLSL 4.30 and later, with or without Vulkan;
// include it below #version. It fits every export of {outputs} numbers a probe and {taken} neighbours. probe.json has
// the rest; see "about" there.
//
// light.bin, 32-bit words, little-endian:
//   0    low, 3 floats; 3 size, 3 floats; 6 side of a cell, a float; 7 cells along x, y and z, 3 integers
//   10   probes L, an integer; 11 gain, a float; 12 first words of values, cells and lists, 3 integers
//   15   places, L times 3 floats, from low
//   then values over gain, for each probe {words} words of two half floats, the low half first
//   then for each cell, x fastest, where its list begins, and where the last one ends; then the lists, a probe a word
//
// It is a storage buffer, unless WLM_PROBE_LIGHT(i) is defined before this file as another way to read word i.

#ifndef WLM_PROBE_LIGHT
#ifndef WLM_PROBE_LIGHT_BINDING
#define WLM_PROBE_LIGHT_BINDING 0
#endif
layout(std430, binding = WLM_PROBE_LIGHT_BINDING) readonly buffer WlmProbeLight
{{
    uint wlm_probe_light[];
}};
#define WLM_PROBE_LIGHT(i) wlm_probe_light[i]
#endif

const int WLM_PROBE_OUTPUTS = {outputs};
const int WLM_PROBE_WORDS = {words};
const int WLM_PROBE_TAKEN = {taken};
const int WLM_PROBE_ASKED = {asked};

float wlm_probe_float(int word)
{{
    return uintBitsToFloat(WLM_PROBE_LIGHT(word));
}}

vec3 wlm_probe_vec3(int word)
{{
    return vec3(wlm_probe_float(word), wlm_probe_float(word + 1), wlm_probe_float(word + 2));
}}

float wlm_probe_apart(vec3 a, vec3 b)
{{
    vec3 d = a - b;
    return sqrt(dot(d, d));
}}

// Puts the probes of a cell among the nearest.
void wlm_probe_look(int cell, vec3 x, inout int probe[WLM_PROBE_ASKED], inout float away[WLM_PROBE_ASKED])
{{
    int first = int(WLM_PROBE_LIGHT(int(WLM_PROBE_LIGHT(13)) + cell));
    int last = int(WLM_PROBE_LIGHT(int(WLM_PROBE_LIGHT(13)) + cell + 1));
    for (int i = first; i < last; ++i) {{
        int candidate = int(WLM_PROBE_LIGHT(int(WLM_PROBE_LIGHT(14)) + i));
        float d = wlm_probe_apart(x, wlm_probe_vec3({head} + 3 * candidate));
        if (d < away[WLM_PROBE_ASKED - 1]) {{
            away[WLM_PROBE_ASKED - 1] = d;
            probe[WLM_PROBE_ASKED - 1] = candidate;
            for (int k = WLM_PROBE_ASKED - 1; k > 0 && away[k > 0 ? k - 1 : 0] > d; --k) {{
                away[k] = away[k - 1];
                probe[k] = probe[k - 1];
                away[k - 1] = d;
                probe[k - 1] = candidate;
            }}
        }}
    }}
}}

// The nearest probes of a point x of the box, from low, and their distances: shell by shell of cells, until none left
// can have a nearer probe.
void wlm_probe_nearest(vec3 x, out int probe[WLM_PROBE_ASKED], out float away[WLM_PROBE_ASKED])
{{
    for (int k = 0; k < WLM_PROBE_ASKED; ++k) {{
        probe[k] = 0;
        away[k] = 3.0e38;
    }}
    float side = wlm_probe_float(6);
    int nx = int(WLM_PROBE_LIGHT(7));
    int ny = int(WLM_PROBE_LIGHT(8));
    int nz = int(WLM_PROBE_LIGHT(9));
    int cx = min(int(x.x / side), nx - 1);
    int cy = min(int(x.y / side), ny - 1);
    int cz = min(int(x.z / side), nz - 1);
    for (int r = 0; r < nx + ny + nz && away[WLM_PROBE_ASKED - 1] > float(r - 1) * side; ++r)
        for (int k = -r; k <= r; ++k)
            for (int j = -r; j <= r; ++j) {{
                bool within = k > -r && k < r && j > -r && j < r;
                for (int i = -r; i <= r; i += within ? 2 * r : 1) {{
                    int cell = ((cz + k) * ny + cy + j) * nx + cx + i;
                    if (cx + i >= 0 && cx + i < nx && cy + j >= 0 && cy + j < ny && cz + k >= 0 && cz + k < nz)
                        wlm_probe_look(cell, x, probe, away);
                }}
            }}
}}

// How much of each of the nearest probes the light at x takes: a Cholesky factor and two right sides.
void wlm_probe_weights(vec3 x, out int probe[WLM_PROBE_ASKED], out float weight[WLM_PROBE_TAKEN])
{{
    float away[WLM_PROBE_ASKED];
    wlm_probe_nearest(x, probe, away);
    float reach = away[WLM_PROBE_ASKED - 1] * {few};
    if (reach <= 0.0)
        reach = 1.0;
    float factor[WLM_PROBE_TAKEN * WLM_PROBE_TAKEN];
    float light[WLM_PROBE_TAKEN];
    float one[WLM_PROBE_TAKEN];
    for (int i = 0; i < WLM_PROBE_TAKEN; ++i) {{
        vec3 place = wlm_probe_vec3({head} + 3 * probe[i]);
        float t = away[i] / reach;
        light[i] = {sill} - t;
        one[i] = 1.0;
        for (int j = 0; j <= i; ++j) {{
            float sum = {sill} - wlm_probe_apart(place, wlm_probe_vec3({head} + 3 * probe[j])) / reach;
            if (i == j)
                sum += {taper} * t * t * t * t / max(1.0 - t * t, {slight}) + {slight};
            for (int k = 0; k < j; ++k)
                sum -= factor[i * WLM_PROBE_TAKEN + k] * factor[j * WLM_PROBE_TAKEN + k];
            if (i == j)
                factor[i * WLM_PROBE_TAKEN + j] = sqrt(max(sum, {slight}));
            else
                factor[i * WLM_PROBE_TAKEN + j] = sum / factor[j * WLM_PROBE_TAKEN + j];
        }}
        for (int k = 0; k < i; ++k) {{
            light[i] -= factor[i * WLM_PROBE_TAKEN + k] * light[k];
            one[i] -= factor[i * WLM_PROBE_TAKEN + k] * one[k];
        }}
        light[i] /= factor[i * WLM_PROBE_TAKEN + i];
        one[i] /= factor[i * WLM_PROBE_TAKEN + i];
    }}
    float sumLight = 0.0;
    float sumOne = 0.0;
    for (int i = WLM_PROBE_TAKEN - 1; i >= 0; --i) {{
        for (int k = i + 1; k < WLM_PROBE_TAKEN; ++k) {{
            light[i] -= factor[k * WLM_PROBE_TAKEN + i] * light[k];
            one[i] -= factor[k * WLM_PROBE_TAKEN + i] * one[k];
        }}
        light[i] /= factor[i * WLM_PROBE_TAKEN + i];
        one[i] /= factor[i * WLM_PROBE_TAKEN + i];
        sumLight += light[i];
        sumOne += one[i];
    }}
    for (int i = 0; i < WLM_PROBE_TAKEN; ++i)
        weight[i] = light[i] + one[i] * (1.0 - sumLight) / sumOne;
}}

// Number c of a stored probe.
float wlm_probe_number(int probe, int c)
{{
    vec2 pair = unpackHalf2x16(WLM_PROBE_LIGHT(int(WLM_PROBE_LIGHT(12)) + probe * WLM_PROBE_WORDS + c / 2));
    return wlm_probe_float(11) * (c % 2 == 0 ? pair.x : pair.y);
}}

// A position of the scene from low; outside the live probes' box its nearest point. Far from the scene's origin the
// engine does the same in doubles.
vec3 wlm_probe_place(vec3 position)
{{
    return clamp(position - wlm_probe_vec3(0), vec3(0.0, 0.0, 0.0), wlm_probe_vec3(3));
}}

// The numbers of the light at a place.
void wlm_probe_values(vec3 x, out float values[WLM_PROBE_OUTPUTS])
{{
    int probe[WLM_PROBE_ASKED];
    float weight[WLM_PROBE_TAKEN];
    wlm_probe_weights(x, probe, weight);
    for (int c = 0; c < WLM_PROBE_OUTPUTS; ++c) {{
        values[c] = 0.0;
        for (int i = 0; i < WLM_PROBE_TAKEN; ++i)
            values[c] += weight[i] * wlm_probe_number(probe[i], c);
    }}
}}
"""


def transform_glsl(live: int, outputs: int) -> str:
    """The shader text for so many live probes (its text is the same from 13 on) of so many numbers."""
    taken, asked = min(NEIGHBOURS, live), min(NEIGHBOURS + 1, live)
    text = _TEMPLATE.format(
        outputs=outputs,
        words=_words(outputs),
        taken=taken,
        asked=asked,
        head=HEAD_WORDS,
        few=1.0 if asked > taken else FEW,
        sill=SILL,
        taper=TAPER,
        slight=f"{SLIGHT:.8f}",
    )
    coefficients = sh_count(outputs)
    return text if coefficients is None else text + SH.format(coefficients=coefficients)


def light_bytes(model: TransformModel, place: np.ndarray, values: np.ndarray) -> tuple[bytes, dict[str, Any]]:
    """What `light.bin` holds, and its numbers for `probe.json`.

    Args:
        model: The model.
        place: float64 [L, 3], of the live probes.
        values: float32 [L, D], theirs.

    Raises:
        WlmError: The probes' box has no floats.
    """
    low = place.min(0)
    inside = place - low
    size = inside.max(0)
    with np.errstate(over="ignore", under="ignore"):
        head = np.array([*low, *size], np.float32)
    if not np.isfinite(head).all() or (size.max() > 0 and not head[3:].max() > 1e-30):
        raise WlmError(f"{model.name}: cannot export: the probes' box is too large or too small for floats")
    side, cells, start, item = _cells(inside, size)
    gain = float(np.abs(values).max()) or 1.0
    halves = np.zeros((len(place), 2 * _words(model.outputs)), "<f2")
    halves[:, : model.outputs] = values / gain
    at_values = HEAD_WORDS + 3 * len(place)
    at_cells = at_values + len(place) * _words(model.outputs)
    content = b"".join(
        [
            head.astype("<f4").tobytes(),
            np.array([side], "<f4").tobytes(),
            np.array([*cells, len(place)], "<u4").tobytes(),
            np.array([gain], "<f4").tobytes(),
            np.array([at_values, at_cells, at_cells + len(start)], "<u4").tobytes(),
            inside.astype("<f4").tobytes(),
            halves.tobytes(),
            start.astype("<u4").tobytes(),
            item.astype("<u4").tobytes(),
        ]
    )
    numbers = {"low": low.tolist(), "size": size.tolist(), "side": side, "cells": cells.tolist(), "gain": gain}
    return content, numbers


def transform_document(model: TransformModel, live: int, numbers: dict[str, Any]) -> dict[str, Any]:
    """What `probe.json` says of a transform, but for its kind and version."""
    return {
        "about": ABOUT,
        "name": model.name,
        "source": model.source,
        "probes": model.probes,
        "live": live,
        "outputs": model.outputs,
        "coefficients": sh_count(model.outputs),
        "convention": CANONICAL,
        "neighbours": min(NEIGHBOURS, live),
        "sill": SILL,
        "taper": TAPER,
        "slight": SLIGHT,
        **numbers,
        "dead": np.flatnonzero(model.dead).tolist(),
    }


def _words(outputs: int) -> int:
    return -(-outputs // 2)


def _cells(inside: np.ndarray, size: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
    """Side of the cells, their counts [3], where each one's probes begin, and the probes cell by cell."""
    longest = float(size.max()) or 1.0
    most = max(1, round(len(inside) / _PROBES_A_CELL))
    along = 1
    while along < _MOST_CELLS and np.maximum(np.ceil(size / longest * (along + 1)), 1).prod() <= most:
        along += 1
    # A little more than the box: the last cell ends behind it.
    side = longest / along * (1.0 + 1e-6)
    cells = np.maximum(np.ceil(size / side), 1).astype(int)
    x, y, z = np.minimum((inside / side).astype(int), cells - 1).T
    number = (z * cells[1] + y) * cells[0] + x
    start = np.concatenate([[0], np.cumsum(np.bincount(number, minlength=cells.prod()))])
    return side, cells, start, np.argsort(number, kind="stable")
