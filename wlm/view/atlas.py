"""Pictures of a mesh under its lightmap: the original, decoded ones, and their errors."""

import os
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from wlm.atlas.data import LightmappedMesh
from wlm.atlas.evaluation import Sampler
from wlm.atlas.views import corner_weights, visible_uv
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.ops import raster
from wlm.ops.views import View
from wlm.view.display import white_of
from wlm.view.pictures import contact_sheet, encode


def original(mesh: LightmappedMesh, device: str = "cpu") -> Sampler:
    """The input lightmap as a decoder: it is read bilinearly, with the gaps between charts filled."""
    image = torch.from_numpy(mesh.filled).to(check_device(device))

    def sample(uv: torch.Tensor, triangle: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
        return raster.texture(image, uv)

    return sample


def draw(
    mesh: LightmappedMesh, samplers: Mapping[str, Sampler], view: View, resolution: int = 512, device: str = "cpu"
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Draws a mesh from one camera, as `wlm.atlas.evaluation` does.

    Args:
        mesh: The mesh.
        samplers: Decoders by name.
        view: The camera.
        resolution: Pixels along a side.
        device: "cpu" or "cuda:N", the decoders' device.

    Returns:
        For each decoder float32 [resolution, resolution, 3], linear light, 0 outside the mesh; and bool [resolution,
        resolution], true where the mesh is visible.
    """
    visible, barycentric, uv = next(iter(visible_uv(mesh, [view], resolution, device)))
    hit = visible >= 0
    weight = corner_weights(barycentric[hit])
    pictures = {}
    for name, sampler in samplers.items():
        picture = torch.zeros((*visible.shape, 3), dtype=torch.float32, device=visible.device)
        picture[hit] = sampler(uv[hit], visible[hit], weight).float()
        pictures[name] = picture.cpu().numpy()
    return pictures, hit.cpu().numpy()


def comparison(
    path: str | os.PathLike[str],
    mesh: LightmappedMesh,
    samplers: Mapping[str, Sampler],
    views: Sequence[View],
    *,
    resolution: int = 512,
    gain: float = 8.0,
    device: str = "cpu",
) -> None:
    """Writes a contact sheet: one row per view with the original, each decoder, and each decoder's absolute error.

    All share one exposure: the 99.5th percentile of the original over all views is white, and light is encoded as sRGB.
    Errors are linear and multiplied by a gain. Each view is cropped to the mesh.

    Args:
        path: The PNG to write; its folder must exist.
        mesh: The mesh with its original lightmap.
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
        raise ValueError("expected at least one decoder and one view")
    drawn = {}
    for number, view in enumerate(views, 1):
        pictures, hit = draw(mesh, {"original": original(mesh, device), **samplers}, view, resolution, device)
        if hit.any():
            lines = hit.any(axis=1), hit.any(axis=0)
            window = tuple(slice(int(line.argmax()), len(line) - int(line[::-1].argmax())) for line in lines)
            drawn[f"view {number}"] = {name: picture[window] for name, picture in pictures.items()}, hit[window]
    if not drawn:
        raise WlmError(f"{mesh.name}: cannot draw it: it is visible in no view")
    white = white_of(np.concatenate([pictures["original"][hit] for pictures, hit in drawn.values()]))
    rows = {}
    for label, (pictures, hit) in drawn.items():
        light = [encode(picture, hit, white) for picture in pictures.values()]
        errors = (np.abs(pictures[name] - pictures["original"]) * gain for name in samplers)
        rows[label] = light + [encode(error, hit, white) for error in errors]
    titles = ["original", *samplers, *(f"error × {gain:g}, {name}" for name in samplers)]
    contact_sheet(path, rows, titles, columns=len(titles))
