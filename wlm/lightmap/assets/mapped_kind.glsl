    if (int(tile.x) == 3)
        return wlm_lightmap_mapped(tile, record, inner);
