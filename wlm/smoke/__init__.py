"""Six-way lightmaps of smoke: baked by ray marches, or predicted by a network (paper: neural-six-way-lightmaps)."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
