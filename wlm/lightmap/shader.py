"""Generates the GLSL that decodes a lightmap from the textures and buffers of its bundle (`wlm.lightmap.bundle`)."""

from wlm.bundle import sampler
from wlm.lightmap.encodings.base import columns
from wlm.lightmap.encodings.maps import fours
from wlm.lightmap.model import SheetModel
from wlm.lightmap.tiles import TILE
from wlm.texels import REACH

EXACT = "WLM_LIGHTMAP_EXACT"
"""Macro that makes the shader interpolate texels in float32 instead of with the GPU's texture filter."""

GROUP_SIZE = (32, 8)
"""Columns and rows of such a group; both divide a tile's side."""

GROUP = "WLM_LIGHTMAP_GROUP"
"""Macro for compute shaders, whose groups of invocations share the network of a tile."""

GROUP_SIZE = (32, 8)
"""Columns and rows of such a group; both divide a tile's side."""

HEAD = 2
"""Groups of four floats before the records of the tiles in the table of an hour."""

_GELU = {
    "exact": """\
// x Phi(x). erf as in Abramowitz and Stegun, Handbook of Mathematical Functions, 7.1.26: within 1.5e-7, which leaves
// GELU within 2.2e-7.
vec4 wlm_gelu(vec4 x)
{
    vec4 z = abs(x) * 0.70710678;
    vec4 t = 1.0 / (1.0 + 0.3275911 * z);
    vec4 p = t * (0.254829592 + t * (-0.284496736 + t * (1.421413741 + t * (-1.453152027 + t * 1.061405429))));
    return 0.5 * x * (1.0 + sign(x) * (1.0 - p * exp(-1.0 * z * z)));
}
""",
    "tanh": """\
// The tanh form of GELU, which the model was trained with, as x / (1 + exp(-2 z)), since the tanh of drivers takes
// several times as long; within 4.8e-4 of the exact form.
vec4 wlm_gelu(vec4 x)
{
    vec4 z = x * (-2.3022082 - 0.10294324 * x * x); // for powers of 2, which end before a float overflows
    return x / (1.0 + exp2(min(z, vec4(80.0, 80.0, 80.0, 80.0))));
}
""",
}

_HEAD = """\
// Decodes a temporal lightmap: feature maps and a small network for each tile of 128 x 128 texels (Neural Dynamic GI,
// sections 3.2 to 3.4). For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES
// below `precision highp` of float, int, sampler2D and sampler2DArray.
//
// For each stored hour that is needed: bind the table of the hour, draw the map into a texture of linear light with
// {last}(texel), and draw that one into another, each texel from wlm_source(texel), which fills the gaps between
// charts that a filter reads at their edges. Materials mix two of these by the time between both hours (eq. 2).
//
// Textures; row 0 is v = 0. Filters are linear, without mip levels.
{textures}//
// If WLM_LIGHTMAP_EXACT is defined, four texels are fetched and mixed in floats; otherwise the filter unit mixes four
// texels, with about 8 bits for a position between two of them.
//
{group}// wlm_lightmap_four(i) and wlm_lightmap_entry(i) read four floats of networks and of the table: if these are in
// buffers change them, or define WLM_LIGHTMAP_NET(i) and WLM_LIGHTMAP_HOUR_AT(i) before this file.

{samplers}{reads}
const int WLM_LIGHTMAP_COLUMNS = {columns}; // tiles in a row of the map
const int WLM_LIGHTMAP_RECORD = {record}; // fours of a tile in the table, after {head} of all
"""

_ABOUT_GROUP = """\
// Compute shaders decode faster with WLM_LIGHTMAP_GROUP defined, in groups of {columns} x {rows} texels of one tile
// (wlm_lightmap_begin), which keep the network of the tile in {kilobytes} KB of shared memory.
//
"""

_TEXTURES = {
    "hour": ("sampler2D", "the hour's floats of hours.bin, RGBA32F, 1024 a row; fetched"),
    "networks": ("sampler2D", "networks.bin, RGBA32F, 1024 a row; fetched"),
    "uv": ("sampler2D", "uv.dds, BC7, {TILE} x {TILE} texels a tile; fetched"),
    "uvt": ("sampler2D", "uvt.dds, BC7, {side} x {side} texels for each of {slices} slices of a tile; filtered"),
    "planes": ("sampler2D", "planes.dds, RG8, {plane_columns} x {plane_rows} texels twice a tile; filtered"),
    "frames": ("sampler2DArray", "frames.dds, BC7, a layer for each stored time; fetched"),
    "valid": ("sampler2D", "valid.png, R8, {width} x {height}, white inside charts; fetched"),
}

