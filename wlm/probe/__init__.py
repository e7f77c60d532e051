"""Compresses light probes to 3D Gaussians and a network (gaussian-probe-compression), or to principal components."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
