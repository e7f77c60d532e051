"""Light probes as 3D Gaussians and a small network (gaussian-probe-compression)."""

from wlm._facade import facade

_PLACES = {
    "DayModel": "wlm.probe.day",
    "Decoder": "wlm.probe.decode",
    "ProbeModel": "wlm.probe.model",
    "ProbeSet": "wlm.probe.data",
    "Profile": "wlm.probe.model",
    "RegionDecoder": "wlm.probe.region_decode",
    "RegionModel": "wlm.probe.regions",
    "Report": "wlm.probe.evaluation",
    "Transform": "wlm.probe.transform",
    "TransformDecoder": "wlm.probe.transform_decode",
    "TransformModel": "wlm.probe.transform",
    "Volume": "wlm.probe.volume",
    "compress": "wlm.probe.fit",
    "compress_day": "wlm.probe.day_fit",
    "evaluate": "wlm.probe.evaluation",
    "evaluate_day": "wlm.probe.day_evaluation",
    "export": "wlm.probe.exporter",
    "export_godot": "wlm.probe.godot_bake",
    "export_grid": "wlm.probe.three_grid",
    "export_unity": "wlm.probe.unity",
    "export_unreal": "wlm.probe.unreal",
    "export_volume": "wlm.probe.volume_export",
    "from_arrays": "wlm.probe.data",
    "load": "wlm.probe.data",
    "load_hours": "wlm.probe.hours",
    "load_positions": "wlm.probe.data",
    "open_checkpoint": "wlm.probe.fit",
    "save_probes": "wlm.probe.data",
    "score": "wlm.probe.evaluation",
    "score_views": "wlm.probe.seen",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
