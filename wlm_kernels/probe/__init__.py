"""Kernels for light probes: Gaussians, principal components, and nested grids of light around a viewer."""
