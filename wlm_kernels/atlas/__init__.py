"""Kernels for lightmap atlases: they read tiles and cascades, compute steps of tuning, and group similar triangles."""
