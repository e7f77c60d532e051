"""Kernels for lightmap atlases: reads of tiles and cascades, steps of tuning, and the grouping of similar triangles."""
