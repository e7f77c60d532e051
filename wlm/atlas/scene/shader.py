"""The GLSL that reads a scene's exported lightmaps; `wlm.atlas.scene.exporter` writes it."""

from wlm.atlas.model import BLOCK_SIDE, FIRST_BLOCK_CODE, SIDE_BITS, TAIL_OCTAVES
from wlm.atlas.scene.model import COARSE_BITS, COUNT_BITS, MOST_COARSE, SHORT_ENTRY, SceneModel
from wlm.bundle import sampler

_TEXT = """\
// Light from the compressed lightmaps of a scene: each tile of each lightmap is a few rectangles of a texture array,
// found by one table. For GLSL 3.30, GLSL ES 3.00 and later, with or without Vulkan; include it below #version, in ES
// below the precisions of what it declares.
//
// wlm_scene_sheets: sheets.dds, usampler2D, filter nearest.
// wlm_scene_lut: lut.dds, usampler2D, filter nearest.
// wlm_scene_factors: factors.dds, sampler2D of 32-bit floats, filter nearest.
// wlm_scene_colour: colour_0.dds and so on as the layers of a sampler2DArray, filter linear, clamped to its edge; or
// colour.dds, which is all of them.
{second}//
// Call wlm_scene with the lightmap's UVs, u to the right, v down, after the object's scale and offset; the number of
// the sheet that the object reads; and the number of the state, 1.5 for example half-way from the second to the third.

{samplers}
const float WLM_SCENE_TILE = {tile}.0; // texels of a lightmap along a tile

vec3 {name}(vec2 uv, int sheet, float state)
{{
    uvec4 place = texelFetch(WLM_SCENE_SHEETS, ivec2(0, sheet), 0); // texels of its lightmap, first entry
    uvec4 tiles = texelFetch(WLM_SCENE_SHEETS, ivec2(1, sheet), 0);
    vec2 size = vec2(place.xy);
    // Tiles begin and end on centres of the lightmap's texels.
    vec2 x = clamp(uv * size - vec2(0.5, 0.5), vec2(0.0, 0.0), size - vec2(1.0, 1.0)) / WLM_SCENE_TILE;
    ivec2 tile = min(ivec2(floor(x)), ivec2(tiles.xy) - ivec2(1, 1));
    uvec4 entry = texelFetch(WLM_SCENE_LUT, ivec2(place.zw) + tile, 0);
    // {entry}
    vec2 first = vec2(entry.xy >> uvec2({bits}u, {bits}u));
    vec2 steps = vec2(entry.xy & uvec2({mask}u, {mask}u));
    vec2 extent = vec2({width}.0, {height}.0); // of a page
{blocks}    vec2 at = first + (x - vec2(tile)) * steps + vec2(0.5, 0.5);
    int components = {components};
    int component = {component};
    float page = {page};
    int before = min(int(state), {last});
    int after = min(before + 1, {last});
    float share = state - float(before);
    // A constant, and then a factor for each component.
    vec3 light = vec3(0.0, 0.0, 0.0);
    for (int k = 0; k <= components; k++) {{
        vec3 factor = texelFetch(WLM_SCENE_FACTORS, ivec2(component + k, before), 0).rgb;
        factor = mix(factor, texelFetch(WLM_SCENE_FACTORS, ivec2(component + k, after), 0).rgb, share);
        vec2 spot = at + vec2(float(k - 1) * (steps.x + 1.0), 0.0);
{coarse}        spot = spot / extent;
        if (k > 0)
            {read}
        if (components > 0)
            light += factor;
    }}
    return max(light, vec3(0.0, 0.0, 0.0));
}}
"""

_BLOCKS = """\
    bool blocks = steps.x >= {code}.0;
    if (blocks) {{
        // Its first block, and from {code} on its blocks less one, of {side} texels a side.
        first *= {side}.0;
        steps = (steps - vec2({code}.0, {code}.0)) * {side}.0 + vec2({last}.0, {last}.0);
        extent = vec2({width}.0, {height}.0);
    }}
"""
_COARSE = """\
        int small = k - 1 - components + {small}; // of the coarse components, of one block each
        if (small >= 0) {{
            int rows = int(steps.y + 1.0) / {side};
            vec2 aside = vec2(float(components - {small}) * (steps.x + 1.0) + {side}.0 * float(small / rows),
                              {side}.0 * float(small % rows));
            spot = first + aside + (x - vec2(tile)) * {last}.0 + vec2(0.5, 0.5);
        }}
"""
_READ = "factor = factor * textureLod(WLM_SCENE_COLOUR, vec3(spot, page), 0.0).rgb;"
_READ_MIXED = """\
factor = factor * (blocks ? textureLod(WLM_SCENE_BLOCKS, vec3(spot, page), 0.0).rgb
                                     : textureLod(WLM_SCENE_COLOUR, vec3(spot, page), 0.0).rgb);"""

