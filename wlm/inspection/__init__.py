"""Describes files and folders: their content, the command that reads them, and possible problems."""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
