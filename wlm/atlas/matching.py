"""Finds from a lightmap's own light which mesh it was baked for, whether it is upside down, and which texels are stray:
invalid, or far too bright for their place.

Within a chart light is smooth except at the edges of shadows; it is not smooth across gaps, other charts and values
that a baker leaves between charts. So the mean difference between neighbouring texels of one chart is smallest with the
UVs that the lightmap was baked for.
"""

from collections.abc import Sequence

import numpy as np
import torch
from scipy.ndimage import binary_opening, maximum_filter

from wlm.atlas.charts import charts, welded
from wlm.atlas.coverage import covered_texels
from wlm.errors import WlmError
from wlm.formats.gltf import GltfPrimitive
from wlm.ops.raster import rasterize_uv
from wlm.texels import fill_gaps

_STEP = 3.0  # octaves: larger steps, and steps to NaN or infinity, are clamped to this
_DARK = 0.02  # fraction of the median light that is added first, so that dark texels have no steps
# On 15 lightmaps, in both orientations, the right one has at most 0.82 of the other's roughness.
_BETTER = 0.85
_LOOKED_AT, _BAND = 1 << 22, 16  # texels examined per lightmap, and rows per band: enough, within a second
_LEAST, _FEWEST = 0.005, 1024  # smallest roughness in octaves; fewest texels in charts for a meaningful mean
_SHARED = 0.02  # fraction of texels under several meshes; a smaller one is rounding at neighbouring charts
_BRIGHT, _PERCENTILE = 16.0, 99.5  # a speck is brighter than this multiple of this percentile of the light
_WIDEST = 3  # a speck is narrower than this number of texels
_FRINGE, _REACH = 4.0, 5  # limit over the brightest chart texel nearby, and the window's side in texels


def choose_mesh(
    where: str, name: str, primitives: list[GltfPrimitive], uv_set: int, lightmap: np.ndarray
) -> tuple[list[GltfPrimitive], list[str]]:
    """Chooses the primitives for which a lightmap was baked. Also returns lines of text that say what was left out.

    Meshes that lie side by side in UV space share it. Where they overlap, the mesh in whose charts the lightmap is
    smoothest is chosen; a mesh that several nodes draw counts once.

    Raises:
        WlmError: The lightmap fits no mesh clearly better than all others.
    """
    numbers = sorted({each.mesh for each in primitives})
    if len(numbers) == 1:
        return primitives, []
    height, width = lightmap.shape[:2]
    groups = [[each for each in primitives if each.mesh == number] for number in numbers]
    covered = np.zeros((height, width), np.int32)
    for group in groups:
        _, uv, triangle = _joined(group, uv_set)
        if not np.isfinite(uv).all():  # reported where the primitives are checked
            return primitives, []
        covered += covered_texels(uv.clip(0.0, 1.0), triangle, height, width) > 0
    if np.count_nonzero(covered > 1) <= _SHARED * np.count_nonzero(covered):
        return primitives, []
    charted = [chart_map(*_joined(group, uv_set), height, width) for group in groups]
    rough = [min(roughness(light, chart) for light in (lightmap, lightmap[::-1])) for chart in charted]
    order = np.argsort(rough)
    best, second = order[:2]
    if not rough[best] < _BETTER * rough[second]:
        names = ", ".join(group[0].label for group in groups[:8]) + (", ..." if len(groups) > 8 else "")
        raise WlmError(
            f"{where}: {len(groups)} meshes lie on each other in TEXCOORD_{uv_set}, and the lightmap fits none clearly "
            f"better: expected the name of one as the node (--node): {names}"
        )
    line = (
        f"{name}: {len(groups)} meshes lie on each other in TEXCOORD_{uv_set}: the lightmap fits "
        f"{groups[best][0].label} best; the others are left out"
    )
    return groups[best], [line]


def named(where: str, primitives: list[GltfPrimitive], node: str) -> list[GltfPrimitive]:
    """Selects the primitives of the node with the given name, mesh name or number.

    Raises:
        WlmError: There is no such node; the line lists the nodes that exist.
    """
    found = [each for each in primitives if node in (each.label, each.mesh_label, str(each.node))]
    if not found:
        labels = list(dict.fromkeys(each.label for each in primitives))
        names = ", ".join(labels[:8]) + (", ..." if len(labels) > 8 else "")
        raise WlmError(f"{where}: node: expected one of {names}, found {node!r}")
    return found