_LONG = {
    "entry": "The first texel of the tile's first rectangle, and in the low bits its texels less one; its first\n"
    "    // component's number; its page, its coarse components, and in the lowest bits all its components.",
    "components": f"int(entry.w & {(1 << COUNT_BITS) - 1}u)",
    "component": "int(entry.z)",
    "page": f"float(entry.w >> {COUNT_BITS + COARSE_BITS}u)",
    "small": f"int((entry.w >> {COUNT_BITS}u) & {MOST_COARSE}u)",
}
_SHORT = {
    "entry": "The first texel of the tile's rectangle, and in the low bits its texels less one.",
    "components": "1",
    "component": "0",
    "page": "0.0",
}

_GRAD = """
// Light where a pixel is large: dx and dy are dFdx(uv) and dFdy(uv). Up close it is wlm_scene(uv, sheet, state).
vec3 {name}(vec2 uv, vec2 dx, vec2 dy, int sheet, float state)
{{
    vec2 size = vec2(texelFetch(WLM_SCENE_SHEETS, ivec2(0, sheet), 0).xy); // of the lightmap, in texels
    float texels = max(length(dx * size), length(dy * size)); // along the pixel
    // A bilinear read still meets all texels where a pixel is two of them. The first smaller level is a quarter.
    float level = clamp(log2(max(texels, 1.0)) - {octaves}.0, 0.0, 32.0);
    int near = sheet;
    int far = int(texelFetch(WLM_SCENE_SHEETS, ivec2(1, sheet), 0).z); // 0: there is none
    int steps = int(level);
    for (int i = 0; i < steps; i++) {{
        if (far > 0) {{
            near = far;
            far = int(texelFetch(WLM_SCENE_SHEETS, ivec2(1, near), 0).z);
        }}
    }}
    float share = level - float(steps);
    vec3 light = {read}(uv, near, state);
    if (share <= 0.0 || far == 0)
        return light;
    return mix(light, {read}(uv, far, state), share);
}}
"""

_APART = """
// Each state has rows of sheets of its own.
vec3 {name}({declared}, int sheet, float state)
{{
    int before = min(int(state), {last});
    int after = min(before + 1, {last});
    float share = state - float(before);
    vec3 light = {row}({given}, sheet + {stride} * before, float(before));
    if (share <= 0.0)
        return light;
    return mix(light, {row}({given}, sheet + {stride} * after, float(after)), share);
}}
"""
_FUNCTIONS = {"wlm_scene": ("vec2 uv", "uv"), "wlm_scene_grad": ("vec2 uv, vec2 dx, vec2 dy", "uv, dx, dy")}
"""With the arguments before the sheet, as they are declared and given."""


def scene_glsl(model: SceneModel) -> str:
    """The shader text for a model: functions alone, to be included below `#version`."""
    height, width = model.texels.shape[1:]
    kinds = {"sheets": "usampler2D", "lut": "usampler2D", "factors": "sampler2D", "colour": "sampler2DArray"}
    mixed = model.colour == "mixed"
    if mixed:
        kinds["blocks"] = "sampler2DArray"
    rows, columns = model.block_texels.shape[1:3]
    sizes = {"code": FIRST_BLOCK_CODE, "side": BLOCK_SIDE, "last": BLOCK_SIDE - 1, "width": columns, "height": rows}
    short = model.lut.shape[2] == SHORT_ENTRY
    numbers = _SHORT if short else _LONG
    names = {name: f"{name}_row" if model.later else name for name in _FUNCTIONS}
    text = _TEXT.format(
        name=names["wlm_scene"],
        blocks=_BLOCKS.format(**sizes) if mixed else "",
        coarse=_COARSE.format(**sizes, **numbers) if mixed and not short else "",
        read=_READ_MIXED if mixed else _READ,
        second="// wlm_scene_blocks: blocks_0.dds and so on, likewise.\n" if mixed else "",
        last=len(model.states) - 1,
        tile=model.profile.tile,
        width=width,
        height=height,
        samplers="".join(sampler(f"wlm_scene_{name}", kind) for name, kind in kinds.items()),
        bits=SIDE_BITS,
        mask=(1 << SIDE_BITS) - 1,
        **numbers,
    )
    if model.levels:
        text += _GRAD.format(octaves=TAIL_OCTAVES - 1, name=names["wlm_scene_grad"], read=names["wlm_scene"])
    if not model.later:
        return text
    states = {"last": len(model.states) - 1, "stride": model.stride}
    for name, (declared, given) in _FUNCTIONS.items():
        if name == "wlm_scene" or model.levels:
            text += _APART.format(name=name, row=names[name], declared=declared, given=given, **states)
    return text
