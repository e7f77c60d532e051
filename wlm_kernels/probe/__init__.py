"""Kernels for light probes: training and decoding of Gaussians, principal components, and cascaded volumes."""
