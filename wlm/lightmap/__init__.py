"""Lightmaps over time: a tile is stored as block-compressed feature maps and a small MLP (neural-dynamic-gi)."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
