"""Error of a scene's decoded lightmaps, in views of the whole scene, from around it and from inside.

As `wlm.atlas.evaluation`; a view is scored under every state. The peak is one number for each state, the range of the
reference in all views, a maximum above twice the 99.9th percentile counting as that. Figures are means over states and
views.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm import system
from wlm.atlas.scene.data import LightmappedScene
from wlm.atlas.scene.decode import Decoder
from wlm.atlas.scene.model import SceneModel
from wlm.atlas.scene.seen import scene_views, seen_points
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.metrics.error import psnr_from_mse
from wlm.ops import raster
from wlm.ops.views import View, Viewpoint
from wlm.system import Meter, OnProgress

SceneSampler = Callable[[torch.Tensor, torch.Tensor, int], torch.Tensor]
"""A decoder: UVs float32 [N, 2], sheets int32 [N] and the number of a state, to linear RGB float [N, 3]."""

VIEWS, RESOLUTION = 24, 256
"""Cameras around the scene, and as many from inside; pixels along a side of a view."""

_PERCENTILE, _ABOVE = 99.9, 2.0  # of the peak


@dataclass(frozen=True)
class SceneScore(system.Report):
    """The error of a decoder.

    Attributes:
        name: The scene's name.
        views, inside_views: Views that show a lightmap, and those of them from inside.
        eye_height: Of the viewers inside, above their floor, in the scene's unit; NaN where nobody can stand.
        psnr: dB, mean over states and views.
        around_psnr, inside_psnr: The same of the views from around and from inside.
        psnr_worst: dB, of the worst view and state.
        psnr_by_state: dB, means over the views.
        peaks: Of the PSNRs, by state.
        texel_psnr: dB, mean over the states, over all sheets' texels in a chart.
    """

    name: str
    views: int
    inside_views: int
    eye_height: float
    psnr: float
    around_psnr: float
    inside_psnr: float
    psnr_worst: float
    psnr_by_state: tuple[float, ...]
    peaks: tuple[float, ...]
    texel_psnr: float


@dataclass(frozen=True)
class SceneReport(SceneScore):
    """The error and the size of a model.

    Attributes:
        bytes: Size of its file.
        cr, cr_disk: 1 less the bits of its textures and factors, and of its file, over all lightmaps' at 48 a texel.
    """

    bytes: int
    cr: float
    cr_disk: float


def evaluate_scene(
    model: SceneModel,
    scene: LightmappedScene,
    *,
    views: int = VIEWS,
    resolution: int = RESOLUTION,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> SceneReport:
    """Compares a model with the original lightmaps.

    Args:
        model, scene: The model, and what it was made of.
        views, resolution, device, progress: As for `compare_scene`.

    Raises:
        WlmError: No such device, another scene, or no view shows a lightmap.
    """
    if model.source != scene.source:
        raise WlmError(f"{scene.name}: expected the scene that the model was made of")
    decoder = Decoder(model, device)
    options = {"views": views, "resolution": resolution, "device": device, "progress": progress}
    score = compare_scene(scene, {"model": decoder.read}, **options)["model"]
    size = model.file_bytes()
    ratios = model.compression_ratio, 1.0 - 8 * size / scene.source_bits
    return SceneReport(**vars(score), bytes=size, cr=ratios[0], cr_disk=ratios[1])


def compare_scene(
    scene: LightmappedScene,
    decoders: Mapping[str, SceneSampler],
    *,
    views: int | Sequence[View | Viewpoint] = VIEWS,
    resolution: int = RESOLUTION,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> dict[str, SceneScore]:
    """Compares any decoders with the original lightmaps.

    Args:
        scene: The scene.
        decoders: By name.
        views: Number of cameras around it, spread evenly, and of views from inside; or the cameras.
        resolution: Pixels along a side of a view.
        device: "cpu" or "cuda:N", where the decoders are called.
        progress: Called with the views done.

    Returns:
        The scores by name.

    Raises:
        WlmError: No such device, a decoder gives NaN or infinity, or no view shows a lightmap.
    """
    device = check_device(device)
    cameras = scene_views(scene, views) if isinstance(views, int) else list(views)
    states, meter = range(len(scene.states)), Meter(progress, "evaluate", len(cameras))
    seen, inside = [], []
    for camera, (_, sheet, uv) in zip(cameras, seen_points(scene, cameras, resolution, device), strict=True):
        if len(sheet):
            seen.append((sheet, uv))
            inside.append(isinstance(camera, Viewpoint))
        if meter.due(len(seen)):
            meter.report(len(seen))
    if not seen:
        raise WlmError(f"{scene.name}: cannot be scored: no camera around it or inside sees a lightmap")
    peaks, psnrs, texels = [], {name: [] for name in decoders}, {name: [] for name in decoders}
    for state in states:  # the light of one at a time
        images = [torch.from_numpy(sheet.frames[state]).to(device) for sheet in scene.sheets]
        lights = [_read(images, sheet, uv) for sheet, uv in seen]
        peak = _peak(lights)
        peaks.append(peak)
        for name, decoder in decoders.items():
            psnrs[name].append(
                [
                    psnr_from_mse(_mse(decoder(uv, sheet, state), light, scene.name, name), peak)
                    for (sheet, uv), light in zip(seen, lights, strict=True)
                ]
            )
            texels[name].append(psnr_from_mse(_texel_mse(scene, images, decoder, state, name), peak))
    height = scene.indoors().height if any(inside) else math.nan
    facts = {"name": scene.name, "views": len(seen), "inside_views": sum(inside), "eye_height": height}
    result, kinds = {}, np.array(inside)
    for name in decoders:
        psnr = np.array(psnrs[name])  # [M, views]
        result[name] = SceneScore(
            **facts,
            psnr=_mean(psnr),
            around_psnr=_mean(psnr[:, ~kinds]),
            inside_psnr=_mean(psnr[:, kinds]),
            psnr_worst=float(np.nanmin(psnr)) if np.isfinite(psnr).any() else math.nan,
            psnr_by_state=tuple(_mean(row) for row in psnr),
            peaks=tuple(peaks),
            texel_psnr=_mean(np.array(texels[name])),
        )
    return result


def _read(images: list[torch.Tensor], sheet: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """The reference: each sheet's lightmap, read bilinearly."""
    light = torch.empty((len(uv), 3), dtype=torch.float32, device=uv.device)
    for number in torch.unique(sheet).tolist():
        at = sheet == number
        light[at] = raster.texture(images[number], uv[at].contiguous())
    return light


