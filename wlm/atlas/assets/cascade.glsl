
vec3 wlm_atlas(vec2 uv)
{
    // The triangle wave of eq. 8 is the identity on what 16 bits without a sign hold.
    vec2 place = wlm_atlas_lut_at(uv * vec2(textureSize(WLM_ATLAS_LUT, 0)));
    return wlm_atlas_colour_at(place * vec2(textureSize(WLM_ATLAS_COLOUR, 0)));
}
