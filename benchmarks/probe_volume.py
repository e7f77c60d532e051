"""The cascaded volume of probes: error and cost of a walk with it, and pictures under its light.

- method "volume": a walk with the volume, over the probes as they were ("lossless") and as each model has them, whose
  figures are means and 95th percentiles of a frame. A frame is timed until the device has done all of it. Its PSNR is
  that of what is read at probes near the viewer against the input, beside it that of the same probes as they were
  decoded, and of what is read farther away. The walk starts with an empty volume: what its first frame takes, and the
  frames until nothing waits. The light's RMS is that of the probes that the volume was made from, its RMSE is against
  these.
- method "views": pictures of balls at the probes, compared as they are shown, see `wlm.probe.views`.
"""

from collections.abc import Mapping
from typing import Any

from benchmarks.rows import Row
from benchmarks.runner import Bench
from wlm.errors import WlmError
from wlm.probe.data import ProbeSet
from wlm.probe.volume.light import Light, StoredLight, light_of
from wlm.probe.model import ProbeModel
from wlm.probe.views import score_views
from wlm.probe.transform import TransformModel
from wlm.probe.volume.walk import score_volume


def volume_rows(
    bench: Bench, probes: ProbeSet, models: Mapping[str, ProbeModel | TransformModel], frames: int | None
) -> list[Row]:
    """A walk with the probes as they were and one with each model's, each from an empty volume.

    Args:
        bench: Of the set, on the device of the volume.
        probes: As they were.
        models: By the names of their rows.
        frames: Of the walk, at least one; None: as many as a tenth of a block each takes.
    """
    rows = []
    lights: dict[str, Light] = {"lossless": StoredLight(probes.values, bench.device)}
    for name, model in models.items():
        lights[name] = light_of(model.decoder(bench.device), probes.position)
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
    """Pictures of balls under the light, for each way to read it.

    Args:
        bench: Of the set, on the device of the decode.
        probes: As they were.
        model: Of them.
        views: Pictures, at least one.
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
            f"{score.views} views under the probes as they were and under these",
            psnr=score.psnr,
            ssim=score.ssim,
            flip=score.flip,
        )
        for score in scores
    ]


def _light(figures: dict[str, Any]) -> dict[str, float | None]:
    """What the samples of a walk say of the light; none where no probe is near the viewer."""
    names = {"coverage": "coverage", "light_rmse": "rmse", "light": "rms"}
    return {name: figures[key]["mean"] if figures[key] else None for name, key in names.items()}
