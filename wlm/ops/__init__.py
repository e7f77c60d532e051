"""Differentiable operations for torch on Warp kernels."""