_READ = """
#ifndef {macro}
#define {macro}(i) texelFetch({texture}, ivec2((i) & 1023, (i) >> 10), 0)
#endif

vec4 {function}(int i)
{{
    return {macro}(i);
}}
"""

_NETWORK = """
const int WLM_LIGHTMAP_FOURS = {fours}; // of {hidden} units

{gelu}
#ifdef WLM_LIGHTMAP_GROUP
shared vec4 wlm_lightmap_weights[{weights}];
#endif

// Four floats of a network: of the group's tile, or of all networks.
vec4 wlm_lightmap_weight(int i)
{{
#ifdef WLM_LIGHTMAP_GROUP
    return wlm_lightmap_weights[i];
#else
    return wlm_lightmap_four(i);
#endif
}}

// b + x W, where the rows of W are `apart` groups of four apart.
vec4 wlm_lightmap_add(vec4 b, vec4 x, int at, int apart)
{{
    vec4 sum = b + x.x * wlm_lightmap_weight(at) + x.y * wlm_lightmap_weight(at + apart);
    return sum + x.z * wlm_lightmap_weight(at + 2 * apart) + x.w * wlm_lightmap_weight(at + 3 * apart);
}}

// Colour of a tile of maps: `record` is the position of its record, `inner` the texel in the tile. G of eq. 4 has two
// hidden layers. Four units of the first at a time are added to the second, whose array has constant indices, so that
// it is in registers.
vec3 wlm_lightmap_mapped(vec4 tile, int record, ivec2 inner)
{{
    int row = int(tile.y);
#ifdef WLM_LIGHTMAP_GROUP
    int start = 0;
#else
    int start = int(tile.z);
#endif
    int second = start + 5 * WLM_LIGHTMAP_FOURS;
    ivec2 at = ivec2(row % {uv_columns}, row / {uv_columns}) * {TILE} + inner;
    vec4 uv = texelFetch(WLM_LIGHTMAP_UV, at, 0);
{inputs}    int third = second + (4 * WLM_LIGHTMAP_FOURS + 1) * WLM_LIGHTMAP_FOURS;
    vec4 b[WLM_LIGHTMAP_FOURS];
{biases}    for (int i = 0; i < WLM_LIGHTMAP_FOURS; i++) {{
        vec4 a = wlm_lightmap_add(wlm_lightmap_entry(record + 3 + i), uv, start + i, WLM_LIGHTMAP_FOURS);
{sums}        a = wlm_gelu(a);
        int w = second + 4 * WLM_LIGHTMAP_FOURS * i;
{products}    }}
    vec4 y = wlm_lightmap_weight(third + 4 * WLM_LIGHTMAP_FOURS);
{outputs}    vec3 gain = wlm_lightmap_entry(record + 1).xyz;
    return max(gain + wlm_lightmap_entry(record + 2).xyz * y.xyz, vec3(0.0, 0.0, 0.0));
}}
"""
_UNITS = {
    "biases": "    b[{j}] = wlm_lightmap_weight(third - WLM_LIGHTMAP_FOURS + {j});\n",
    "products": "        b[{j}] = wlm_lightmap_add(b[{j}], a, w + {j}, WLM_LIGHTMAP_FOURS);\n",
    "outputs": "    y = wlm_lightmap_add(y, wlm_gelu(b[{j}]), third + {at}, 1);\n",
}
"""Lines of the network for each four units of the second layer."""

_INPUTS = """\
    vec4 uvt = vec4(0.0, 0.0, 0.0, 0.0);
    vec4 planes = uvt;
    bool dynamic = int(tile.x) == 2;
    if (dynamic) {{
        vec2 place = (vec2(inner) + vec2(0.5, 0.5)) / {TILE}.0;
        uvt = wlm_lightmap_volume(row, place);
        planes = vec4(wlm_lightmap_plane(2 * row, place.x), wlm_lightmap_plane(2 * row + 1, place.y));
        // The encoded time is in the bias.
        second = start + 17 * WLM_LIGHTMAP_FOURS;
    }}
"""

