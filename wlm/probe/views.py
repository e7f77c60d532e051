"""Compares pictures of surfaces that probes light (gaussian-probe-compression, table 1): the visible error.

50 viewers stand along a loop through the scene (`camera_path`), each with another direction and a field of view of 90
degrees. They see balls at a subset of the probes, and the scene's mesh if it is given; all surfaces are diffuse and
white. Three kinds of light are compared with the original probes:

- "decoded": the decoded probes;
- "lossless, volume": the original probes, read through a complete cascaded volume around the viewer;
- "decoded, volume": the decoded probes, read in the same way, as an engine would draw them.

A ball is lit by its own probe, or by the volume at its centre. A point of the mesh is lit by the eight nearest probes,
weighted by the inverse square of their distance, or by the volume. The paper reads all light through its volume, and
compares "decoded, volume" with "lossless, volume". Pictures are compared as displayed: at the exposure of the balls
under the original light, with Reinhard's curve, in sRGB.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from trimesh.creation import icosphere

from wlm.errors import WlmError
from wlm.formats.geometry import Geometry
from wlm.interop import check_device
from wlm.metrics import Pictures
from wlm.ops import raster
from wlm.ops.views import clip_from
from wlm.probe.data import ProbeSet
from wlm.probe.places import ball_exposure, ball_radius, nearest_weights
from wlm.probe.sphere import irradiance_weights, sh_count, unit_or_zero
from wlm.probe.volume.cascade import Volume
from wlm.probe.volume.light import StoredLight
from wlm.probe.volume.walk import camera_path, settle
from wlm.system import Meter, OnProgress, Report
from wlm.texels import filmic, to_srgb

VIEWS, RESOLUTION = 50, 128
"""Default number of viewers, and pixels along a side of a view."""

NEIGHBOURS = 8
"""Number of the nearest probes that light a point of the mesh."""

KINDS = ("decoded", "lossless, volume", "decoded, volume")

_BALLS = 256
_SUBDIVISIONS = 2  # of a ball's icosahedron: 162 points
_GOLDEN_ANGLE = math.pi * (3.0 - math.sqrt(5.0))
_DOWN = 0.2  # downward part of the viewing direction
_BUDGET = 1024  # blocks decoded per frame; many, since all are awaited


@dataclass(frozen=True)
class ViewScore(Report):
    """The error of one kind of surface, `drawn`, "balls" or "mesh", under one kind of `light`, one of `KINDS`, in
    `views` pictures that show it. The errors are over the pixels that show the surface, as in `wlm.metrics.Pictures`;
    NaN if no view shows it."""

    drawn: str
    light: str
    views: int
    mse: float
    psnr: float
    ssim: float
    flip: float


def score_views(
    probes: ProbeSet,
    decoded: np.ndarray,
    geometry: Geometry | None = None,
    *,
    views: int = VIEWS,
    resolution: int = RESOLUTION,
    up: int = 1,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> list[ViewScore]:
    """Draws the views and compares them.

    Args:
        probes: The original probes, spherical harmonics.
        decoded: float32 [N, D], all decoded probes.
        geometry: The scene's mesh; None: only balls are drawn.
        views: Number of viewers, at least 1.
        resolution: Pixels along a side, 16 to 4,096.
        up: Index of the axis that points up.
        device: Device of the volumes and of the rasteriser.
        progress: Called about twice a second, with the number of finished views.

    Returns:
        A score for each kind of surface and each kind of light.

    Raises:
        WlmError: A setting is out of its range, a probe's numbers are not spherical harmonics, or the device does not
            exist.
    """
    count, device = sh_count(probes.outputs), check_device(device)
    if count is None:
        raise WlmError(f"{probes.name}: expected spherical harmonics, found {probes.outputs} numbers per probe")
    if views < 1 or not 16 <= resolution <= 4096:
        raise WlmError(f"views: expected at least 1, with 16 to 4096 pixels a side, got {views} with {resolution}")
    live = np.flatnonzero(probes.live)
    scene = _Scene(probes, decoded, live, count, device)
    things = {"balls": ball_mesh(probes.position[live])} | ({} if geometry is None else {"mesh": separate(geometry)})
    exposure = ball_exposure(probes.values[live].reshape(len(live), count, 3))
    errors = {(thing, kind): Pictures(structural=True) for thing in things for kind in KINDS}
    meter = Meter(progress, "views", views)
    for number, (eye, forward) in enumerate(viewers(probes.position[live], views, up)):
        scene.stand(eye)
        for thing, mesh in things.items():
            seen, place, normal, owner = look(mesh, eye, forward, up, resolution, device)
            if not seen.any():
                continue
            first, *others = (shown(light, normal, seen, exposure) for light in scene.lights(place, normal, owner))
            for kind, picture in zip(KINDS, others, strict=True):
                errors[thing, kind].add(first, picture, seen)
        if meter.due(number + 1):
            meter.report(number + 1)
    return [
        ViewScore(thing, kind, error.count, error.mse, error.psnr, error.ssim, error.flip)
        for (thing, kind), error in errors.items()
    ]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles without shared corners, vertex normals float64 [V, 3], and each triangle's live probe (index or -1)."""

    position: np.ndarray
    normal: np.ndarray
    owner: np.ndarray


