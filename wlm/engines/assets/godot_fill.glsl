#[compute]
#version 450
// Fills the gaps between charts. See README.md.

@SHADER@

layout(local_size_x = 8, local_size_y = 8) in;
layout(rgba16f, set = 0, binding = 8) uniform restrict writeonly image2D wlm_target;
layout(set = 0, binding = 9) uniform sampler2D wlm_map;

void main()
{
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    ivec2 size = imageSize(wlm_target);
    if (texel.x < size.x && texel.y < size.y)
        imageStore(wlm_target, texel, texelFetch(wlm_map, wlm_source(texel), 0));
}
