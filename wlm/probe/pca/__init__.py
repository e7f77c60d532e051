"""Compresses light to principal components with 8-bit coefficients, for sets that are too small for Gaussians."""
