"""Draws a scene with its original and its decoded lightmaps, and their errors."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from wlm.atlas.data import LightmappedScene
from wlm.atlas.evaluation import Sampler, original
from wlm.atlas.views import points_at, visible_uv
from wlm.errors import WlmError
from wlm.ops.views import View
from wlm.view.display import white_of
from wlm.view.pictures import contact_sheet, encode


def draw(
    scene: LightmappedScene,
    samplers: Mapping[str, Sampler],
    view: View,
    resolution: int = 512,
    device: str = "cpu",
    state: int = 0,
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draws a scene from one camera, as `wlm.atlas.evaluation` does.

    Args:
        scene: The scene.
        samplers: Decoders by name.
        view: The camera.
        resolution: Width and height of the picture in pixels.
        device: "cpu" or "cuda:N", the device of the decoders.
        state: The index of the lighting state.

    Returns:
        For each decoder float32 [resolution, resolution, 3], linear light, 0 where no lightmap is visible; and bool
        [resolution, resolution], true where one is visible.
    """
    hit, points = points_at(scene, *next(iter(visible_uv(scene, [view], resolution, device))))
    pictures = {}
    for name, sampler in samplers.items():
        picture = torch.zeros((*hit.shape, 3), dtype=torch.float32, device=hit.device)
        picture[hit] = sampler(points, state).float()
        pictures[name] = picture.cpu().numpy()
    return pictures, hit.cpu().numpy()


def comparison(
    path: str | os.PathLike[str],
    scene: LightmappedScene,
    samplers: Mapping[str, Sampler],
    views: Sequence[View],
    *,
    resolution: int = 512,
    gain: float = 8.0,
    device: str = "cpu",
) -> None:
    """Writes a contact sheet: one row per view with the original, each decoder, and each decoder's absolute error.

    All pictures share one exposure: the 99.5th percentile of the original over all views is white. Light is shown in
    sRGB. Errors are linear and multiplied by a gain. Each view is cropped to the mesh.

    Args:
        path: The PNG to write; its folder must exist.
        scene: The scene with its original lightmaps.
        samplers: Decoders by name, at least one; none is called "original".
        views: The cameras, at least one.
        resolution: Pixels along a side of a view before it is cropped.
        gain: Factor on errors.
        device: "cpu" or "cuda:N", the decoders' device.

    Raises:
        ValueError: There is no decoder or no view.
        WlmError: The mesh is visible in no view, or the file cannot be written.
    """
    if not samplers or not views:
        raise ValueError("samplers, views: expected at least one decoder and one view, found none")
    drawn = {}
    for number, view in enumerate(views, 1):
        pictures, hit = draw(scene, {"original": original(scene, device), **samplers}, view, resolution, device)
        if hit.any():
            lines = hit.any(axis=1), hit.any(axis=0)
            window = tuple(slice(int(line.argmax()), len(line) - int(line[::-1].argmax())) for line in lines)
            drawn[f"view {number}"] = {name: picture[window] for name, picture in pictures.items()}, hit[window]
    if not drawn:
        raise WlmError(f"{scene.name}: cannot draw it: no camera shows a surface that has a lightmap")
    white = white_of(np.concatenate([pictures["original"][hit] for pictures, hit in drawn.values()]))
    rows = {}
    for label, (pictures, hit) in drawn.items():
        light = [encode(picture, hit, white) for picture in pictures.values()]
        errors = (np.abs(pictures[name] - pictures["original"]) * gain for name in samplers)
        rows[label] = light + [encode(error, hit, white) for error in errors]
    titles = ["original", *samplers, *(f"error x {gain:g}, {name}" for name in samplers)]
    contact_sheet(path, rows, titles, columns=len(titles))
