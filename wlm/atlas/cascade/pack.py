"""New UVs in which triangles share texels, and the lightmap under them (lightmap-uv-clustering-cascade, 3.3.1).

The triangles of a group take the UVs of its representative, so their own texels are dropped. Representatives that share
an edge under the old UVs stay together in one chart. A chart moves rigidly: it is rotated and translated, never
stretched and never mirrored, and all charts are scaled by one epsilon, in texels. `uvunwrap` packs them in float32;
each chart's rigid motion is fitted to its result by least squares and then applied exactly.

The paper leaves two points open. Here charts have two texels between them (one around each), so that a bilinear read in
one never reads another's texel, and a triangle that is too thin for the packer gets a chart of its own, half a texel
high. The atlas has the size that its charts need, W_r x H_r texels (eq. 9), and not exactly the lightmap's size times
epsilon.

A triangle that isn't `active` takes no texels: it reads one point of an active neighbour, or (0, 0) if it has none.
Triangles that fold over each other in a chart, or of which three or more share an edge, are in separate charts.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch

from wlm.atlas.cascade.cluster import Clusters
from wlm.atlas.charts import charts, welded
from wlm.atlas.data import Sheet
from wlm.errors import WlmError
from wlm.formats.hdr_blocks import need
from wlm.ops.raster import rasterize_uv, texture
from wlm_kernels.atlas.patches import ORDERS

_PADDING = 1  # texels around each chart
_MOST = 16384  # texels that can be drawn along a side
_STRETCH = 1e-2  # texels by which the packer, in float32, may deviate from a rigid motion
_THIN = 0.5  # texels: height of the place of a triangle that is too thin for the packer
_FEW = 4096  # charts; more than these are packed as boxes, in a tenth of the time and without more waste
# This is less than a texel: otherwise float32 rounding lets two charts two texels apart touch the centre between.
_REACH = 1.0 - 1e-3


@dataclass(frozen=True, eq=False)
class Packed:
    """New UVs of F triangles.

    Attributes:
        height, width: H_r and W_r, texels of the atlas.
        corner: float64 [F, 3, 2], the corners' new x and y in texels, from the outer corner of the first texel.
        uv: float32 [F, 3, 2], the corners' new UVs: `corner` divided by width and height.
        source: int32 [F], the number of the triangle whose texels each triangle reads: its own or its representative's;
            -1 for a triangle that isn't active.
        chart: int32 [F], the new chart that each triangle reads; -1 for a triangle that isn't active.
        rotation, shift: complex128 [C], the rigid motion of each chart: z = x + iy in texels of the lightmap goes
            to rotation * z + shift in texels of the atlas; |rotation| is the scale.
    """

    height: int
    width: int
    corner: np.ndarray
    uv: np.ndarray
    source: np.ndarray
    chart: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray


def pack(sheet: Sheet, clusters: Clusters | None, scale: float) -> Packed:
    """Gives the mesh new UVs in which the triangles of a group share texels; `scale` is epsilon, texels of the atlas
    per texel of the lightmap along a side."""
    if not 0.0 < scale < math.inf:
        raise ValueError(f"scale: expected a number above 0, got {scale}")
    count = len(sheet.triangle)
    source, order = np.arange(count, dtype=np.int32), np.zeros((count, 3), np.int64) + np.arange(3)
    if clusters is not None:
        if len(clusters.group) != count:
            raise ValueError(f"clusters: expected groups of {count} triangles, got those of {len(clusters.group)}")
        source = clusters.representative[clusters.group].astype(np.int32)
        order = np.array(ORDERS)[clusters.order]
    source = np.where(sheet.active, source, -1).astype(np.int32)

    height, width = sheet.mask.shape
    numbers = welded(sheet.position, sheet.uv, sheet.triangle)
    old = (sheet.uv * [width, height])[sheet.triangle]
    heads = np.flatnonzero(source == np.arange(count))  # triangles that keep their texels
    head_chart, rotation, shift, size = _pack_charts(sheet.name, old[heads], numbers[heads], scale)

    chart = np.full(count, -1, np.int32)
    chart[heads] = head_chart
    corner = np.zeros((count, 3, 2))
    corner[heads] = _real(rotation[head_chart, None] * _complex(old[heads]) + shift[head_chart, None])
    active = source >= 0
    corner[active] = np.take_along_axis(corner[source[active]], order[active, :, None], 1)
    chart[active] = chart[source[active]]
    _place_inactive(corner, numbers, active)

    uv = (corner / size).astype(np.float32).clip(0.0, 1.0)
    return Packed(int(size[1]), int(size[0]), corner, uv, source, chart, rotation, shift)


def regenerate(sheet: Sheet, packed: Packed, device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    """Renders the new lightmap: each texel that a bilinear read of a chart can reach takes the lightmap's colour at
    that place. A point in a triangle takes the colour at the same barycentric coordinates in the old UVs, as in the
    paper. Since a chart moves rigidly, one map converts all its points, also those just beyond its border.
    Returns float32 [H_r, W_r, 3], linear, 0 outside of charts; and bool [H_r, W_r], true in charts."""
    height, width = packed.height, packed.width
    heads = np.flatnonzero(packed.source == np.arange(len(packed.source)))
    outline = _dilated(packed.corner[heads])  # [N, 7, 2]
    fan = np.array([[0, k, k + 1] for k in range(1, 6)])
    triangle = (7 * np.arange(len(heads))[:, None, None] + fan).reshape(-1, 3)
    points = torch.tensor((outline / [width, height]).reshape(-1, 2), dtype=torch.float32, device=device)
    fans = rasterize_uv(points, torch.tensor(triangle, device=device), height, width).triangle.cpu().numpy()
    mask = fans >= 0
    row, column = np.nonzero(mask)
    chart = packed.chart[heads[fans[mask] // len(fan)]]
    old = (column + 0.5 + 1j * (row + 0.5) - packed.shift[chart]) / packed.rotation[chart]
    uv = _real(old) / sheet.mask.shape[::-1]
    image = torch.tensor(sheet.lightmap, device=device)
    out = np.zeros((height, width, 3), np.float32)
    out[mask] = texture(image, torch.tensor(uv, dtype=torch.float32, device=device)).cpu().numpy()
    return out, mask


def _pack_charts(
    name: str, old: np.ndarray, numbers: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Packs the charts of N triangles, whose corners [N, 3, 2] are in texels of the lightmap; corners with equal
    `numbers` [N, 3] coincide. Returns each triangle's chart, int [N]; the rotation (times the scale) and the shift of
    each of C charts, complex [C] each; and the atlas's width and height in texels."""
    label = charts(numbers)
    # Triangles are made counter-clockwise, since the packer would mirror clockwise ones.
    winding = np.where((_signed_area(old) < 0)[:, None], [0, 2, 1], [0, 1, 2])
    numbers = np.take_along_axis(numbers, winding, 1)
    points = np.take_along_axis(old, winding[..., None], 1)
    place, chart, placed, size = _uvunwrap(name, points, numbers, label, scale)
    thin = chart < 0
    if thin.any():
        # Each becomes a separate chart: a larger triangle that contains it.
        points[thin] = _thickened(points[thin], _THIN / scale)
        extra = np.arange(int(thin.sum()))
        numbers[thin] = numbers.max() + 1 + np.arange(3 * len(extra)).reshape(-1, 3)
        label[thin] = label.max() + 1 + extra
        place, chart, placed, size = _uvunwrap(name, points, numbers, label, scale)
    if (chart < 0).any():
        raise WlmError(f"{name}: the UV packer uvunwrap left out {np.count_nonzero(chart < 0)} triangles")
    rotation, shift = _motions(name, points[placed], place[placed], chart[placed], scale)
    return chart, rotation, shift, size


