"""Temporal lightmaps: block-compressed features and a small MLP for each tile (neural-dynamic-gi)."""

from wlm._facade import facade

_PLACES = {
    "Decoder": "wlm.lightmap.decode",
    "LayerArrays": "wlm.lightmap.layers.data",
    "LayeredModel": "wlm.lightmap.layers.model",
    "LayeredReport": "wlm.lightmap.layers.evaluation",
    "LayeredSet": "wlm.lightmap.layers.data",
    "LightmapModel": "wlm.lightmap.model",
    "LightmapSet": "wlm.lightmap.data",
    "Profile": "wlm.lightmap.model",
    "Report": "wlm.lightmap.evaluation",
    "compress": "wlm.lightmap.front",
    "evaluate": "wlm.lightmap.front",
    "export": "wlm.lightmap.front",
    "from_arrays": "wlm.lightmap.data",
    "from_layers": "wlm.lightmap.layers.data",
    "load": "wlm.lightmap.front",
    "open_checkpoint": "wlm.lightmap.front",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
