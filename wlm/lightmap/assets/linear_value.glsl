
// The values of a colour, which has no gamma: levels from 0 to 1. They mix as radiance does.
vec3 wlm_lightmap_linear(vec3 colour)
{
    return vec3(@least@, @least@, @least@) + @span@ * colour;
}
