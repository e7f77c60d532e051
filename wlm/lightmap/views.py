"""Views of a set's mesh under the decoded light and under the original.

Cameras are spread evenly on a sphere around the mesh (`wlm.ops.views`), each at one of the set's times in turn. What is
seen from behind isn't drawn, so that a room is seen through its walls. A pixel is the lightmap's light at its surface
point, read bilinearly, without any shading; the original's gaps between charts are filled. Both are shown alike: the
exposure of that time, from the original's valid texels (`wlm.texels.exposure`), Reinhard's curve, sRGB. Pixels without
a surface are black in both, and don't count.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm import system
from wlm.errors import WlmError
from wlm.formats.geometry import Geometry, read_geometry
from wlm.interop import check_device
from wlm.lightmap.data import LightmapSet
from wlm.metrics import Pictures
from wlm.ops import raster
from wlm.ops.views import sphere_views, visible_points
from wlm.texels import exposure, filmic, to_srgb

VIEWS, RESOLUTION = 50, 512
"""Cameras of a score, and pixels along a side of a view."""


@dataclass(frozen=True)
class ViewScore(system.Report):
    """The error in views, see `wlm.lightmap.views`. Without a view that shows the mesh it is NaN or None.

    Attributes:
        views: Number of views that show the mesh.
        view_psnr: dB, of the shown colours in [0, 1], over the covered pixels of all views.
        view_flip: FLIP of the views, mean over the covered pixels of all views, in [0, 1].
        worst_view: That with the lowest PSNR: `view` (its number), `time`, `psnr`, `flip`.
    """

    views: int
    view_psnr: float
    view_flip: float
    worst_view: dict[str, float | int] | None


NO_VIEWS = ViewScore(0, math.nan, math.nan, None)
"""The score of a set without a mesh."""


class Views:
    """Adds up the error in views, time by time."""

    def __init__(
        self,
        lightmaps: LightmapSet,
        geometry: Geometry,
        count: int,
        indices: Sequence[int] | np.ndarray | None = None,
        device: str = "cpu",
    ) -> None:
        """Places the cameras.

        Args:
            lightmaps: The set, for its times, its mask and the exposures.
            geometry: Its mesh, with UVs.
            count: Number of cameras.
            indices: Of the times that will be added; None: all.
            device: Where views are drawn: "cpu", "cuda" or "cuda:N".

        Raises:
            WlmError: There is no such device, or the mesh is a point.
        """
        self._lightmaps, self._geometry, self._device = lightmaps, geometry, check_device(device)
        low, high = geometry.box
        if not (high > low).any():
            raise WlmError("expected a mesh with a size, found all of its corners in one place")
        times = range(len(lightmaps.times)) if indices is None else [int(index) for index in indices]
        self._cameras: dict[int, list[int]] = {index: [] for index in times}
        for number in range(count):
            self._cameras[times[number % len(times)]].append(number)
        self._views = sphere_views(count)
        self._rows: list[dict[str, float | int]] = []
        self._pictures = Pictures()

    def add(self, index: int, original: np.ndarray, decoded: np.ndarray) -> None:
        """Draws the views of a time.

        Args:
            index: Of the time.
            original: Linear radiance, float32 [H, W, 3], its gaps filled.
            decoded: Likewise, as decoded.
        """
        numbers = self._cameras[index]
        if not numbers:
            return
        gain = np.float32(exposure(self._lightmaps.frames[index][self._lightmaps.mask]))
        images = [torch.tensor(image, device=self._device) for image in (original, decoded)]
        mesh, cameras = self._geometry, [self._views[number] for number in numbers]
        drawn = visible_points(mesh.position, mesh.triangle, mesh.uv, cameras, RESOLUTION, self._device, cull=True)
        for number, (visible, _, uv) in zip(numbers, drawn, strict=True):
            hit = (visible >= 0).cpu().numpy()
            pictures = []
            for image in images:
                light = raster.texture(image, uv).cpu().numpy() * gain
                pictures.append(to_srgb(filmic(np.maximum(light, 0.0))) * hit[..., None])
            figures = self._pictures.add(*pictures, hit)
            if figures is not None:
                self._rows.append({"view": number, "time": float(self._lightmaps.times[index])} | figures)

    def score(self) -> ViewScore:
        """The score of what was added."""
        if not self._rows:
            return NO_VIEWS
        worst = min(self._rows, key=lambda row: row["psnr"])
        return ViewScore(len(self._rows), self._pictures.psnr, self._pictures.flip, worst)


def views_of(
    lightmaps: LightmapSet, count: int, indices: Sequence[int] | np.ndarray | None = None, device: str = "cpu"
) -> tuple[Views | None, list[str]]:
    """Makes the views of a set that names a mesh.

    Args:
        lightmaps, count, indices, device: As for `Views`.

    Returns:
        The views, None without a mesh or with a count of 0; and a line where the mesh can't be read.

    Raises:
        WlmError: A negative count, or there is no such device.
    """
    if count < 0:
        raise WlmError(f"views: expected at least 0, got {count}")
    if lightmaps.mesh is None or count == 0:
        return None, []
    device = check_device(device)
    try:
        return Views(lightmaps, read_geometry(lightmaps.mesh), count, indices, device), []
    except WlmError as error:
        return None, [f"{lightmaps.name}: no views are scored: {error}"]
