"""The method "tiles": each tile of a lightmap at its own resolution."""
