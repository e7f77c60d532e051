    if (int(tile.x) == 1 || int(tile.x) == 2)
        return wlm_lightmap_mapped(tile, record, inner);