def _peak(lights: list[torch.Tensor]) -> float:
    light = torch.cat([each.reshape(-1) for each in lights]).cpu().numpy()
    low, high = float(light.min()), float(light.max())
    return max(min(high, _ABOVE * float(np.percentile(light, _PERCENTILE))) - low, 0.0)


def _mse(light: torch.Tensor, target: torch.Tensor, scene: str, name: str) -> float:
    if not bool(torch.isfinite(light).all()):
        raise WlmError(f"{scene}: {name} decodes to NaN or infinity")
    return float((light.double() - target.double()).square().mean())


def _texel_mse(
    scene: LightmappedScene, images: list[torch.Tensor], decoder: SceneSampler, state: int, name: str
) -> float:
    """Mean squared error of the texels in charts, of all sheets."""
    total, count = 0.0, 0
    for number, sheet in enumerate(scene.sheets):
        height, width = sheet.mesh.mask.shape
        row, column = np.nonzero(sheet.mesh.mask)
        uv = np.stack([(column + 0.5) / width, (row + 0.5) / height], 1).astype(np.float32)
        place = torch.from_numpy(uv).to(images[number].device)
        which = torch.full((len(uv),), number, dtype=torch.int32, device=place.device)
        target = images[number][torch.from_numpy(row), torch.from_numpy(column)]
        total += _mse(decoder(place, which, state), target, scene.name, name) * len(uv)
        count += len(uv)
    return total / count


def _mean(values: np.ndarray) -> float:
    finite = values[np.isfinite(values)]
    return float(finite.mean()) if finite.size else math.nan
