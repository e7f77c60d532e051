"""A scene over a day: its YAML file, and its pictures by lightmaps, probes and six-way lightmaps of smoke together."""

from wlm._facade import facade

_PLACES = {
    "Frame": "wlm.scene.frame",
    "Mesh": "wlm.scene.mesh",
    "Moving": "wlm.scene.content",
    "Puff": "wlm.scene.content",
    "Renderer": "wlm.scene.frame",
    "Scene": "wlm.scene.content",
    "load": "wlm.scene.content",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
