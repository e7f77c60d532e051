        if (dynamic) {
            a = wlm_lightmap_add(a, uvt, start + 4 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
            a = wlm_lightmap_add(a, planes, start + 8 * WLM_LIGHTMAP_FOURS + i, WLM_LIGHTMAP_FOURS);
        }
