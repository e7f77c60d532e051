"""Generates the GLSL that reads a model's textures (lightmap-uv-clustering-cascade, eq. 7)."""

from wlm.atlas.model import (
    BLOCK_SIDE,
    COARSE_BITS,
    COUNT_BITS,
    FIRST_BLOCK_CODE,
    MIP_OCTAVES,
    MOST_COARSE,
    SHORT_ENTRY,
    SIDE_BITS,
    AtlasModel,
)
from wlm.bundle import filled, sampler

EXACT = "WLM_ATLAS_EXACT"
"""Macro that makes the shader fetch texels and interpolate them in floating point."""

_TEXTURES = {
    "plain": "// colour: the small texture, sampler2D, filter linear, clamped to its edge.",
    "tiles": "// lut: the lookup texture of tiles, usampler2D, two unsigned integers an entry, filter nearest.",
    "mixed": "// blocks: the small texture's blocks, sampler2D, filter linear, clamped to its edge.",
    "cascade": "// lut: the lookup texture of coordinates, sampler2D, filter linear, clamped to its edge.",
}
"""Texture declarations of each method and of colour "mixed"; every model has those of "plain"."""

_WHAT = {
    "tiles": "each of its tiles is a rectangle of a small texture, found by a lookup texture",
    "cascade": "a lookup texture of coordinates leads into a small texture",
    "plain": "a smaller lightmap",
}


def _one_lightmap(model: AtlasModel) -> str:
    method, mixed, (height, width) = model.method, model.colour == "mixed", model.sheets[0].size
    kinds = ["plain", *(["mixed"] if mixed else []), *([method] if method != "plain" else [])]
    samplers = {"colour": "sampler2D"} | ({"blocks": "sampler2D"} if mixed else {})
    if method != "plain":
        samplers["lut"] = "usampler2D" if method == "tiles" else "sampler2D"
    text = filled(
        __package__,
        "head.glsl",
        what=_WHAT[method],
        coordinate="the new UVs of mesh.glb" if len(model.uv) else "the mesh's own lightmap UVs",
        textures="\n".join(_TEXTURES[kind] for kind in kinds),
    )
    text += "".join(sampler(f"wlm_atlas_{name}", kind) for name, kind in samplers.items())
    for name, kind in samplers.items():
        if kind == "sampler2D":
            type, channels = ("vec2", "xy") if name == "lut" else ("vec3", "rgb")
            text += filled(
                __package__, "read.glsl", type=type, name=name, image=f"WLM_ATLAS_{name.upper()}", channels=channels
            )
    if method != "tiles":
        return text + filled(__package__, f"{method}.glsl")
    blocks = "blocks" if mixed else "" if model.first_block_code else "whole_blocks"
    sizes = {"code": FIRST_BLOCK_CODE, "side": BLOCK_SIDE, "last": BLOCK_SIDE - 1}
    # Coordinates are in texels, so that arithmetic within a tile stays exact.
    return text + filled(
        __package__,
        "tiles.glsl",
        width=width,
        height=height,
        tile=model.profile.tile,
        bits=SIDE_BITS,
        mask=(1 << SIDE_BITS) - 1,
        blocks=filled(__package__, f"{blocks}.glsl", **sizes) if blocks else "",
    )


_OBJECT = """
// The light of an object: `place` is its scale and offset, and `sheet` its number, in `objects` of the document.
vec3 wlm_object(vec2 uv, vec4 place, int sheet, float state)
{
    return wlm_scene(uv * place.xy + place.zw, sheet, max(state, 0.0));
}
"""

_SHARED_BLOCKS = """\
    bool blocks = steps.x >= {code}.0;
    if (blocks) {{
        // Its first block, and from {code} on its blocks less one, of {side} texels a side.
        first *= {side}.0;
        steps = (steps - vec2({code}.0, {code}.0)) * {side}.0 + vec2({last}.0, {last}.0);
        extent = vec2({width}.0, {height}.0);
    }}
"""
_COARSE = """\
        int small = k - 1 - components + {small}; // number of the coarse component, of one block
        if (small >= 0) {{
            int rows = int(steps.y + 1.0) / {side};
            vec2 aside = vec2(float(components - {small}) * (steps.x + 1.0) + {side}.0 * float(small / rows),
                              {side}.0 * float(small % rows));
            spot = first + aside + (x - vec2(tile)) * {last}.0 + vec2(0.5, 0.5);
        }}
"""
_SHARED_READ = "factor = factor * textureLod(WLM_SCENE_COLOUR, vec3(spot, page), 0.0).rgb;"
_SHARED_READ_MIXED = """\
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

_FUNCTIONS = {"wlm_scene": ("vec2 uv", "uv"), "wlm_scene_grad": ("vec2 uv, vec2 dx, vec2 dy", "uv, dx, dy")}
"""Functions, with the arguments before the sheet as they are declared and passed on."""


def _shared(model: AtlasModel) -> str:
    height, width = model.texels.shape[1:3]
    kinds = {"sheets": "usampler2D", "lut": "usampler2D", "factors": "sampler2D", "colour": "sampler2DArray"}
    mixed = model.colour == "mixed"
    if mixed:
        kinds["blocks"] = "sampler2DArray"
    rows, columns = model.block_texels.shape[1:3]
    sizes = {"code": FIRST_BLOCK_CODE, "side": BLOCK_SIDE, "last": BLOCK_SIDE - 1, "width": columns, "height": rows}
    short = model.lut.shape[2] == SHORT_ENTRY
    numbers = _SHORT if short else _LONG
    names = {name: f"{name}_row" if model.later else name for name in _FUNCTIONS}
    text = filled(
        __package__,
        "shared.glsl",
        name=names["wlm_scene"],
        blocks=_SHARED_BLOCKS.format(**sizes) if mixed else "",
        coarse=_COARSE.format(**sizes, **numbers) if mixed and not short else "",
        read=_SHARED_READ_MIXED if mixed else _SHARED_READ,
        second="// wlm_scene_blocks: the texture blocks, likewise.\n" if mixed else "",
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
        text += filled(
            __package__,
            "shared_grad.glsl",
            octaves=MIP_OCTAVES - 1,
            name=names["wlm_scene_grad"],
            read=names["wlm_scene"],
        )
    if not model.later:
        return text
    states = {"last": len(model.states) - 1, "stride": model.stride}
    for name, (declared, given) in _FUNCTIONS.items():
        if name == "wlm_scene" or model.levels:
            text += filled(
                __package__, "separate.glsl", name=name, row=names[name], declared=declared, given=given, **states
            )
    return text


def glsl(model: AtlasModel) -> str:
    """Returns the GLSL 3.30 for a model: only functions, to be included below `#version`.

    It is also valid Vulkan GLSL if the bindings are defined: `wlm_atlas(uv)` for one lightmap, `wlm_scene(uv, sheet,
    state)` and `wlm_object(uv, place, sheet, state)` for several; with mips also `wlm_scene_grad`.
    """
    return _shared(model) + _OBJECT if model.method == "shared" else _one_lightmap(model)
