"""Compresses light probes to 3D Gaussians and a network (gaussian-probe-compression), or to principal components."""

from wlm._facade import facade

_PLACES = {
    "Decoder": "wlm.probe.decode",
    "ProbeModel": "wlm.probe.model",
    "ProbeSet": "wlm.probe.data",
    "Profile": "wlm.probe.model",
    "Report": "wlm.probe.evaluation",
    "Volume": "wlm.probe.volume.cascade",
    "compress": "wlm.probe.fit",
    "evaluate": "wlm.probe.evaluation",
    "from_arrays": "wlm.probe.data",
    "load": "wlm.probe.data",
    "load_positions": "wlm.probe.data",
    "open_checkpoint": "wlm.probe.fit",
    "save_probes": "wlm.probe.data",
    "score": "wlm.probe.evaluation",
    "score_views": "wlm.probe.views",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
