"""Lightmaps over time: a tile is stored as block-compressed feature maps and a small MLP (neural-dynamic-gi)."""

from wlm._facade import facade

_PLACES = {
    "Decoder": "wlm.lightmap.decode",
    "Layer": "wlm.lightmap.data",
    "LightmapModel": "wlm.lightmap.model",
    "LightmapSet": "wlm.lightmap.data",
    "Profile": "wlm.lightmap.profile",
    "Report": "wlm.lightmap.evaluation",
    "Sheet": "wlm.lightmap.sheet",
    "VirtualTexture": "wlm.lightmap.virtual.texture",
    "compress": "wlm.lightmap.fit",
    "evaluate": "wlm.lightmap.evaluation",
    "from_arrays": "wlm.lightmap.data",
    "from_groups": "wlm.lightmap.data",
    "from_layers": "wlm.lightmap.data",
    "load": "wlm.lightmap.data",
    "open_checkpoint": "wlm.lightmap.fit",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
