"""Compressed precomputed lighting on NVIDIA Warp kernels."""

__all__ = ["__version__"]

__version__ = "0.1.0"
