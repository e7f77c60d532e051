"""Light in smoke beyond six ways: path-traced references, the scene's own lights, and light scattered more than once."""

from wlm._facade import facade

_PLACES = {
    "Environment": "wlm.smoke.transport.lights",
    "LitSmoke": "wlm.smoke.transport.lighting",
    "PointLight": "wlm.smoke.transport.lights",
    "Transport": "wlm.smoke.transport.tracing",
    "light_smoke": "wlm.smoke.transport.lighting",
    "trace": "wlm.smoke.transport.tracing",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