_SUMS = """\
        if (dynamic) {
            a = wlm_lightmap_add(a, uvt, start + 4 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
            a = wlm_lightmap_add(a, planes, start + 8 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
        }
"""

_MAPS = """
const int WLM_LIGHTMAP_SIDE = {side}; // texels of a slice of F_uvt along a side

// A slice of F_uvt at a place in its texels; texel i has its centre at i + 1/2.
vec4 wlm_lightmap_slice(int image, vec2 place)
{{
    ivec2 first = ivec2(image % {uvt_columns}, image / {uvt_columns}) * WLM_LIGHTMAP_SIDE;
    vec2 inside = clamp(place, vec2(0.5, 0.5), vec2({side}.0, {side}.0) - vec2(0.5, 0.5));
#ifdef WLM_LIGHTMAP_EXACT
    inside = inside - vec2(0.5, 0.5);
    ivec2 low = ivec2(floor(inside));
    ivec2 high = min(low + ivec2(1, 1), ivec2(WLM_LIGHTMAP_SIDE - 1, WLM_LIGHTMAP_SIDE - 1));
    vec2 share = inside - vec2(low);
    vec4 a = texelFetch(WLM_LIGHTMAP_UVT, first + low, 0);
    vec4 b = texelFetch(WLM_LIGHTMAP_UVT, first + ivec2(high.x, low.y), 0);
    vec4 c = texelFetch(WLM_LIGHTMAP_UVT, first + ivec2(low.x, high.y), 0);
    vec4 d = texelFetch(WLM_LIGHTMAP_UVT, first + high, 0);
    return mix(mix(a, b, share.x), mix(c, d, share.x), share.y);
#else
    return textureLod(WLM_LIGHTMAP_UVT, (vec2(first) + inside) / vec2({uvt_width}.0, {uvt_height}.0), 0.0);
#endif
}}

// F_uvt at the table's hour, at a place from 0 to 1.
vec4 wlm_lightmap_volume(int row, vec2 place)
{{
    vec4 time = wlm_lightmap_entry(0);
    vec2 texel = place * {side}.0;
    vec4 early = wlm_lightmap_slice(row * {slices} + int(time.x), texel);
    return mix(early, wlm_lightmap_slice(row * {slices} + int(time.y), texel), time.z);
}}

// F_ut (an even image) or F_vt (an odd one) at a row of time.
vec2 wlm_lightmap_line(int image, float place, int time)
{{
    ivec2 first = ivec2(image % {plane_across} * {plane_columns}, image / {plane_across} * {plane_rows} + time);
    float inside = clamp(place * {plane_columns}.0, 0.5, {plane_columns}.0 - 0.5);
#ifdef WLM_LIGHTMAP_EXACT
    inside = inside - 0.5;
    int low = int(floor(inside));
    vec4 a = texelFetch(WLM_LIGHTMAP_PLANES, first + ivec2(low, 0), 0);
    vec4 b = texelFetch(WLM_LIGHTMAP_PLANES, first + ivec2(min(low + 1, {plane_columns} - 1), 0), 0);
    return mix(a.xy, b.xy, inside - float(low));
#else
    vec2 at = vec2(first) + vec2(inside, 0.5);
    return textureLod(WLM_LIGHTMAP_PLANES, at / vec2({planes_width}.0, {planes_height}.0), 0.0).xy;
#endif
}}

vec2 wlm_lightmap_plane(int image, float place)
{{
    vec4 time = wlm_lightmap_entry(1);
    vec2 early = wlm_lightmap_line(image, place, int(time.x));
    return mix(early, wlm_lightmap_line(image, place, int(time.y)), time.z);
}}
"""

_FRAMES = """
// Colour of a tile of frames in the first (1) or second (3) frame of its record.
vec3 wlm_lightmap_of_frames(vec4 tile, int record, ivec2 inner)
{{
    int row = int(tile.y);
    vec4 least = wlm_lightmap_entry(record);
    ivec2 at = ivec2(row % {frames_columns}, row / {frames_columns}) * {TILE} + inner;
    vec3 level = texelFetch(WLM_LIGHTMAP_FRAMES, ivec3(at, int(least.w)), 0).xyz;
    return mix(least.xyz, wlm_lightmap_entry(record + 1).xyz, level);
}}
"""