def chart_map(position: np.ndarray, uv: np.ndarray, triangle: np.ndarray, height: int, width: int) -> np.ndarray:
    """Returns the number of the chart at each texel's centre, int32 [height, width]; -1 outside of charts."""
    uv = np.asarray(uv, np.float64).clip(0.0, 1.0)
    number = charts(welded(position, uv, triangle))
    corners = torch.from_numpy(np.ascontiguousarray(triangle, np.int32))
    seen = rasterize_uv(torch.tensor(uv, dtype=torch.float32), corners, height, width).triangle.numpy()
    return np.where(seen < 0, -1, number[seen.clip(0)])


def roughness(lightmap: np.ndarray, chart: np.ndarray) -> float:
    """Returns the mean difference, in octaves (factors of 2), between neighbouring texels of one chart (`chart_map`);
    infinity without such texels. NaN and infinity count as large differences. A large lightmap is sampled in evenly
    spread bands of rows with `_LOOKED_AT` texels in all."""
    bands = _bands(*chart.shape)
    with np.errstate(invalid="ignore"):
        greys = [lightmap[band].astype(np.float64).mean(axis=2) for band in bands]
    lit = np.concatenate([grey[np.isfinite(grey) & (grey > 0)] for grey in greys])
    if not lit.size:
        return float("inf")
    floor = _DARK * np.median(lit)
    total, count = 0.0, 0
    for band, grey in zip(bands, greys, strict=True):
        finite = np.isfinite(grey)
        octave = np.log2(np.where(finite, grey.clip(0.0), 0.0) + floor)
        for axis in (0, 1):
            (a, b), (c, d), (e, f) = (_neighbours(values, axis) for values in (octave, chart[band], finite))
            inside = (c == d) & (c >= 0)
            step = np.where(e & f, np.minimum(np.abs(a - b), _STEP), _STEP)
            total, count = total + float(step[inside].sum()), count + int(inside.sum())
    return total / count if count else float("inf")


def _bands(height: int, width: int) -> list[slice]:
    """Returns the rows of a lightmap to examine: all, or evenly spread bands if it is large."""
    count = max(_LOOKED_AT // (_BAND * width), 4)
    if count * _BAND >= height:
        return [slice(0, height)]
    first = np.linspace(0, height - _BAND, count).astype(int).tolist()
    return [slice(row, row + _BAND) for row in first]


def fits_flipped(lightmap: np.ndarray, chart: np.ndarray) -> bool:
    """Tests whether a lightmap fits its charts (`chart_map`) clearly better upside down."""
    if np.count_nonzero(chart >= 0) < _FEWEST:
        return False
    flipped, rough = roughness(lightmap[::-1], chart), roughness(lightmap, chart)
    return flipped < min(_BETTER * rough, rough - _LEAST)


def replace_strays(lightmap: np.ndarray, mask: np.ndarray, covered: np.ndarray) -> int:
    """Replaces stray texels of a lightmap, float32 [H, W, 3], by the nearest valid texel, in place. Returns the number
    of texels in specks. A texel with its centre outside all triangles is stray if it is NaN, infinite or more than 4
    times as bright as the brightest nearby texel with its centre in a triangle: bakers and denoisers leave such values
    in gutters. All other texels are stray if they form a speck: less than 3 texels wide, and brighter than 16 times the
    99.5th percentile of all such texels."""
    brightest = lightmap.max(axis=2)
    finite = np.isfinite(lightmap).all(axis=2)
    inside = mask & covered
    light = brightest[inside & finite & (brightest > 0)]
    if not light.size:
        return 0
    high = inside & finite & (brightest > _BRIGHT * np.percentile(light, _PERCENTILE))
    # A bright texel beside a bright area is part of that area.
    speck = high & ~binary_opening(high, np.ones((_WIDEST, _WIDEST)))
    known = np.where(inside & finite & ~speck, brightest, 0.0)
    near = maximum_filter(known, _REACH)
    fringe = mask & ~covered & (~finite | (brightest > _FRINGE * near) & (near > 0))
    stray = fringe | speck
    good = mask & finite & ~stray
    if stray.any() and good.any():
        lightmap[stray] = fill_gaps(lightmap, good)[stray]
    return int(speck.sum())


def _joined(primitives: Sequence[GltfPrimitive], uv_set: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    first = np.cumsum([0, *(len(each.position) for each in primitives)])
    triangle = [each.triangle + start for each, start in zip(primitives, first[:-1], strict=True)]
    uv = np.concatenate([each.uv[uv_set] for each in primitives]).astype(np.float64)
    return np.concatenate([each.position for each in primitives]), uv, np.concatenate(triangle)


def _neighbours(values: np.ndarray, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Returns two views of an array: without the last, and without the first, element along an axis."""
    return values.take(range(values.shape[axis] - 1), axis), values.take(range(1, values.shape[axis]), axis)
