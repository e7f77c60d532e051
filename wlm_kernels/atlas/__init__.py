"""Kernels of lightmap atlases."""
