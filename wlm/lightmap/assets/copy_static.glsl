    for (int i = index; i < count; i += @invocations@)
        wlm_lightmap_weights[i] = wlm_lightmap_four(int(tile.z) + i);
