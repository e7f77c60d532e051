"""Lightmaps over the day as block-compressed maps and one small network a tile (neural-dynamic-gi)."""
