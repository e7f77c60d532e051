"""The method "cascade" of the paper: triangles share texels, read through a lookup texture of coordinates."""