_COLOUR = """
// Colour of a texel of the map in gamma space, at least 0; of an empty tile 0.
vec3 wlm_colour(ivec2 texel)
{{
    ivec2 place = texel / {TILE};
    ivec2 inner = texel - place * {TILE};
    int record = {head} + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD;
    vec4 tile = wlm_lightmap_entry(record);
{kinds}    return wlm_lightmap_entry(record + 1).xyz;
}}
"""

_BEGIN = """
#ifdef WLM_LIGHTMAP_GROUP
// Shares the network of a tile in a group of {invocations} invocations. Each calls it once, with a texel of the tile,
// the same for all, and its own index, and then decodes texels of this tile only.
void wlm_lightmap_begin(ivec2 texel, int index)
{{
    ivec2 place = texel / {TILE};
    vec4 tile = wlm_lightmap_entry({head} + (place.y * WLM_LIGHTMAP_COLUMNS + place.x) * WLM_LIGHTMAP_RECORD);
    int kind = int(tile.x);
    int count = kind == 1 ? {static} : kind == 2 ? {weights} : 0;
    for (int i = index; i < count; i += {invocations})
        wlm_lightmap_weights[i] = wlm_lightmap_four(int(tile.z) + i);
    barrier();
}}
#endif
"""

_MAPPED_KIND = """\
    if (int(tile.x) == 1 || int(tile.x) == 2)
        return wlm_lightmap_mapped(tile, record, inner);
"""

_FRAMES_KIND = """\
    if (int(tile.x) == 3) {{
        vec3 early = wlm_lightmap_of_frames(tile, record + 1, inner);
        if (tile.w == 0.0)
            return early;
        // Radiance is mixed, even if networks interpolate.
        vec3 late = wlm_lightmap_of_frames(tile, record + 3, inner);
        vec3 light = mix(pow(early, {gamma}), pow(late, {gamma}), tile.w);
        return pow(light, {inverse});
    }}
"""

_SOURCE = """
// The texel whose light a texel of the map shows: itself inside a chart; in a gap the nearest inside within {reach}
// texels, in reading order of several as near; beyond that itself.
ivec2 wlm_source(ivec2 texel)
{{
    if (texelFetch(WLM_LIGHTMAP_VALID, texel, 0).x > 0.5)
        return texel;
    ivec2 found = texel;
    int least = {beyond};
    for (int y = -{reach}; y <= {reach}; y++)
        for (int x = -{reach}; x <= {reach}; x++) {{
            ivec2 at = texel + ivec2(x, y);
            if (x * x + y * y < least && at.x >= 0 && at.y >= 0 && at.x < {width} && at.y < {height}) {{
                if (texelFetch(WLM_LIGHTMAP_VALID, at, 0).x > 0.5) {{
                    least = x * x + y * y;
                    found = at;
                }}
            }}
        }}
    return found;
}}
"""

_RADIANCE = """
// Linear radiance of a texel of the map, at most 65504: a target of half floats would make more infinite.
vec3 wlm_radiance(ivec2 texel)
{{
    return min(pow(wlm_colour(texel), {gamma}), vec3(65504.0, 65504.0, 65504.0));
}}
"""

_VALUES = """
// The values of a texel of the map, which has no gamma: levels from 0 to 1. They mix as radiance does.
vec3 wlm_value(ivec2 texel)
{{
    return vec3({least}, {least}, {least}) + {span} * wlm_colour(texel);
}}
"""


def record_fours(model: SheetModel) -> int:
    """Returns the number of groups of four floats in a tile's record, see `wlm.lightmap.bundle.hour_tables`."""
    return 3 + max(fours(model.profile), 2)


def texture_names(model: SheetModel) -> list[str]:
    """Returns the names of the textures that the shader of a sheet reads, in the order of their declarations."""
    maps, dynamic = bool(len(model.uv)), bool(len(model.uvt))
    needed = {"networks": maps, "uv": maps, "uvt": dynamic, "planes": dynamic, "frames": bool(len(model.frames))}
    return [name for name in _TEXTURES if needed.get(name, True)]


