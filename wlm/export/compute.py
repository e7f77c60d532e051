"""Writes the compute shader that decodes a lightmap into a texture."""

from wlm.bundle import Bundle
from wlm.export.shading import translate
from wlm.lightmap.shader import GROUP_SIZE

_GLSL = """
#ifndef WLM_TARGET_BINDING
#define WLM_TARGET_BINDING 0
#endif
layout(local_size_x = {columns}, local_size_y = {rows}) in;
layout(rgba16f, binding = WLM_TARGET_BINDING) writeonly uniform highp image2D wlm_target;

void main()
{{
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    texel.y += int(gl_WorkGroupID.y) * {rows};
    wlm_lightmap_begin(texel - ivec2(gl_LocalInvocationID.xy), int(gl_LocalInvocationIndex));
    vec3 light[2];
    wlm_lightmap_pair(texel, light);
    for (int i = 0; i < 2; i++) {{
        if (texel.x < {width} && texel.y < {height})
            imageStore(wlm_target, texel, vec4(light[i], 1.0));
        texel.y += {rows};
    }}
}}
"""

_MAINS = {
    "glsl": _GLSL,
    "glsl-es": _GLSL,
    "hlsl": """
RWTexture2D<float4> wlm_target;

[numthreads({columns}, {rows}, 1)]
void main(uint3 group : SV_GroupID, uint3 place : SV_GroupThreadID, uint index : SV_GroupIndex)
{{
    int2 first = int2(group.xy) * int2({columns}, 2 * {rows});
    wlm_lightmap_begin(first, int(index));
    int2 texel = first + int2(place.xy);
    float3 light[2];
    wlm_lightmap_pair(texel, light);
    for (int i = 0; i < 2; i++) {{
        if (texel.x < {width} && texel.y < {height})
            wlm_target[texel] = float4(light[i], 1.0);
        texel.y += {rows};
    }}
}}
""",
    "wgsl": """
@group(1) @binding(0) var wlm_target: texture_storage_2d<rgba16float, write>;

@compute @workgroup_size({columns}, {rows})
fn main(
    @builtin(workgroup_id) group: vec3u,
    @builtin(local_invocation_id) place: vec3u,
    @builtin(local_invocation_index) index: u32,
)
{{
    let first = vec2i(group.xy) * vec2i({columns}, 2 * {rows});
    wlm_lightmap_begin(first, i32(index));
    var texel = first + vec2i(place.xy);
    var light: array<vec3f, 2>;
    wlm_lightmap_pair(texel, &light);
    for (var i = 0; i < 2; i++) {{
        if (texel.x < {width} && texel.y < {height}) {{
            textureStore(wlm_target, texel, vec4f(light[i], 1.0));
        }}
        texel.y += {rows};
    }}
}}
""",
}


def compute_shader(bundle: Bundle, language: str, exact: bool = False) -> str:
    """Returns a compute shader that decodes a lightmap at the hour of its table into a texture of half floats.

    Dispatch a group for each 32 x 8 texels of the map.

    Args:
        bundle: Bundle of a sheet with networks.
        language: One of `wlm.export.shading.LANGUAGES`; GLSL 4.30 and GLSL ES 3.10 are without `#version`.
        exact: Whether texels are fetched and interpolated in floats, without the texture filter.
    """
    (columns, rows), document = GROUP_SIZE, bundle.document
    main = _MAINS[language].format(columns=columns, rows=rows, width=document["width"], height=document["height"])
    return translate(bundle.compute, language, [bundle.exact] if exact else []) + main
