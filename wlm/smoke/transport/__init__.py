"""Light in smoke beyond six ways: path-traced references, the scene's own lights, and light scattered more than once."""

from wlm._facade import facade

_PLACES = {
    "Environment": "wlm.smoke.transport.lights",
    "PointLight": "wlm.smoke.transport.lights",
    "Transport": "wlm.smoke.transport.tracing",
    "trace": "wlm.smoke.transport.tracing",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
