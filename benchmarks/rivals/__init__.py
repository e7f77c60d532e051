"""The rivals of each system. Block codecs need the extra `baselines`.

Each module has `RIVALS`, the methods by name, and they are scored by the system's evaluation: a method makes a
`Rival` of an input, and `evaluate_rivals` scores it. The rivals of smoke make no file: each is what
`wlm.smoke.evaluation.compare` takes beside a network. No system imports a baseline.
"""

from benchmarks.rivals.rival import Rival

__all__ = ["Rival"]
