"""Kernels for lightmap atlases: they read tiles and cascades, fit their textures, and group similar triangles."""
