"""The GLSL that reads a scene's exported lightmaps; `wlm.atlas.scene.exporter` writes it."""

from wlm.atlas.model import SIDE_BITS
from wlm.atlas.scene.model import SceneModel

_TEXT = """\
// Light from the compressed lightmaps of a scene: each tile of each lightmap is a rectangle of a texture array, found
// by one table. For GLSL 3.30 and later; include it below #version.
//
// wlm_scene_lut: lut.dds, usampler2D, filter nearest.
// wlm_scene_colour: colour_0.dds and so on as the layers of a sampler2DArray, filter linear, clamped to its edge.
// wlm_scene_factor: one row of `factors` of report.json for each component; between two states they are mixed.
//
// Call wlm_scene with the lightmap's UVs, u to the right, v down, after the object's scale and offset, and the row of
// `sheets` of report.json that the object reads: its texels (x, y), its first entry (x, y), its tiles (x, y), its page.

uniform usampler2D wlm_scene_lut;
uniform sampler2DArray wlm_scene_colour;
uniform vec3 wlm_scene_factor[{components}];

const float WLM_SCENE_TILE = {tile}.0; // texels of a lightmap along a tile

vec3 wlm_scene(vec2 uv, vec2 size, ivec2 origin, ivec2 tiles, int page)
{{
    // Tiles begin and end on centres of the lightmap's texels.
    vec2 x = clamp(uv * size - vec2(0.5), vec2(0.0), size - vec2(1.0)) / WLM_SCENE_TILE;
    ivec2 tile = min(ivec2(floor(x)), tiles - ivec2(1));
    uvec2 entry = texelFetch(wlm_scene_lut, origin + tile, 0).xy;
    // An entry is the first texel of the tile's rectangle, and in the low bits its texels less one.
    vec2 place = vec2(entry >> {bits}u) + (x - vec2(tile)) * vec2(entry & uvec2({mask}u)) + vec2(0.5);
    place /= vec2(textureSize(wlm_scene_colour, 0).xy);
    vec3 light = vec3(0.0);
    for (int k = 0; k < {components}; k++)
    {{
        vec3 at = vec3(place, float(page * {components} + k));
        light += wlm_scene_factor[k] * textureLod(wlm_scene_colour, at, 0.0).rgb;
    }}
    return light;
}}
"""


def scene_glsl(model: SceneModel) -> str:
    """The shader text for a model: a function alone, to be included below `#version`."""
    bits = {"bits": SIDE_BITS, "mask": (1 << SIDE_BITS) - 1}
    return _TEXT.format(components=model.factor.shape[1], tile=model.profile.tile, **bits)
