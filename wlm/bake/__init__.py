"""Bakes light to compress: lightmaps and probes over the day, with Mitsuba 3.

The extra `bake` installs Mitsuba, which needs LLVM 16 or later on the CPU. The documentation is docs/bake.md.
"""

from wlm._facade import facade

_PLACES = {
    "BakeScene": "wlm.bake.settings",
    "bake_lightmaps": "wlm.bake.lightmaps",
    "bake_probes": "wlm.bake.probes",
    "open_checkpoint": "wlm.bake.work",
    "open_task": "wlm.bake.work",
    "write_lightmaps": "wlm.bake.lightmaps",
    "write_probes": "wlm.bake.probes",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
