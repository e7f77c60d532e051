"""The GLSL that reads an exported atlas (lightmap-uv-clustering-cascade, eq. 7); `wlm.atlas.exporter` writes it."""

from wlm.atlas.model import BLOCK_SIDE, FIRST_BLOCK_CODE, SIDE_BITS, TAIL_OCTAVES, AtlasModel
from wlm.bundle import sampler

EXACT = "WLM_ATLAS_EXACT"
"""Macro that has texels fetched and mixed in floats."""

_HEAD = """\
// Light from a compressed lightmap: {what}
// (Lightmap Compression with Color-Coherent UV Clustering and Cascade Texture Optimization, eq. 7).
// For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES below the precisions
// of what it declares. Call wlm_atlas with {coordinate}: u to the right, v down, (0, 0) at the first row's first texel.
//
{textures}
// {mips} have one mip level. Where WLM_ATLAS_EXACT is defined four texels are fetched and mixed in floats; else the
// sampler mixes four texels, in one fetch, with the 8 or so bits that a GPU gives to a place between two of them.

"""

_GRAD = """
{comment}
vec3 wlm_atlas_grad({parameters}, vec2 dx, vec2 dy)
{{
    vec2 size = vec2({width}.0, {height}.0); // of the lightmap, in texels
    float texels = max(length(dx * size), length(dy * size)); // along the pixel
    // A bilinear read still meets all texels where a pixel is two of them.
    float share = log2(max(texels, 1.0)) - {octaves}.0;
    if (share <= 0.0)
        return wlm_atlas(uv);
    // Of the tail the lightmap is the part that begins at its first texel: its sides are those of whole blocks.
    vec2 part = size / ({scale}.0 * vec2(textureSize(WLM_ATLAS_TAIL, 0)));
    vec3 far = textureGrad(WLM_ATLAS_TAIL, {own} * part, dx * part, dy * part).rgb;
    return share < 1.0 ? mix(wlm_atlas(uv), far, share) : far;
}}
"""

_NEAR = """\
// Light where a pixel is large: dx and dy are dFdx(uv) and dFdy(uv). Up close it is wlm_atlas(uv)."""
_NEAR_OWN = """\
// Light where a pixel is large: own is the lightmap's UVs as the mesh had them, beside the new ones, dx and dy are
// dFdx(own) and dFdy(own). Up close it is wlm_atlas(uv)."""

_TEXTURES = {
    "plain": "// colour: the small texture, sampler2D, filter linear, clamped to its edge.",
    "tiles": "// lut: the table of tiles, usampler2D, two unsigned integers an entry, filter nearest.",
    "mixed": "// blocks: the small texture's blocks, sampler2D, filter linear, clamped to its edge.",
    "tail": "// tail: smaller levels, sampler2D, filter linear, between mips too, clamped to its edge, anisotropic.",
    "cascade": "// lut: the table of coordinates, sampler2D, filter linear, clamped to its edge.",
}
"""Textures of each method, of colour "mixed" and of mips; all have that of "plain"."""

# Coordinates are in texels, so that arithmetic within a tile stays exact.
_READ = """
// The texture at a place in texels; texel i has its centre at i + 1/2.
{type} wlm_atlas_{name}_at(vec2 place)
{{
    ivec2 last = textureSize({image}, 0) - ivec2(1, 1);
#ifdef WLM_ATLAS_EXACT
    vec2 inside = clamp(place - vec2(0.5, 0.5), vec2(0.0, 0.0), vec2(last));
    ivec2 low = ivec2(floor(inside));
    ivec2 high = min(low + ivec2(1, 1), last);
    vec2 share = inside - vec2(low);
    vec4 top = mix(texelFetch({image}, low, 0), texelFetch({image}, ivec2(high.x, low.y), 0), share.x);
    vec4 bottom = mix(texelFetch({image}, ivec2(low.x, high.y), 0), texelFetch({image}, high, 0), share.x);
    return mix(top, bottom, share.y).{channels};
#else
    return textureLod({image}, place / vec2(last + ivec2(1, 1)), 0.0).{channels};
#endif
}}
"""

_TILES = """
const vec2 WLM_ATLAS_SIZE = vec2({width}.0, {height}.0); // of the lightmap, in texels
const float WLM_ATLAS_TILE = {tile}.0; // texels of the lightmap along a tile

vec3 wlm_atlas(vec2 uv)
{{
    // Tiles begin and end on centres of the lightmap's texels.
    vec2 x = clamp(uv * WLM_ATLAS_SIZE - vec2(0.5, 0.5), vec2(0.0, 0.0), WLM_ATLAS_SIZE - vec2(1.0, 1.0));
    x = x / WLM_ATLAS_TILE;
    ivec2 tile = min(ivec2(floor(x)), textureSize(WLM_ATLAS_LUT, 0) - ivec2(1, 1));
    uvec2 entry = texelFetch(WLM_ATLAS_LUT, tile, 0).xy;
    // An entry is the first texel of the tile's rectangle, and in the low bits its texels less one.
    uvec2 first = entry >> uvec2({bits}u, {bits}u);
    uvec2 steps = entry & uvec2({mask}u, {mask}u);
{blocks}    return wlm_atlas_colour_at(vec2(first) + (x - vec2(tile)) * vec2(steps) + vec2(0.5, 0.5));
}}
"""

