"""Kernels of rasterization and textures."""