def decode_glsl(model: SheetModel, values: tuple[float, float] | None = None) -> str:
    """Returns the shader of a sheet: functions to be included below `#version`.

    Args:
        model: The sheet; the shader depends on its settings and on the kinds of its tiles.
        values: Range to which decoded levels from 0 to 1 are mapped if the sheet is not light; None: it is radiance.

    Returns:
        Source for GLSL 3.30 and GLSL ES 3.00; it also compiles for Vulkan if the bindings are defined.
    """
    profile, names = model.profile, texture_names(model)
    dynamic = len(model.uvt)
    side, slices = profile.uvt_resolution, profile.uvt_slices
    across = {
        "uv": columns(len(model.uv), TILE, TILE),
        "uvt": columns(dynamic * slices, side, side),
        "planes": columns(2 * dynamic, profile.plane_rows, profile.plane_columns),
        "frames": columns(len(model.frames), TILE, TILE),
    }
    wide = fours(profile)
    rest = (4 * wide + 6) * wide + 1  # fours of a network after the weights of its first layer
    weights = (16 if dynamic else 4) * wide + rest
    gamma, inverse = (", ".join([repr(float(number))] * 3) for number in (profile.gamma, 1.0 / profile.gamma))
    words = {
        "TILE": TILE,
        "width": model.width,
        "height": model.height,
        "columns": model.grid.cols,
        "record": record_fours(model),
        "head": HEAD,
        "fours": wide,
        "hidden": profile.hidden,
        "side": side,
        "slices": slices,
        "plane_columns": profile.plane_columns,
        "plane_rows": profile.plane_rows,
        "uv_columns": across["uv"],
        "uvt_columns": across["uvt"],
        "plane_across": across["planes"],
        "frames_columns": across["frames"],
        "uvt_width": across["uvt"] * side,
        "uvt_height": -(-dynamic * slices // across["uvt"]) * side,
        "planes_width": across["planes"] * profile.plane_columns,
        "planes_height": -(-2 * dynamic // across["planes"]) * profile.plane_rows,
        "reach": REACH,
        "beyond": 2 * REACH * REACH + 1,
        "static": 4 * wide + rest,
        "weights": weights,
        "invocations": GROUP_SIZE[0] * GROUP_SIZE[1],
        # repr gives the shortest decimals that are the number again, and always a point or an exponent.
        "gamma": f"vec3({gamma})",
        "inverse": f"vec3({inverse})",
    }
    mapped = "networks" in names
    kinds, images = _MAPPED_KIND if mapped else "", ""
    if "frames" in names:
        kinds, images = kinds + _FRAMES_KIND.format(**words), _FRAMES.format(**words)
    group = ""
    if mapped:
        kilobytes = f"{16 * words['weights'] / 1024:.0f}"
        group = _ABOUT_GROUP.format(columns=GROUP_SIZE[0], rows=GROUP_SIZE[1], kilobytes=kilobytes)
    text = _head(names, words | {"last": "wlm_radiance" if values is None else "wlm_value", "group": group})
    if "uvt" in names:
        text += _MAPS.format(**words)
    if mapped:
        units = {name: "".join(line.format(j=j, at=4 * j) for j in range(wide)) for name, line in _UNITS.items()}
        inputs, sums = (_INPUTS.format(**words), _SUMS) if "uvt" in names else ("", "")
        text += _NETWORK.format(gelu=_GELU[profile.gelu], inputs=inputs, sums=sums, **units, **words) + _BEGIN.format(
            **words
        )
    text += images + _COLOUR.format(kinds=kinds, **words) + _SOURCE.format(**words)
    if values is None:
        return text + _RADIANCE.format(**words)
    return text + _VALUES.format(least=repr(values[0]), span=repr(values[1] - values[0]))


def _head(names: list[str], words: dict[str, object]) -> str:
    lines = [f"//   wlm_lightmap_{name}: {_TEXTURES[name][1].format(**words)}.\n" for name in names]
    reads = "".join(
        _READ.format(macro=macro, function=function, texture=f"WLM_LIGHTMAP_{name.upper()}")
        for macro, function, name in (
            ("WLM_LIGHTMAP_HOUR_AT", "wlm_lightmap_entry", "hour"),
            ("WLM_LIGHTMAP_NET", "wlm_lightmap_four", "networks"),
        )
        if name in names
    )
    return _HEAD.format(
        textures="".join(lines),
        samplers="".join(sampler(f"wlm_lightmap_{name}", _TEXTURES[name][0]) for name in names),
        reads=reads,
        **words,
    )
