"""A scene over a day: its YAML file, and its pictures by lightmaps, probes and six-way lightmaps of smoke together."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
