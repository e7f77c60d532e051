"""Kernels of six-way images of smoke."""
