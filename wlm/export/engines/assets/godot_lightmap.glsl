#[versions]

decode = "#define WLM_DECODE";
fill = "#define WLM_FILL";

#[compute]

#version 450

#VERSION_DEFINES

// Decodes a stored hour into linear light, or fills the gaps between its charts. See README.md.

@SHADER@

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f, set = 0, binding = 8) uniform restrict writeonly image2D wlm_target;
#ifdef WLM_FILL
layout(set = 0, binding = 9) uniform sampler2D wlm_map;
#endif

void main()
{
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = imageSize(wlm_target);
    if (texel.x >= size.x || texel.y >= size.y)
        return;
#ifdef WLM_FILL
    imageStore(wlm_target, texel, texelFetch(wlm_map, wlm_source(texel), 0));
#else
    imageStore(wlm_target, texel, vec4(wlm_radiance(texel), 1.0));
#endif
}
