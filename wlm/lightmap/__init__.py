"""Temporal lightmaps: block-compressed features and a small MLP for each tile (neural-dynamic-gi)."""

from wlm._facade import facade

__all__ = [
    "Decoder",
    "LightmapModel",
    "LightmapSet",
    "Profile",
    "Report",
    "compress",
    "evaluate",
    "export",
    "from_arrays",
    "load",
    "open_checkpoint",
]

__getattr__, __dir__ = facade(
    __name__,
    {
        "Decoder": "wlm.lightmap.decode",
        "LightmapModel": "wlm.lightmap.model",
        "LightmapSet": "wlm.lightmap.data",
        "Profile": "wlm.lightmap.model",
        "Report": "wlm.lightmap.evaluation",
        "compress": "wlm.lightmap.fit",
        "evaluate": "wlm.lightmap.evaluation",
        "export": "wlm.lightmap.exporter",
        "from_arrays": "wlm.lightmap.data",
        "load": "wlm.lightmap.data",
        "open_checkpoint": "wlm.lightmap.fit",
    },
)
