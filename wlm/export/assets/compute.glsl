
#ifndef WLM_TARGET_BINDING
#define WLM_TARGET_BINDING 0
#endif
layout(local_size_x = @columns@, local_size_y = @rows@) in;
layout(rgba16f, binding = WLM_TARGET_BINDING) writeonly uniform highp image2D wlm_target;

void main()
{
    ivec2 texel = ivec2(gl_GlobalInvocationID.xy);
    texel.y += int(gl_WorkGroupID.y) * @rows@;
    wlm_lightmap_begin(texel - ivec2(gl_LocalInvocationID.xy), int(gl_LocalInvocationIndex));
    vec3 light[2];
    wlm_lightmap_pair(texel, light);
    for (int i = 0; i < 2; i++) {
        if (texel.x < @width@ && texel.y < @height@)
            imageStore(wlm_target, texel, vec4(light[i], 1.0));
        texel.y += @rows@;
    }
}
