"""A rival of neural six-way lightmaps of smoke: a flip book that was baked from one side, shown on a billboard."""

import numpy as np
import torch

from wlm.smoke.camera import Camera
from wlm.smoke.lightmaps import SixWay


def billboard(baked: SixWay, source: Camera, camera: Camera, pivot: np.ndarray) -> SixWay:
    """Shows lightmaps that were baked from one side on a billboard that turns to the camera, as a flip book does.

    The billboard stands at the pivot and always faces the camera, so that a turn about the pivot changes nothing but
    the directions of its axes: the smoke always looks as from the side that was baked. Lights are weighted in the axes
    of the new camera, as engines do.

    Args:
        baked: The lightmaps that were baked for the camera `source`.
        source: Orthographic camera of the bake.
        camera: Orthographic camera that sees the billboard.
        pivot: [3], the point of the world about which the billboard turns: the smoke's centre.

    Returns:
        Lightmaps for `camera`; transparent beyond what was baked.

    Raises:
        ValueError: A camera is in perspective, or the lightmaps aren't those of `source`.
    """
    if source.perspective or camera.perspective:
        raise ValueError("source, camera: expected orthographic cameras for a billboard, got perspective")
    if tuple(baked.lightmaps.shape[1:]) != (source.height, source.width):
        raise ValueError(
            f"baked: expected {source.height} x {source.width} pixels, got {tuple(baked.lightmaps.shape[1:])}"
        )
    if baked.transparency is None:
        raise ValueError("baked: expected six-way lightmaps with their transparency, found none")
    planes = [baked.lightmaps, 1.0 - baked.transparency[None]]
    if baked.emission is not None:
        planes.append(baked.emission[None])
    # Where the new image's pixels lie about the pivot, and what pixel of the baked one lies there.
    (x, y), (x0, y0) = _offset(camera, pivot), _offset(source, pivot)
    columns = (np.arange(camera.width) + 0.5 - 0.5 * camera.width) * camera.pitch - x + x0
    rows = (np.arange(camera.height) + 0.5 - 0.5 * camera.height) * camera.pitch + y - y0
    u = torch.tensor(columns / (0.5 * source.width * source.pitch), dtype=torch.float32)
    v = torch.tensor(rows / (0.5 * source.height * source.pitch), dtype=torch.float32)
    grid = torch.stack(torch.broadcast_tensors(u[None, :], v[:, None]), -1)[None].to(baked.lightmaps.device)
    read = torch.nn.functional.grid_sample(torch.cat(planes)[None], grid, align_corners=False)[0]
    return SixWay(read[:6], 1.0 - read[6], read[7] if baked.emission is not None else None, camera)


def _offset(camera: Camera, pivot: np.ndarray) -> tuple[float, float]:
    """Returns the offset of the pivot from the image centre, to the right and up, in world units."""
    right, up, _ = camera.axes @ (np.asarray(pivot, np.float64) - np.asarray(camera.position, np.float64))
    return float(right), float(up)
