"""Kernels of light probes."""