def ball_mesh(position: np.ndarray) -> Mesh:
    """Returns a mesh of separate balls at a subset of live probes [V, 3], evenly spaced by index."""
    chosen = np.unique(np.linspace(0, len(position) - 1, min(len(position), _BALLS)).astype(int))
    directions = icosphere(subdivisions=_SUBDIVISIONS).triangles.reshape(-1, 3)
    centres = position[chosen]
    points = centres[:, None] + ball_radius(centres) * directions
    owner = chosen.repeat(len(directions) // 3)
    return Mesh(points.reshape(-1, 3), np.tile(directions, (len(chosen), 1)), owner)


def separate(geometry: Geometry) -> Mesh:
    """Returns the triangles of a scene with flat normals and without shared corners."""
    corners = geometry.position.astype(np.float64)[geometry.triangle]
    normal = unit_or_zero(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    return Mesh(corners.reshape(-1, 3), normal.repeat(3, 0), np.full(len(corners), -1))


class _Scene:
    """The original and the decoded probes, each with a cascaded lighting volume around the viewer."""

    def __init__(self, probes: ProbeSet, decoded: np.ndarray, live: np.ndarray, count: int, device: str) -> None:
        self._position, self._count = probes.position[live], count
        self._values = [probes.values[live], np.asarray(decoded, np.float32)[live]]
        self._tree = cKDTree(self._position)
        self._normal = None if probes.normal is None else probes.normal[live]
        self._volumes = [
            Volume(self._position, StoredLight(values, device), normal=self._normal, budget=_BUDGET)
            for values in self._values
        ]

    def stand(self, eye: np.ndarray) -> None:
        """Moves the volumes to a viewer's position."""
        for volume in self._volumes:
            settle(volume, eye)

    def lights(self, place: np.ndarray, normal: np.ndarray, owner: np.ndarray) -> Iterator[np.ndarray]:
        """Yields SH coefficients, float64 [P, C, 3], of the original light and of each of `KINDS`, at points [P, 3] or,
        where `owner` is not -1, at the probes with these indices."""
        ahead = None
        if owner[0] >= 0:
            direct = [values[owner] for values in self._values]
            place = self._position[owner]
            if self._normal is not None:
                ahead = self._normal[owner]
        else:
            if self._normal is not None:
                ahead = normal
            near, weight = nearest_weights(self._tree, place, NEIGHBOURS)
            direct = [np.einsum("pk,pkd->pd", weight, values[near]) for values in self._values]
        for values in (*direct, *(volume.read(place, ahead).values for volume in self._volumes)):
            yield values.reshape(len(place), self._count, 3).astype(np.float64)


def viewers(position: np.ndarray, views: int, up: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields the position and the viewing direction of each viewer, for live probes at positions [V, 3]."""
    plan = [axis for axis in range(3) if axis != up]
    for number, eye in enumerate(camera_path(position, views, up=up)):
        angle = number * _GOLDEN_ANGLE
        forward = np.empty(3)
        forward[plan], forward[up] = [math.cos(angle), math.sin(angle)], -_DOWN
        yield eye, forward


def look(
    mesh: Mesh, eye: np.ndarray, forward: np.ndarray, up: int, resolution: int, device: str
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Renders a mesh from a viewer. Returns the pixels that show it, bool [H, W], and for these P pixels the surface
    points and normals, [P, 3] each, and the indices of the surfaces' probes, [P]."""
    triangle = torch.arange(len(mesh.position), dtype=torch.int32, device=device).reshape(-1, 3)
    clip = torch.tensor(clip_from(mesh.position, eye, forward, up), device=device)
    with torch.no_grad():
        drawn = raster.rasterize(clip, triangle, resolution, resolution)
    number, weight = drawn.triangle.cpu().numpy(), drawn.barycentric.cpu().numpy().astype(np.float64)
    seen = number >= 0
    number, weight = number[seen], weight[seen]
    corner = 3 * number[:, None] + np.arange(3)
    weight = np.concatenate([weight, 1.0 - weight.sum(1, keepdims=True)], 1)[..., None]
    place, normal = ((weight * values[corner]).sum(1) for values in (mesh.position, mesh.normal))
    normal = unit_or_zero(normal)
    # Normals are turned towards the viewer, since a mesh may be wound either way.
    normal *= np.where(((eye - place) * normal).sum(1, keepdims=True) < 0, -1.0, 1.0)
    return seen, place, normal, mesh.owner[number]


def shown(values: np.ndarray, normal: np.ndarray, seen: np.ndarray, exposure: float) -> np.ndarray:
    """Returns a picture, sRGB [H, W, 3], of white diffuse points lit by SH radiance [P, C, 3], at the pixels `seen`;
    the other pixels are black."""
    light = np.einsum("pc,pcd->pd", irradiance_weights(normal, values.shape[1]), values) / math.pi * exposure
    picture = np.zeros((*seen.shape, 3))
    picture[seen] = to_srgb(filmic(np.maximum(light, 0.0)))
    return picture
