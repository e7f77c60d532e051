"""Compresses a scene's lightmaps to a small texture that is read through a lookup texture
(lightmap-uv-clustering-cascade)."""

from wlm._facade import facade

_PLACES = {
    "AtlasModel": "wlm.atlas.model",
    "Decoder": "wlm.atlas.decode",
    "LightmappedScene": "wlm.atlas.data",
    "Points": "wlm.atlas.views",
    "Profile": "wlm.atlas.model",
    "Report": "wlm.atlas.evaluation",
    "Sheet": "wlm.atlas.data",
    "View": "wlm.ops.views",
    "compare": "wlm.atlas.evaluation",
    "compress": "wlm.atlas.fit",
    "evaluate": "wlm.atlas.evaluation",
    "from_arrays": "wlm.atlas.data",
    "join": "wlm.atlas.data",
    "load": "wlm.atlas.data",
    "open_checkpoint": "wlm.atlas.fit",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