def _uvunwrap(
    name: str, points: np.ndarray, numbers: np.ndarray, label: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Calls the packer `uvunwrap`, which leaves out triangles that are too thin for it. Returns new corners in texels,
    float64 [N, 3, 2]; each triangle's chart, int [N], -1 if it has none; whether the triangle has new corners, bool
    [N]; and the atlas's width and height in texels."""
    uvunwrap = need("uvunwrap", "atlas")
    if not len(points):
        return np.zeros((0, 3, 2)), np.zeros(0, np.int64), np.zeros(0, bool), np.ones(2)
    order, meshes = _chart_meshes(points, numbers, label)
    try:
        atlas = uvunwrap.generate(
            [uvunwrap.Mesh(vertex, triangle, existing_uvs=uv) for vertex, triangle, uv in meshes],
            page_size=None,
            texels_per_unit=scale,
            padding=_PADDING,
            packing="shape" if len(meshes) <= _FEW else "fast",
            max_chart_angle=89.0,
            max_area_distortion=1e9,
        )
    except uvunwrap.UnwrapError as error:
        raise WlmError(f"{name}: the UV packer uvunwrap failed: {error}") from error
    place, corner_chart = np.empty((len(points), 3, 2)), np.empty((len(points), 3), np.int64)
    place[order] = np.concatenate([np.asarray(each.corner_uvs, np.float64) for each in atlas.meshes]).reshape(-1, 3, 2)
    place *= [atlas.width, atlas.height]
    corner_chart[order] = np.concatenate(
        [np.asarray(each.chart, np.int64)[np.asarray(each.indices)] for each in atlas.meshes]
    ).reshape(-1, 3)
    chart = np.where((corner_chart == corner_chart[:, :1]).all(1), corner_chart[:, 0], -1)
    # A triangle that was left out has all its corners at one point.
    placed = (chart >= 0) & (place != place[:, :1]).any((1, 2))
    used = np.unique(chart[placed])
    chart = np.where(np.isin(chart, used), np.searchsorted(used, chart), -1)
    # The packer's atlas may be larger than its charts need.
    size = np.ceil(place[placed].reshape(-1, 2).max(0, initial=0.0) + _PADDING - 1e-3)
    if size.max() > _MOST:
        shape = f"{size[0]:.0f}x{size[1]:.0f}"
        raise WlmError(f"{name}: scale: too large: {shape} texels under the new UVs, expected at most {_MOST} a side")
    return place, chart, placed, size


def _chart_meshes(
    points: np.ndarray, numbers: np.ndarray, label: np.ndarray
) -> tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Makes each chart a flat mesh with its lower corner at the origin: places float32 [v, 3], triangles uint32 [f, 3]
    and the same places as UVs; the numbers of the triangles in the order of the meshes, int [N], come first in the
    result. In one mesh the packer would join charts that meet at a point. In a smaller mesh float32 coordinates are
    finer, and the packer accepts thinner triangles."""
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
    name: str, old: np.ndarray, place: np.ndarray, chart: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Fits the rigid motion that took each of C charts to its new place: z to rotation * z + shift, with points as
    complex numbers z = x + iy. Returns rotation (times the scale) and shift, complex [C] each."""
    before, after = _complex(old).reshape(-1), _complex(place).reshape(-1)
    chart = np.repeat(chart, 3)
    count = int(chart.max(initial=-1)) + 1

    def sums(values: np.ndarray) -> np.ndarray:
        return np.bincount(chart, values.real, count) + 1j * np.bincount(chart, values.imag, count)

    corners = np.bincount(chart, minlength=count)
    centre, new_centre = sums(before) / corners, sums(after) / corners
    rotation = sums(np.conj(before - centre[chart]) * (after - new_centre[chart]))
    size = np.abs(rotation)
    rotation = np.where(size > 0, rotation / np.where(size > 0, size, 1.0), 1.0) * scale
    shift = new_centre - rotation * centre
    deviation = np.abs(rotation[chart] * before + shift[chart] - after).max(initial=0.0)
    if deviation > _STRETCH:
        raise WlmError(
            f"{name}: the UV packer uvunwrap stretched a chart by {deviation:.3g} texels, at most {_STRETCH} fit"
        )
    return rotation, shift


def _place_inactive(corner: np.ndarray, numbers: np.ndarray, active: np.ndarray) -> None:
    """Collapses each triangle that isn't active to a corner that it shares with an active one, or to (0, 0)."""
    if active.all():
        return
    shared = np.full(int(numbers.max()) + 1, -1)
    shared[numbers[active].reshape(-1)] = np.flatnonzero(np.repeat(active, 3))
    index = shared[numbers[~active]].max(1)
    place = np.where(index[:, None] >= 0, corner.reshape(-1, 2)[index], 0.0)
    corner[~active] = place[:, None]


def _thickened(points: np.ndarray, height: float) -> np.ndarray:
    """Replaces thin triangles [N, 3, 2] by right ones on their longest edges, whose other leg is `height` long."""
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


def _dilated(corner: np.ndarray) -> np.ndarray:
    """Computes outlines [N, 7, 2] of triangles [N, 3, 2], dilated by one texel along both axes: the reach of bilinear
    reads. Each outline is the Minkowski sum of a triangle and a square: the edges of both, sorted by direction."""
    flip = _signed_area(corner) < 0
    ring = np.where(flip[:, None, None], corner[:, ::-1], corner)
    square = _REACH * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    edge = np.roll(ring, -1, 1) - ring
    sides = np.broadcast_to(np.roll(square, -1, 0) - square, (len(corner), 4, 2))
    edges = np.concatenate([edge, sides], 1)
    edges = np.take_along_axis(edges, np.argsort(np.arctan2(edges[..., 1], edges[..., 0]), 1)[..., None], 1)
    # The sum of edges gives the outline up to a translation, fixed by its lowest x and y.
    outline = np.cumsum(edges, 1)
    return outline - outline.min(1, keepdims=True) + (ring.min(1, keepdims=True) - _REACH)


def _signed_area(corner: np.ndarray) -> np.ndarray:
    """Returns twice the areas of triangles [N, 3, 2], positive if the corners run from the x axis to the y axis."""
    ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]


def _complex(points: np.ndarray) -> np.ndarray:
    return points[..., 0] + 1j * points[..., 1]


def _real(values: np.ndarray) -> np.ndarray:
    return np.stack([values.real, values.imag], -1)
