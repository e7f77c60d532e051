"""New UVs in which triangles share texels, and the lightmap under them (lightmap-uv-clustering-cascade, 3.3.1).

The members of a group take the corners of its representative, so the texels of the others aren't needed any more.
Representatives that share an edge under the old UVs stay together in one chart. A chart moves rigidly: it is turned and
shifted, never stretched and never mirrored, and all are scaled by one epsilon, in texels. ``uvunwrap`` finds the
places, and as it answers in float32, each chart's rigid motion is taken from its answer by least squares and then
applied exactly.

Where the paper is silent: charts with two texels between them (``padding`` around each), so that a bilinear read in one
never meets a texel of another; a triangle that is too thin for the packer gets a place of its own, half a texel high.
The atlas is as large as its charts need, W_r x H_r of eq. 9, be that less or more than epsilon W x epsilon H.

The stated behaviours:

================================================  ===============================================================
input                                             behaviour
================================================  ===============================================================
a triangle that isn't ``active``                  no texels; it reads one place of a neighbour's, or else the first
a triangle smaller than a texel                   its own size, in the texels that it touches
triangles that fold over each other in a chart    apart, as charts of their own
three and more triangles at one edge              apart, as charts of their own; grouped first if they look alike
an atlas of over 16,384 texels along a side       error
================================================  ===============================================================
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from wlm.atlas.charts import charts, welded
from wlm.atlas.cluster import ORDERS, Clusters
from wlm.atlas.data import LightmappedMesh
from wlm.errors import WlmError
from wlm.ops.raster import rasterize_uv, texture
from wlm.texels import fill_gaps

__all__ = ["Packed", "pack", "regenerate"]

_MOST = 16384  # texels that can be drawn along a side
_STRETCH = 1e-2  # texels that the packer may move a corner against the rest of its chart: it works in float32
_THIN = 0.5
_FEW = 4096  # charts; more are packed by their boxes, a tenth of the time and, as small as they then are, no larger
# Two charts that are two texels apart would both touch the texel's edge between them, in float32.
_REACH = 1.0 - 1e-3


@dataclass(frozen=True, eq=False)
class Packed:
    """New UVs of F triangles.

    Attributes:
        height, width: H_r and W_r, texels of the atlas.
        corner: float64 [F, 3, 2], the corners' new places in texels, x and y; the first texel's outer corner is 0.
        uv: float32 [F, 3, 2], the same over (W_r, H_r).
        source: int32 [F], the triangle whose texels each one reads: itself, or its representative; -1 where it isn't
            active.
        chart: int32 [F], the new chart of these texels, -1 where it isn't active.
        back: float64 [C, 2, 3], for each chart the way from (x, y, 1) in texels of the atlas to x and y in texels of
            the lightmap.
    """

    height: int
    width: int
    corner: np.ndarray
    uv: np.ndarray
    source: np.ndarray
    chart: np.ndarray
    back: np.ndarray


def pack(mesh: LightmappedMesh, clusters: Clusters | None, scale: float, *, padding: int = 1) -> Packed:
    """Gives the mesh new UVs in which the triangles of a group share texels.

    Args:
        mesh: The mesh.
        clusters: Its groups; None: no triangle shares.
        scale: epsilon, texels of the atlas over those of the lightmap, along a side.
        padding: Texels around each chart, at least 1.

    Returns:
        The new UVs.

    Raises:
        WlmError: ``uvunwrap`` isn't installed or fails, or the atlas gets too large.
        ValueError: ``scale`` isn't above 0, ``padding`` is below 1, or the groups are of another mesh.
    """
    if not 0.0 < scale < math.inf:
        raise ValueError(f"scale: expected above 0, got {scale}")
    if padding < 1:
        raise ValueError(f"padding: expected at least 1, got {padding}")
    count = len(mesh.triangle)
    source, order = np.arange(count, dtype=np.int32), np.zeros((count, 3), np.int64) + np.arange(3)
    if clusters is not None:
        if len(clusters.group) != count:
            raise ValueError(f"clusters: expected {count} triangles, got {len(clusters.group)}")
        source = clusters.representative[clusters.group].astype(np.int32)
        order = np.array(ORDERS)[clusters.order]
    source = np.where(mesh.active, source, -1).astype(np.int32)

    height, width = mesh.mask.shape
    numbers = welded(mesh.position, mesh.uv, mesh.triangle)
    old = (mesh.uv * [width, height])[mesh.triangle]
    own = np.flatnonzero(source == np.arange(count))
    part, turn, shift, size = _placed(mesh.name, old[own], numbers[own], scale, padding)

    chart = np.full(count, -1, np.int32)
    chart[own] = part
    corner = np.zeros((count, 3, 2))
    corner[own] = _pairs(turn[part, None] * _complex(old[own]) + shift[part, None])
    shared = source >= 0
    corner[shared] = np.take_along_axis(corner[source[shared]], order[shared, :, None], 1)
    chart[shared] = chart[source[shared]]
    _lend(corner, numbers, shared)

    inverse = 1.0 / turn
    along = -inverse * shift
    back = np.stack(
        [
            np.stack([inverse.real, -inverse.imag, along.real], -1),
            np.stack([inverse.imag, inverse.real, along.imag], -1),
        ],
        axis=1,
    )
    uv = (corner / size).astype(np.float32).clip(0.0, 1.0)
    return Packed(int(size[1]), int(size[0]), corner, uv, source, chart, back)


def regenerate(mesh: LightmappedMesh, packed: Packed, device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    """Fills the atlas: each texel that a bilinear read of a chart can meet takes the lightmap's colour at its place.

    Inside a triangle that is the place with the same barycentrics, the paper's three steps. As a chart moved rigidly,
    that place is the same for all its triangles and goes on beyond its border; there the lightmap's gaps are filled.

    Args:
        mesh: The mesh.
        packed: Its new UVs.
        device: "cpu" or "cuda:N".

    Returns:
        float32 [H_r, W_r, 3], linear, 0 where no chart is; and bool [H_r, W_r], where one is.
    """
    height, width = packed.height, packed.width
    own = np.flatnonzero(packed.source == np.arange(len(packed.source)))
    outline = _grown(packed.corner[own])  # [N, 7, 2]
    fan = np.array([[0, k, k + 1] for k in range(1, 6)])
    triangle = (7 * np.arange(len(own))[:, None, None] + fan).reshape(-1, 3)
    points = torch.tensor((outline / [width, height]).reshape(-1, 2), dtype=torch.float32, device=device)
    seen = rasterize_uv(points, torch.tensor(triangle, device=device), height, width).triangle.cpu().numpy()
    mask = seen >= 0
    row, column = np.nonzero(mask)
    back = packed.back[packed.chart[own[seen[mask] // len(fan)]]]
    place = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], -1)
    uv = (back @ place[:, :, None])[:, :, 0] / mesh.mask.shape[::-1]
    image = torch.tensor(fill_gaps(mesh.lightmap, mesh.mask), device=device)
    out = np.zeros((height, width, 3), np.float32)
    out[mask] = texture(image, torch.tensor(uv, dtype=torch.float32, device=device)).cpu().numpy()
    return out, mask


def _placed(
    name: str, old: np.ndarray, numbers: np.ndarray, scale: float, padding: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Finds a place for each chart.

    Args:
        name: Of the mesh, for messages.
        old: float64 [N, 3, 2], corners in texels of the lightmap.
        numbers: int [N, 3], of the corners, one where they are one.
        scale, padding: As for ``pack``.

    Returns:
        int [N], the chart of each triangle; complex [C] twice, its motion, as ``_motions``; float64 [2], W_r and H_r.
    """
    label = charts(numbers)
    # Counter-clockwise, as else it would be mirrored.
    turned = np.where((_signed_area(old) < 0)[:, None], [0, 2, 1], [0, 1, 2])
    numbers = np.take_along_axis(numbers, turned, 1)
    points = np.take_along_axis(old, turned[..., None], 1)
    place, part, placed, size = _uvunwrap(name, points, numbers, label, scale, padding)
    thin = part < 0
    if thin.any():
        # Each gets a triangle that holds it, with numbers of its own.
        points[thin] = _stand_in(points[thin], _THIN / scale)
        extra = np.arange(int(thin.sum()))
        numbers[thin] = numbers.max() + 1 + np.arange(3 * len(extra)).reshape(-1, 3)
        label[thin] = label.max() + 1 + extra
        place, part, placed, size = _uvunwrap(name, points, numbers, label, scale, padding)
    if (part < 0).any():
        raise WlmError(f"{name}: uvunwrap left out {np.count_nonzero(part < 0)} triangles: expected a place for each")
    turn, shift = _motions(name, points[placed], place[placed], part[placed], scale)
    return part, turn, shift, size


