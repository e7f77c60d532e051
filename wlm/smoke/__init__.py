"""Six-way lightmaps of smoke, baked or predicted by a network (neural-six-way-lightmaps)."""

from wlm._facade import facade

__all__ = [
    "DatasetSettings",
    "Decoder",
    "NetworkSettings",
    "Profile",
    "Report",
    "SmokeModel",
    "TrainSettings",
    "evaluate",
    "export",
    "train",
]

__getattr__, __dir__ = facade(
    __name__,
    {
        "DatasetSettings": "wlm.smoke.learn.settings",
        "Decoder": "wlm.smoke.decode",
        "NetworkSettings": "wlm.smoke.model",
        "Profile": "wlm.smoke.model",
        "Report": "wlm.smoke.evaluation",
        "SmokeModel": "wlm.smoke.model",
        "TrainSettings": "wlm.smoke.learn.settings",
        "evaluate": "wlm.smoke.evaluation",
        "export": "wlm.smoke.onnx_file",
        "train": "wlm.smoke.fit",
    },
)
