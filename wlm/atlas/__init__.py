"""A mesh's lightmap as a small colour texture, read through a look-up table (lightmap-uv-clustering-cascade)."""

from wlm._facade import facade

_PLACES = {
    "AtlasModel": "wlm.atlas.model",
    "Decoder": "wlm.atlas.decode",
    "LightmappedMesh": "wlm.atlas.data",
    "Profile": "wlm.atlas.model",
    "Report": "wlm.atlas.evaluation",
    "View": "wlm.ops.views",
    "compare": "wlm.atlas.evaluation",
    "compress": "wlm.atlas.fit",
    "describe": "wlm.atlas.exporter",
    "evaluate": "wlm.atlas.evaluation",
    "export": "wlm.atlas.exporter",
    "from_arrays": "wlm.atlas.data",
    "load": "wlm.atlas.data",
    "read_folder": "wlm.atlas.exporter",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
