"""What the systems are compared with, one module a system. Block codecs need the extra `baselines`.

Each module has the same verbs: ``RIVALS``, the methods by name, each of which makes a ``Rival``; and
``evaluate_rivals``, which scores rivals by the system's own evaluation. No system knows of them.
"""

from wlm.baselines.rival import Rival

__all__ = ["Rival"]
