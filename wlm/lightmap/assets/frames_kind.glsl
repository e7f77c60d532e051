    if (int(tile.x) == 4) {
        vec3 early = wlm_lightmap_of_frames(tile, record + 1, inner);
        if (tile.w == 0.0)
            return early;
        // Radiance is mixed, even if networks interpolate.
        vec3 late = wlm_lightmap_of_frames(tile, record + 3, inner);
        vec3 light = mix(pow(early, @gamma@), pow(late, @gamma@), tile.w);
        return pow(light, @inverse@);
    }
