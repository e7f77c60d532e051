    vec4 uvt = vec4(0.0, 0.0, 0.0, 0.0);
    vec4 planes = uvt;
    bool dynamic = int(tile.x) == 2;
    if (dynamic) {
        vec2 place = (vec2(inner) + vec2(0.5, 0.5)) / @TILE@.0;
        uvt = wlm_lightmap_volume(row, place);
        planes = vec4(wlm_lightmap_plane(2 * row, place.x), wlm_lightmap_plane(2 * row + 1, place.y));
        // The encoded time is in the bias.
        second = start + 17 * WLM_LIGHTMAP_FOURS;
    }
