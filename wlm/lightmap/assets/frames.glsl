
// Colour of a tile of frames in the first (1) or second (3) frame of its record.
vec3 wlm_lightmap_of_frames(vec4 tile, int record, ivec2 inner)
{
    int row = int(tile.y);
    vec4 least = wlm_lightmap_entry(record);
    ivec2 at = ivec2(row % @frames_columns@, row / @frames_columns@) * @TILE@ + inner;
    vec3 level = texelFetch(WLM_LIGHTMAP_FRAMES, ivec3(at, int(least.w)), 0).xyz;
    return mix(least.xyz, wlm_lightmap_entry(record + 1).xyz, level);
}
