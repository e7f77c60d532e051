"""The lightmaps of a scene of many meshes, in all their states, as one table and one small texture."""

from wlm._facade import facade

_PLACES = {
    "Decoder": "wlm.atlas.scene.decode",
    "LightmappedScene": "wlm.atlas.scene.data",
    "SceneModel": "wlm.atlas.scene.model",
    "SceneProfile": "wlm.atlas.scene.model",
    "SceneReport": "wlm.atlas.scene.evaluation",
    "compare_scene": "wlm.atlas.scene.evaluation",
    "compress_scene": "wlm.atlas.scene.fit",
    "evaluate_scene": "wlm.atlas.scene.evaluation",
    "export_scene": "wlm.atlas.scene.exporter",
    "load_scene": "wlm.atlas.scene.data",
    "scene_of": "wlm.atlas.scene.data",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
