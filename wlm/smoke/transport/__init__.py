"""Lighting of smoke without six-way lightmaps: lights from any direction, multiple scattering."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
