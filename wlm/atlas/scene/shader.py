"""The GLSL that reads a scene's exported lightmaps; `wlm.atlas.scene.exporter` writes it."""

from wlm.atlas.model import SIDE_BITS
from wlm.atlas.scene.model import SceneModel
from wlm.shading import sampler

_TEXT = """\
// Light from the compressed lightmaps of a scene: each tile of each lightmap is a rectangle of a texture array, found
// by one table. For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES below
// the precisions of what it declares.
//
// wlm_scene_lut: lut.dds, usampler2D, filter nearest.
// wlm_scene_colour: colour_0.dds and so on as the layers of a sampler2DArray, filter linear, clamped to its edge.
// wlm_scene_factor: one row of `factors` of report.json for each component; between two states they are mixed. For a
// uniform block, or any other place, define WLM_SCENE_FACTOR(k) before this file as the k-th.
//
// Call wlm_scene with the lightmap's UVs, u to the right, v down, after the object's scale and offset, and the row of
// `sheets` of report.json that the object reads: its texels (x, y), its first entry (x, y), its tiles (x, y), its page.

{samplers}#ifndef WLM_SCENE_FACTOR
uniform vec3 wlm_scene_factor[{components}];
#define WLM_SCENE_FACTOR(k) wlm_scene_factor[k]
#endif

const float WLM_SCENE_TILE = {tile}.0; // texels of a lightmap along a tile

vec3 wlm_scene(vec2 uv, vec2 size, ivec2 origin, ivec2 tiles, int page)
{{
    // Tiles begin and end on centres of the lightmap's texels.
    vec2 x = clamp(uv * size - vec2(0.5, 0.5), vec2(0.0, 0.0), size - vec2(1.0, 1.0)) / WLM_SCENE_TILE;
    ivec2 tile = min(ivec2(floor(x)), tiles - ivec2(1, 1));
    uvec2 entry = texelFetch(WLM_SCENE_LUT, origin + tile, 0).xy;
    // An entry is the first texel of the tile's rectangle, and in the low bits its texels less one.
    vec2 first = vec2(entry >> uvec2({bits}u, {bits}u));
    vec2 steps = vec2(entry & uvec2({mask}u, {mask}u));
    vec2 place = (first + (x - vec2(tile)) * steps + vec2(0.5, 0.5)) / vec2({width}.0, {height}.0);
    vec3 light = vec3(0.0, 0.0, 0.0);
    for (int k = 0; k < {components}; k++) {{
        vec3 at = vec3(place, float(page * {components} + k));
        light += WLM_SCENE_FACTOR(k) * textureLod(WLM_SCENE_COLOUR, at, 0.0).rgb;
    }}
    return light;
}}
"""


def scene_glsl(model: SceneModel) -> str:
    """The shader text for a model: a function alone, to be included below `#version`."""
    bits = {"bits": SIDE_BITS, "mask": (1 << SIDE_BITS) - 1}
    height, width = model.texels.shape[1:]
    return _TEXT.format(
        components=model.factor.shape[1],
        tile=model.profile.tile,
        width=width,
        height=height,
        samplers=sampler("wlm_scene_lut", "usampler2D") + sampler("wlm_scene_colour", "sampler2DArray"),
        **bits,
    )
