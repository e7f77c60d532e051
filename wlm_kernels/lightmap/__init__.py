"""Warp kernels that train and decode lightmaps over time."""
