"""Other compression and rendering methods with which each system is compared. Block codecs need the extra `baselines`.

Each module has the methods by name in `RIVALS`. A method compresses an input and returns a `Rival`, whose error
the benchmark then measures as for our own methods. The rivals of smoke make pictures and no file. The package `wlm`
itself imports no rival.
"""

from benchmarks.rivals.rival import Rival

__all__ = ["Rival"]
