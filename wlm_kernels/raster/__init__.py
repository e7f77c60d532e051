"""Kernels of rasterization, interpolation and textures, with their backward passes."""
