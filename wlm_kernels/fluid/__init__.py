"""Kernels of fluids."""
