
// The texel whose light a texel of the map shows: itself inside a chart; in a gap the nearest inside within @reach@
// texels, in reading order of several as near; beyond that itself.
ivec2 wlm_source(ivec2 texel)
{
    if (texelFetch(WLM_LIGHTMAP_VALID, texel, 0).x > 0.5)
        return texel;
    ivec2 found = texel;
    int least = @beyond@;
    for (int y = -@reach@; y <= @reach@; y++)
        for (int x = -@reach@; x <= @reach@; x++) {
            ivec2 at = texel + ivec2(x, y);
            if (x * x + y * y < least && at.x >= 0 && at.y >= 0 && at.x < @width@ && at.y < @height@) {
                if (texelFetch(WLM_LIGHTMAP_VALID, at, 0).x > 0.5) {
                    least = x * x + y * y;
                    found = at;
                }
            }
        }
    return found;
}
