"""Kernels of lightmap atlases: reading tiles and cascades, tuning steps, and the clustering of triangles."""