def _uvunwrap(
    name: str, points: np.ndarray, numbers: np.ndarray, label: np.ndarray, scale: float, padding: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Asks the packer, which leaves out what is too thin for it.

    Returns:
        float64 [N, 3, 2], new corners in texels; int [N], the chart, also of a triangle that was left out of one, -1
        where there is none; bool [N], whether it has new corners; float64 [2], W_r and H_r.
    """
    try:
        import uvunwrap
    except ImportError as error:
        raise WlmError("packing UVs needs uvunwrap: install the extra 'atlas'") from error
    if not len(points):
        return np.zeros((0, 3, 2)), np.zeros(0, np.int64), np.zeros(0, bool), np.ones(2)
    order, meshes = _chart_meshes(points, numbers, label)
    try:
        made = uvunwrap.generate(
            [uvunwrap.Mesh(vertex, triangle, existing_uvs=uv) for vertex, triangle, uv in meshes],
            page_size=None,
            texels_per_unit=scale,
            padding=padding,
            packing="shape" if len(meshes) <= _FEW else "fast",
            max_chart_angle=89.0,
            max_area_distortion=1e9,
        )
    except uvunwrap.UnwrapError as error:
        raise WlmError(f"{name}: uvunwrap: {error}") from error
    place, of = np.empty((len(points), 3, 2)), np.empty((len(points), 3), np.int64)
    place[order] = np.concatenate([np.asarray(each.corner_uvs, np.float64) for each in made.meshes]).reshape(-1, 3, 2)
    place *= [made.width, made.height]
    of[order] = np.concatenate(
        [np.asarray(each.chart, np.int64)[np.asarray(each.indices)] for each in made.meshes]
    ).reshape(-1, 3)
    part = np.where((of == of[:, :1]).all(1), of[:, 0], -1)
    # One that was left out has all its corners at one point.
    placed = (part >= 0) & (place != place[:, :1]).any((1, 2))
    there = np.unique(part[placed])
    part = np.where(np.isin(part, there), np.searchsorted(there, part), -1)
    # The page may be larger than what is on it.
    size = np.ceil(place[placed].reshape(-1, 2).max(0, initial=0.0) + padding - 1e-3)
    if size.max() > _MOST:
        found = f"{size[0]:.0f}x{size[1]:.0f}"
        raise WlmError(f"{name}: the packed lightmap: expected at most {_MOST} texels along a side, got {found}")
    return place, part, placed, size


def _chart_meshes(
    points: np.ndarray, numbers: np.ndarray, label: np.ndarray
) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Makes each chart a flat mesh from its own corner.

    In one mesh charts that meet at a place would be joined, and how thin a triangle may be and how fine float32 is goes
    by a mesh's extent.

    Returns:
        The triangles [N] in the order of the meshes, and for each chart: float32 [v, 3], places; uint32 [f, 3];
        float32 [v, 2], the same places as UVs.
    """
    charts = np.arange(int(label.max()) + 2)
    low = np.full((len(charts) - 1, 2), np.inf)
    np.minimum.at(low, label, points.min(1))
    key = label[:, None].astype(np.int64) * (int(numbers.max()) + 1) + numbers
    _, first, vertex = np.unique(key, return_index=True, return_inverse=True)
    uv = (points - low[label, None]).reshape(-1, 2)[first].astype(np.float32)
    place = np.concatenate([uv, np.zeros((len(uv), 1), np.float32)], 1)
    vertices = np.searchsorted(label[first // 3], charts)
    order = np.argsort(label, kind="stable")
    triangles = np.searchsorted(label[order], charts)
    triangle = (vertex.reshape(-1, 3) - vertices[label, None])[order].astype(np.uint32)
    parts = [(slice(*vertices[i : i + 2]), slice(*triangles[i : i + 2])) for i in charts[:-1]]
    return order, [(place[v], triangle[t], uv[v]) for v, t in parts]


def _motions(
    name: str, old: np.ndarray, place: np.ndarray, part: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """The rigid motion of each chart as a complex map, x + iy to turn (x + iy) + shift: complex [C] each."""
    before, after = _complex(old).reshape(-1), _complex(place).reshape(-1)
    chart = np.repeat(part, 3)
    count = int(chart.max(initial=-1)) + 1

    def sums(values: np.ndarray) -> np.ndarray:
        return np.bincount(chart, values.real, count) + 1j * np.bincount(chart, values.imag, count)

    corners = np.bincount(chart, minlength=count)
    centre, goal = sums(before) / corners, sums(after) / corners
    turn = sums(np.conj(before - centre[chart]) * (after - goal[chart]))
    size = np.abs(turn)
    turn = np.where(size > 0, turn / np.where(size > 0, size, 1.0), 1.0) * scale
    shift = goal - turn * centre
    off = np.abs(turn[chart] * before + shift[chart] - after).max(initial=0.0)
    if off > _STRETCH:
        raise WlmError(f"{name}: uvunwrap stretched a chart by {off:.3g} texels: expected at most {_STRETCH}")
    return turn, shift


def _lend(corner: np.ndarray, numbers: np.ndarray, active: np.ndarray) -> None:
    """Gives each triangle [F] that isn't active one place, that of an active triangle's corner where one of its is."""
    if active.all():
        return
    known = np.full(int(numbers.max()) + 1, -1)
    known[numbers[active].reshape(-1)] = np.flatnonzero(np.repeat(active, 3))
    found = known[numbers[~active]].max(1)
    place = np.where(found[:, None] >= 0, corner.reshape(-1, 2)[found], 0.0)
    corner[~active] = place[:, None]


def _stand_in(points: np.ndarray, height: float) -> np.ndarray:
    """Right triangles [N, 3, 2] of at least this height and as long, each with a thin triangle [N, 3, 2] in it."""
    out = np.empty_like(points)
    for i, corner in enumerate(points):
        ends = [(corner[k], corner[(k + 1) % 3]) for k in range(3)]
        start, end = max(ends, key=lambda pair: np.hypot(*(pair[1] - pair[0])))
        length = math.hypot(*(end - start))
        along = (end - start) / length if length > 0 else np.array([1.0, 0.0])
        across = np.array([-along[1], along[0]])
        low = ((corner - start) @ across).min()
        base = start + low * across
        out[i] = base, base + max(length, height) * along, base + height * across
    return out


def _grown(corner: np.ndarray) -> np.ndarray:
    """The outlines of triangles [N, 3, 2], each grown by a square of one texel to all sides: [N, 7, 2].

    A bilinear read at a point meets the texels whose centres are less than one texel away along both axes, so these
    are the centres within the sum of the triangle and that square. Its edges are theirs, sorted by direction.
    """
    flip = _signed_area(corner) < 0
    ring = np.where(flip[:, None, None], corner[:, ::-1], corner)
    square = _REACH * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    edge = np.roll(ring, -1, 1) - ring
    sides = np.broadcast_to(np.roll(square, -1, 0) - square, (len(corner), 4, 2))
    every = np.concatenate([edge, sides], 1)
    every = np.take_along_axis(every, np.argsort(np.arctan2(every[..., 1], every[..., 0]), 1)[..., None], 1)
    # It may start anywhere: its lowest x and y are those of the two.
    walk = np.cumsum(every, 1)
    return walk - walk.min(1, keepdims=True) + (ring.min(1, keepdims=True) - _REACH)


def _signed_area(corner: np.ndarray) -> np.ndarray:
    """Twice the areas of triangles [N, 3, 2], positive where they turn from x to y."""
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return one[:, 0] * two[:, 1] - one[:, 1] * two[:, 0]


def _complex(points: np.ndarray) -> np.ndarray:
    return points[..., 0] + 1j * points[..., 1]


def _pairs(values: np.ndarray) -> np.ndarray:
    return np.stack([values.real, values.imag], -1)
