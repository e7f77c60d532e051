"""Compresses a scene's lightmaps to a small texture that is read through a lookup texture
(lightmap-uv-clustering-cascade)."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
