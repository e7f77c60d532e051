    vec2 place = (vec2(inner) + vec2(0.5, 0.5)) / @TILE@.0;
    vec2 under = (vec2(inner) + vec2(0.5, 0.5 + @below@.0)) / @TILE@.0;
    // A static tile reads those of the first dynamic one, with weights that are 0. The encoded time is in the bias.
    int own = int(tile.x) == 2 ? row : 0;
    vec2 ut = wlm_lightmap_plane(2 * own, place.x);
    vec4 uvt0 = wlm_lightmap_volume(own, place);
    vec4 uvt1 = wlm_lightmap_volume(own, under);
    vec4 planes0 = vec4(ut, wlm_lightmap_plane(2 * own + 1, place.y));
    vec4 planes1 = vec4(ut, wlm_lightmap_plane(2 * own + 1, under.y));
