"""Other compression and rendering methods with which each system is compared. Block codecs need the extra `baselines`.

Each module has the methods by name in `RIVALS`. A method compresses an input and returns a `Rival`, whose error
`evaluate_rivals` then measures as for our own methods. The rivals of smoke have no file: `wlm.smoke.evaluation.compare`
compares them with a network. The package `wlm` itself imports no rival.
"""

from benchmarks.rivals.rival import Rival

__all__ = ["Rival"]
