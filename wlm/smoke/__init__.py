"""Six-way lightmaps of smoke: baked by ray marches, or predicted by a network (paper: neural-six-way-lightmaps)."""

from wlm._facade import facade

_PLACES = {
    "Camera": "wlm.smoke.camera",
    "DatasetSettings": "wlm.smoke.network.settings",
    "Decoder": "wlm.smoke.decode",
    "DensityVolume": "wlm.fluid.volume",
    "Light": "wlm.smoke.shading",
    "March": "wlm_kernels.smoke.settings",
    "NetworkSettings": "wlm.smoke.network.settings",
    "Profile": "wlm.smoke.network.settings",
    "Ramp": "wlm.smoke.shading",
    "Report": "wlm.smoke.evaluation",
    "SixWay": "wlm.smoke.lightmaps",
    "SmokeModel": "wlm.smoke.model",
    "SmokePredictor": "wlm.smoke.network.prediction",
    "TrainSettings": "wlm.smoke.network.settings",
    "bake": "wlm.smoke.march.six_way",
    "evaluate": "wlm.smoke.evaluation",
    "export_onnx": "wlm.smoke.network.onnx_file",
    "guide": "wlm.smoke.march.six_way",
    "load": "wlm.smoke.data",
    "load_frames": "wlm.smoke.data",
    "load_scene": "wlm.smoke.scene",
    "bake_coarse": "wlm.smoke.march.six_way",
    "open_frames": "wlm.smoke.data",
    "predict": "wlm.smoke.network.prediction",
    "read_six_way": "wlm.smoke.data",
    "simulate": "wlm.smoke.simulation",
    "train": "wlm.smoke.fit",
    "write_six_way": "wlm.smoke.data",
}

__all__ = sorted(_PLACES)

__getattr__, __dir__ = facade(__name__, _PLACES)
