
vec3 wlm_@kind@(ivec2 texel)
{
    vec3 colour = wlm_colour(texel);  // glslang's HLSL takes no call with textures as an argument here
    return wlm_lightmap_linear(colour);
}
