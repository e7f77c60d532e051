"""Folders that an engine's user drops in: textures, floats, a component or a material, and a page about them."""

from wlm._facade import facade

_PLACES = {
    "ENGINES": "wlm.engines.kit",
    "export_atlas": "wlm.engines.atlas",
    "export_lightmap": "wlm.engines.lightmap",
    "export_smoke": "wlm.engines.smoke",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
