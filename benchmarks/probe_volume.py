"""The cascaded volume of probes: error and cost of a walk with it, and pictures under its light.

- Method "volume": a walk with the volume, filled from the original probes ("lossless") and from each model. Figures are
  means and 95th percentiles over frames, each timed until the device has finished it. The PSNR is that of readings at
  probes near the viewer against the input; beside it are those of the decoded probes at the same samples, and of
  readings farther away. The walk starts with an empty volume: the time of its first frame, and the frames until no
  block waits. RMS and RMSE of the light refer to the probes that filled the volume.
- Method "views": pictures of balls at the probes, compared as displayed, see `wlm.probe.views`.
"""

from collections.abc import Mapping
from typing import Any

from benchmarks.rows import Row
from benchmarks.runner import Bench
from wlm.errors import WlmError
from wlm.probe.data import ProbeSet
from wlm.probe.model import ProbeModel
from wlm.probe.views import score_views
from wlm.probe.volume.light import Light, StoredLight
from wlm.probe.volume.walk import score_volume


def volume_rows(bench: Bench, probes: ProbeSet, models: Mapping[str, ProbeModel], frames: int | None) -> list[Row]:
    """Walks with the original probes and with each model, each from an empty volume.

    Args:
        bench: Benchmark of the set, on the device of the volume.
        probes: The original probes.
        models: Models by the names of their rows.
        frames: Frames of the walk, at least one; None: each frame moves the viewer by a tenth of a block.
    """
    rows = []
    lights: dict[str, Light] = {"lossless": StoredLight(probes.values, bench.device)}
    for name, model in models.items():
        lights[name] = model.decoder(bench.device).light(probes.position)
    for name, light in lights.items():
        bench.note(f"the volume, {name}")
        walked = score_volume(probes, light, frames=frames)
        spread = {"update_ms": walked["update_ms"], "blocks": walked["updated"], "probes_decoded": walked["probes"]}
        rows.append(
            bench.row(
                "volume",
                f"{name}, walk of {walked['frames']} frames",
                f"the finest blocks are {walked['block']:.3g} units wide",
                frames=walked["frames"],
                first_ms=walked["first_ms"],
                frames_first=walked["first_frames"],
                memory=walked["memory_bytes"] / 2**20,
                psnr=walked["psnr"],
                light_psnr=walked["light_psnr"],
                far_psnr=walked["far_psnr"],
                **_light(walked),
                **{key: value["mean"] for key, value in spread.items()},
                **{f"{key}_p95": value["p95"] for key, value in spread.items()},
            )
        )
    return rows


def view_rows(bench: Bench, probes: ProbeSet, model: ProbeModel, views: int) -> list[Row]:
    """Scores pictures of balls under each kind of light.

    Args:
        bench: Benchmark of the set, on the device of the decode.
        probes: The original probes.
        model: A model of them.
        views: Number of pictures, at least one.
    """
    bench.note(f"{views} views of balls")
    decoded = model.decoder(bench.device).decode_probes(probes.position)
    try:
        scores = score_views(probes, decoded, views=views, device=bench.device)
    except WlmError as error:  # no spherical harmonics
        return [bench.missing_row("views", "balls", error)]
    return [
        bench.row(
            "views",
            f"{score.drawn}, {score.light}",
            f"{score.views} views under the original probes and under these",
            psnr=score.psnr,
            ssim=score.ssim,
            flip=score.flip,
        )
        for score in scores
    ]


def _light(figures: dict[str, Any]) -> dict[str, float | None]:
    """Returns figures of the light at a walk's samples; None where no probe is near the viewer."""
    names = {"coverage": "coverage", "light_rmse": "rmse", "light": "rms"}
    return {name: figures[key]["mean"] if figures[key] else None for name, key in names.items()}
