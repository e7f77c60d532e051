"""Bakes light to compress: lightmaps and probes over the day, with Mitsuba 3.

The extra `bake` installs Mitsuba, which needs LLVM 16 or later on the CPU. The documentation is docs/bake.md.
"""

from wlm._facade import facade

__getattr__, __dir__, __all__ = facade(__name__, __file__)
