"""The method "tiles": each tile of a lightmap is stored at its own resolution."""