_BLOCKS = """\
    if (steps.x >= {code}u) {{
        // Its first block, and from {code} on its blocks less one, of {side} texels a side.
        first *= {side}u;
        steps = (steps - uvec2({code}u, {code}u)) * {side}u + uvec2({last}u, {last}u);
        return wlm_atlas_blocks_at(vec2(first) + (x - vec2(tile)) * vec2(steps) + vec2(0.5, 0.5));
    }}
"""

_WHOLE_BLOCKS = """\
    // Both count blocks of {side} texels a side.
    first *= {side}u;
    steps = steps * {side}u + uvec2({last}u, {last}u);
"""

_CASCADE = """
vec3 wlm_atlas(vec2 uv)
{
    // The triangle wave of eq. 8 is the identity on what 16 bits without a sign hold.
    vec2 place = wlm_atlas_lut_at(uv * vec2(textureSize(WLM_ATLAS_LUT, 0)));
    return wlm_atlas_colour_at(place * vec2(textureSize(WLM_ATLAS_COLOUR, 0)));
}
"""

_PLAIN = """
vec3 wlm_atlas(vec2 uv)
{
    return wlm_atlas_colour_at(uv * vec2(textureSize(WLM_ATLAS_COLOUR, 0)));
}
"""

_WHAT = {
    "tiles": "each of its tiles is a rectangle of a small texture, found by a table",
    "cascade": "a table of coordinates leads into a small texture",
    "plain": "a smaller lightmap",
}


def atlas_glsl(model: AtlasModel) -> str:
    """The shader text for a model: functions alone, to be included below `#version`.

    Args:
        model: Its method chooses the text; of tiles the lightmap's size and the tile's are constants in it.

    Returns:
        GLSL 3.30, which Vulkan's dialect takes too where the bindings are defined.
    """
    tiles, cascade, mixed = model.method == "tiles", model.method == "cascade", model.colour == "mixed"
    kinds = ["plain", *(["mixed"] if mixed else []), *(["tail"] if len(model.tail) else []), model.method]
    textures = [_TEXTURES[kind] for kind in kinds]
    text = _HEAD.format(
        what=_WHAT[model.method],
        coordinate="the new UVs of mesh.glb" if len(model.uv) else "the mesh's own lightmap UVs",
        textures="\n".join(dict.fromkeys(textures)),
        mips="All but the tail" if len(model.tail) else "They",
    )
    text += sampler("wlm_atlas_colour", "sampler2D")
    if tiles or cascade:
        text += sampler("wlm_atlas_lut", "usampler2D" if tiles else "sampler2D")
    if mixed:
        text += sampler("wlm_atlas_blocks", "sampler2D")
    if len(model.tail):
        text += sampler("wlm_atlas_tail", "sampler2D")
    text += _READ.format(type="vec3", name="colour", image="WLM_ATLAS_COLOUR", channels="rgb")
    if mixed:
        text += _READ.format(type="vec3", name="blocks", image="WLM_ATLAS_BLOCKS", channels="rgb")
    body = _PLAIN
    if tiles:
        lines = _BLOCKS if mixed else "" if model.first_block_code else _WHOLE_BLOCKS
        blocks = lines.format(code=FIRST_BLOCK_CODE, side=BLOCK_SIDE, last=BLOCK_SIDE - 1)
        body = _TILES.format(
            width=model.width,
            height=model.height,
            tile=model.profile.tile,
            bits=SIDE_BITS,
            mask=(1 << SIDE_BITS) - 1,
            blocks=blocks,
        )
    elif cascade:
        body = _READ.format(type="vec2", name="lut", image="WLM_ATLAS_LUT", channels="xy") + _CASCADE
    if len(model.tail):
        names = ("vec2 uv, vec2 own", "own", _NEAR_OWN) if len(model.uv) else ("vec2 uv", "uv", _NEAR)
        body += _GRAD.format(
            **dict(zip(("parameters", "own", "comment"), names, strict=True)),
            width=model.width,
            height=model.height,
            scale=1 << TAIL_OCTAVES,
            octaves=TAIL_OCTAVES - 1,
        )
    return text + body
