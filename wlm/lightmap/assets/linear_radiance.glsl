
// Linear radiance of a colour, at most 65504: a target of half floats would make more infinite.
vec3 wlm_lightmap_linear(vec3 colour)
{
    return min(pow(colour, @gamma@), vec3(65504.0, 65504.0, 65504.0));
}
