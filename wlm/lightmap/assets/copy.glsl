    // A static tile has no weights of F_uvt, F_ut and F_vt: they are 0, so that all networks have the same places.
    int skipped = kind == 1 ? @dynamic_size@ : 0;
    for (int i = index; i < count; i += @invocations@) {
        if (i < @static_size@)
            wlm_lightmap_weights[i] = wlm_lightmap_four(int(tile.z) + i);
        else if (i < @static_size@ + skipped)
            wlm_lightmap_weights[i] = vec4(0.0, 0.0, 0.0, 0.0);
        else
            wlm_lightmap_weights[i] = wlm_lightmap_four(int(tile.z) + i - skipped);
    }
