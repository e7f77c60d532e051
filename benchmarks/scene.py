"""Measures the frames of a scene as `wlm run` draws them at 1280 x 720 pixels, and the error of its pictures.

The scene is the street of the demo, over its day of 24 seconds. A row "a frame" is a number of samples of each pixel
along an axis: `frame_ms` is the mean time of a frame with all work of the host; the rows behind it are of its stages.
Pages of lightmaps are decoded as the camera and the light move. `view_psnr` and `view_flip` are means over the hours
whose original lightmaps the scene has, of the pixels that show its mesh.
"""

import time
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.rows import Row
from benchmarks.runner import Bench, Note, demo_data
from wlm.scene.content import load
from wlm.view.scene_run import run as run_scene

_SIZE, _QUICK_SIZE = (720, 1280), (90, 160)
_QUICK_FRAMES = 12
_MIB = 2.0**20


def run(*, quick: bool, device: str, progress: Note | None = None) -> list[Row]:
    """Draws the street's film with one sample and with four samples of a pixel.

    Args:
        quick: Whether to draw a small and short film with one sample.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        A row for each number of samples, and a row for each stage of its frames.

    Raises:
        WlmError: The demo's scene or the device isn't there.
    """
    bench = Bench("scene", device, progress, scene="street")
    height, width = _QUICK_SIZE if quick else _SIZE
    rows = []
    with TemporaryDirectory() as folder, load(demo_data("street/street.yaml", "")) as scene:
        for samples in (1,) if quick else (1, 2):
            settings = {"height": height, "width": width, "samples": samples, "device": device}
            run_scene(scene, folder, frames=_QUICK_FRAMES, **settings)  # loads kernels and captures graphs
            bench.note(f"drawing the film with {samples} x {samples} samples")
            start = time.perf_counter()
            report = run_scene(scene, folder, frames=_QUICK_FRAMES if quick else None, **settings)
            seconds = time.perf_counter() - start
            option = f"{width} x {height}, {samples} x {samples} samples a pixel"
            frames, memory = report["film"]["frames"], sum(report["memory"].values()) / _MIB
            figures = _times(report["frame_ms"]["total"])
            figures |= {name: np.mean([view[score] for view in report["views"]]) for name, score in _SCORES.items()}
            figures |= {"pages_decoded": report["decoded"]["mean"], "current": report["current"]["mean"]}
            notes = f"{frames} frames, {seconds:.0f} s with the pictures and the encoding of the film"
            rows.append(bench.row("a frame", option, notes, memory=memory, **figures))
            for stage, times in report["frame_ms"].items():
                if stage != "total":
                    rows.append(bench.row(stage, option, **_times(times)))
    return rows


_SCORES = {"view_psnr": "psnr", "view_flip": "flip"}


def _times(times: dict[str, float]) -> dict[str, float]:
    return {"frame_ms": times["mean"], "frame_ms_p95": times["p95"], "frame_ms_max": times["most"]}
