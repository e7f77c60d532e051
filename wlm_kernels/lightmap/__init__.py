"""Kernels of temporal lightmaps."""
