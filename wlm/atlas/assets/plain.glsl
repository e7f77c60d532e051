
vec3 wlm_atlas(vec2 uv)
{
    return wlm_atlas_colour_at(uv * vec2(textureSize(WLM_ATLAS_COLOUR, 0)));
}
