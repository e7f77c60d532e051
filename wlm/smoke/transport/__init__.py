"""Lighting of smoke without six-way lightmaps: path tracing, lights from any direction, multiple scattering."""

from wlm._facade import facade

_PLACES = {
    "LitSmoke": "wlm.smoke.transport.lighting",
    "OrdersModel": "wlm.smoke.transport.orders",
    "PointLight": "wlm.smoke.shading",
    "ScatteredSmoke": "wlm.smoke.transport.orders",
    "Transport": "wlm.smoke.transport.tracing",
    "bake_sphere": "wlm.smoke.transport.sphere",
    "fine_march": "wlm.smoke.transport.lighting",
    "light_smoke": "wlm.smoke.transport.lighting",
    "load_orders": "wlm.smoke.transport.orders",
    "scatter": "wlm.smoke.transport.orders",
    "sky_lights": "wlm.smoke.shading",
    "trace": "wlm.smoke.transport.tracing",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
