"""Finds from a lightmap's own light which mesh it was baked for, whether it is turned or mirrored, and which texels are
stray: invalid, or far too bright for their place.

Within a chart light is smooth except at the edges of shadows; it is not smooth across gaps, other charts and values
that a baker leaves between charts. So the mean difference between neighbouring texels of one chart is smallest with the
UVs that the lightmap was baked for.
"""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import binary_opening, maximum_filter

from wlm.atlas.charts import charts, welded
from wlm.atlas.coverage import covered_texels
from wlm.errors import WlmError
from wlm.formats.gltf import GltfPrimitive
from wlm.formats.light import SUFFIXES
from wlm.ops.raster import rasterize_uv
from wlm.texels import fill_gaps

_STEP = 3.0  # octaves: larger steps, and steps to NaN or infinity, are clamped to this
_DARK = 0.02  # fraction of the median light that is added first, so that dark texels have no steps
_BETTER = 0.85  # other UVs fit better if the light's roughness in their charts is below this multiple
_LOOKED_AT, _BAND = 1 << 22, 16  # texels examined per lightmap, and rows per band: enough, within a second
_LEAST, _FEWEST = 0.005, 1024  # smallest roughness in octaves; fewest texels in charts for a meaningful mean
_SHARED = 0.02  # fraction of texels under several meshes; a smaller one is rounding at neighbouring charts
_BRIGHT, _PERCENTILE = 16.0, 99.5  # a speck is brighter than this multiple of this percentile of the light
_WIDEST = 3  # a speck is narrower than this number of texels
# Ways in which a lightmap may lie instead, likeliest first: words, and whether its charts are transposed and then
# mirrored in v and in u. Of those that fit about equally well the first is named.
_TURNS = (
    ("", False, 1, 1),
    ("upside down (--flip)", False, -1, 1),
    ("mirrored left to right", False, 1, -1),
    ("turned by 180 degrees", False, -1, -1),
    ("transposed, rows as columns", True, 1, 1),
    ("turned by 90 degrees counterclockwise", True, 1, -1),
    ("turned by 90 degrees clockwise", True, -1, 1),
    ("transposed and turned by 180 degrees", True, -1, -1),
)
# Another turn must have less than this multiple of the roughness; less than the second where the roughness is below
# `_SMOOTH` of that of the whole picture, as it is with the right UVs and in large charts of smooth light.
_TURNED, _MUCH, _SMOOTH = 0.8, 0.4, 0.45
_ALIKE = 0.95  # of several that fit, the first one is named whose roughness is within this ratio of the smallest
_EXAMINED = 1024  # longest side of the picture in which UVs are compared
_APART, _TINY = 0.25, 0.02  # shares of charts without light and of light without charts, and of light in charts
_BOX = "its UVs, about"
_OUTSIDE, _STRETCHED = 1e-3, 0.05  # UVs this far outside [0, 1] are clamped; smaller changes of UVs aren't compared
_FRINGE, _REACH = 4.0, 5  # limit over the brightest chart texel nearby, and the window's side in texels


def choose_mesh(
    where: str, name: str, primitives: list[GltfPrimitive], uv_set: int, lightmap: np.ndarray, alone: bool = True
) -> tuple[list[GltfPrimitive], list[str]]:
    """Chooses the primitives for which a lightmap was baked. Also returns lines of text that say what was left out.

    Meshes that lie side by side in UV space share it. Where they overlap, the mesh in whose charts the lightmap is
    smoothest is chosen; a mesh that several nodes draw counts once. Where the light fits none clearly better, the name
    of the lightmap decides (`by_name`). `alone` is whether the lightmap is the only one, for the advice in messages.
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
        covered += covered_texels(uv.clip(0.0, 1.0), triangle, height, width).numpy() > 0
    if np.count_nonzero(covered > 1) <= _SHARED * np.count_nonzero(covered):
        return primitives, []
    charted = [chart_map(*_joined(group, uv_set), height, width) for group in groups]
    rough = [min(roughness(light, chart) for light in (lightmap, lightmap[::-1])) for chart in charted]
    order = np.argsort(rough)
    best, second = order[:2]
    lie = f"{len(groups)} meshes lie on each other in TEXCOORD_{uv_set}"
    if rough[best] < _BETTER * rough[second]:
        return groups[best], [f"{name}: {lie}: the lightmap fits {groups[best][0].label} best; the others are left out"]
    if chosen := by_name(name, primitives):
        return chosen, [f"{name}: {lie}: by its name, the lightmap is that of {chosen[0].label}"]
    names = ", ".join(group[0].label for group in groups[:8]) + (", ..." if len(groups) > 8 else "")
    advice = "as the node (--node)" if alone else "in the lightmap's file name, or a .json list with objects"
    raise WlmError(
        f"{where}: {name}: {lie}, and it fits none clearly better: expected the name of one {advice}: {names}"
    )


def by_name(name: str, primitives: Sequence[GltfPrimitive]) -> list[GltfPrimitive]:
    """Returns the primitives of the node or the mesh whose name a lightmap's name contains as whole words, for example
    Floor in Floor_baked.hdr; of several names the longest. Empty if there is no such name or it isn't unique."""
    words = f"_{_words(Path(name).stem if name.lower().endswith(SUFFIXES) else name)}_"
    found: dict[str, list[GltfPrimitive]] = {}
    for each in primitives:
        for label in {_words(each.label), _words(each.mesh_label)}:
            if label and f"_{label}_" in words:
                found.setdefault(label, []).append(each)
    longest = sorted(found, key=len)[-2:]
    if not found or (len(longest) > 1 and len(longest[0]) == len(longest[1])):
        return []
    return found[longest[-1]]


def all_by_name(names: Sequence[str], primitives: Sequence[GltfPrimitive]) -> dict[int, list[GltfPrimitive]]:
    """Returns for each of several lightmaps the primitives that its name selects, if the names of all of them select
    different ones; else nothing."""
    found = {number: by_name(name, primitives) for number, name in enumerate(names)}
    keys = [(each.node, each.primitive) for group in found.values() for each in group]
    return found if len(names) > 1 and all(found.values()) and len(set(keys)) == len(keys) else {}


def _words(name: str) -> str:
    return re.sub(r"[\W_]+", "_", name.casefold()).strip("_")


def named(where: str, primitives: list[GltfPrimitive], node: str) -> list[GltfPrimitive]:
    """Selects the primitives of the node with the given name, mesh name or number."""
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
    if not (floor := _floor(greys)):
        return float("inf")
    total, count = 0.0, 0
    for band, grey in zip(bands, greys, strict=True):
        for step, inside in zip(_steps(grey, floor), _inside(chart[band]), strict=True):
            total, count = total + float(step[inside].sum()), count + int(inside.sum())
    return total / count if count else float("inf")


def _floor(greys: Sequence[np.ndarray]) -> float:
    """Returns the light that is added to all texels before they are compared; 0 if no texel is lit."""
    lit = np.concatenate([grey[np.isfinite(grey) & (grey > 0)] for grey in greys])
    return _DARK * float(np.median(lit)) if lit.size else 0.0


def _steps(grey: np.ndarray, floor: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns the differences in octaves between neighbours in a column [H - 1, W] and in a row [H, W - 1]."""
    finite = np.isfinite(grey)
    octave = np.log2(np.where(finite, grey.clip(0.0), 0.0) + floor)
    found = []
    for axis in (0, 1):
        (a, b), (c, d) = _neighbours(octave, axis), _neighbours(finite, axis)
        found.append(np.where(c & d, np.minimum(np.abs(a - b), _STEP), _STEP))
    return found[0], found[1]


def _inside(chart: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Tests which neighbours in a column [H - 1, W] and in a row [H, W - 1] are of one chart."""
    (a, b), (c, d) = _neighbours(chart, 0), _neighbours(chart, 1)
    return (a == b) & (a >= 0), (c == d) & (c >= 0)


def _bands(height: int, width: int) -> list[slice]:
    """Returns the rows of a lightmap to examine: all, or evenly spread bands if it is large."""
    count = max(_LOOKED_AT // (_BAND * width), 4)
    if count * _BAND >= height:
        return [slice(0, height)]
    first = np.linspace(0, height - _BAND, count).astype(int).tolist()
    return [slice(row, row + _BAND) for row in first]


class _Turned(NamedTuple):
    """A lightmap in one of `_TURNS`, which `words` describe, "" for the lightmap as it is. `black` is the number of
    texels in charts without light. `roughness` is the mean squared difference, in octaves, between neighbouring texels
    of one chart: squares weigh the edges of charts more than the noise inside. On a room with filled gaps, the right
    UVs have at most 0.88 of the squares of 23 other layouts, but 1.2 of their mean."""

    words: str
    roughness: float
    black: int


class _Picture:
    """The light of a lightmap [H, W, 3], compared with charts that are turned instead of it."""

    def __init__(self, light: np.ndarray, lit: np.ndarray) -> None:
        """Takes the light, of which a texel at least is lit, and which texels are, bool [H, W]."""
        with np.errstate(invalid="ignore", over="ignore"):
            grey = np.float32(1 / 3) * (light[..., 0] + light[..., 1] + light[..., 2])
        self._dark = ~lit
        self._steps = [step * step for step in _steps(grey, np.float32(_floor([grey])))]
        texels = max(sum(step.size for step in self._steps), 1)  # of a single texel there are no steps
        self.everywhere = sum(float(step.sum(dtype=np.float64)) for step in self._steps) / texels

    def turned(self, chart: np.ndarray) -> list[_Turned]:
        """Returns the roughness in the charts (`chart_map`) for each of `_TURNS`, infinity without neighbours."""
        height, width = chart.shape
        # Nearest texels, where the lightmap is not square.
        exchanged = chart[np.ix_(np.arange(width) * height // width, np.arange(height) * width // height)].T
        charts = [([one.astype(np.float32) for one in _inside(each)], each >= 0) for each in (chart, exchanged)]
        counts = [sum(np.count_nonzero(each) for each in inside) for inside, _ in charts]
        found = []
        for words, transposed, v, u in _TURNS:
            (inside, covered), count = charts[transposed], counts[transposed]
            total = sum(float(np.vdot(step, each[::v, ::u])) for step, each in zip(self._steps, inside, strict=True))
            black = np.count_nonzero(covered[::v, ::u] & self._dark)
            found.append(_Turned(words, total / count if count else float("inf"), black))
        return found


def _better_turn(turns: Sequence[_Turned], everywhere: float, texels: int, apart: bool, smooth: bool) -> _Turned | None:
    """Returns the turn that fits clearly better than the lightmap as it is, the first of `turns`, or None. `apart` is
    whether the light as it is lies outside of the `texels` texels in charts, `smooth` whether it is smooth in them."""
    now = turns[0].roughness
    limit = everywhere if apart else min((_MUCH if smooth else _TURNED) * now, now - _LEAST**2)
    black = _APART * texels if apart else max(turns[0].black, _APART * texels)
    best = None
    for each in turns[1:]:
        if each.roughness < limit and each.black <= black:
            best, limit = each, _ALIKE * each.roughness
    return best


def misfits(
    name: str,
    lightmap: np.ndarray,
    position: np.ndarray,
    triangle: np.ndarray,
    uv: np.ndarray,
    chart: np.ndarray,
    used: str,
    alternatives: Sequence[tuple[str, np.ndarray]],
) -> list[str]:
    """Returns a list of one line of doubt if a lightmap [H, W, 3] fits its charts badly, else an empty list: other UVs,
    or the lightmap turned or mirrored, make it clearly smoother in the charts, light and charts lie apart, or the
    charts leave nearly all of the light out.

    `chart` is the chart at each texel with the mesh's UVs in [0, 1], see `chart_map`, and `used` words for these UVs.
    `alternatives` are words and UVs [V, 2] to compare with, besides the UVs that are used, stretched to the lit texels.
    """
    step = -(-max(lightmap.shape[:2]) // _EXAMINED)
    light = lightmap[::step, ::step]
    height, width = light.shape[:2]
    with np.errstate(invalid="ignore"):
        lit = (light[..., 0] > 0) | (light[..., 1] > 0) | (light[..., 2] > 0)
    if not lit.any():
        return []
    chart = chart[::step, ::step]
    inside = chart >= 0
    texels = np.count_nonzero(inside)
    black, away = np.count_nonzero(inside & ~lit) / max(texels, 1), 0.0
    if black > _APART:
        away = np.count_nonzero(lit & ~maximum_filter(inside, 2 * _REACH + 1)) / np.count_nonzero(lit)
    apart = away > _APART
    picture = _Picture(light, lit)
    turns = picture.turned(chart)
    rough = float("inf") if apart else turns[0].roughness
    # The light is smoother in charts than across their edges. Few texels say little about the UVs that are used.
    everywhere = picture.everywhere * (1.0 if texels >= _FEWEST else _BETTER)
    limit = min(_BETTER * rough, rough - _LEAST**2, everywhere)
    smooth = rough < _SMOOTH * picture.everywhere
    found: list[tuple[float, str]] = []
    others = [*alternatives, *_stretched(uv, triangle, lit)]
    for words, uvs in others:
        other = uvs.astype(np.float64)
        if not np.isfinite(other).all() or other.min() < -_OUTSIDE or other.max() > 1.0 + _OUTSIDE:
            continue
        other = other.clip(0.0, 1.0)
        charted = chart_map(position, other, triangle, height, width)
        count = np.count_nonzero(charted >= 0)
        if count < max(_FEWEST, texels // 4 if texels >= _FEWEST else 4 * texels):
            continue
        overlaps = int((covered_texels(other, triangle, height, width) > 1).sum())
        for turn in picture.turned(charted)[: 2 if words.startswith(_BOX) else None]:
            # A stretched box is only roughly right, and a turned lightmap is a second change.
            if smooth and turn.words:
                continue
            rough = turn.roughness / (_BETTER if turn.words or words.startswith(_BOX) else 1.0)
            if overlaps <= _SHARED * count and turn.black <= _APART * count and rough < limit:
                found.append((rough, f"{words} with the lightmap {turn.words}" if turn.words else words))
    turned = None if texels < _FEWEST else _better_turn(turns, picture.everywhere, texels, apart, smooth)
    if turned is not None:
        found.append((turned.roughness, f"{used} with the lightmap {turned.words}"))
    if found:
        smallest = min(found)[0]
        best = next(words for rough, words in found if rough <= smallest / _ALIKE)
        return [
            f"{name}: the light is smoother in the charts of {best} than in those of {used}: does it belong to them?"
        ]
    if np.count_nonzero(lit) >= _FEWEST and texels:
        if apart:
            return [
                f"{name}: {black:.0%} of the texels in charts of {used} are black, and {away:.0%} of the lit texels "
                "are in no chart: do these UVs belong to this lightmap?"
            ]
        if texels < _TINY * np.count_nonzero(lit):
            return [
                f"{name}: the charts of {used} cover {texels / np.count_nonzero(lit):.2%} of the lit texels: do these "
                "UVs belong to this lightmap?"
            ]
    return []


def _stretched(uv: np.ndarray, triangle: np.ndarray, lit: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Returns alternative UVs, each after a text for messages: stretched so that the charts' box is that of the lit
    texels, and scaled so that it is in the middle of the square; those that hardly change the UVs are left out."""
    corner = uv[triangle].reshape(-1, 2)
    low, high = corner.min(axis=0), corner.max(axis=0)
    at = [np.flatnonzero(lit.any(axis=axis)) for axis in (0, 1)]
    first = np.array([each[0] / lit.shape[1 - axis] for axis, each in enumerate(at)])
    last = np.array([(each[-1] + 1) / lit.shape[1 - axis] for axis, each in enumerate(at)])
    if not (high > low).all():
        return []
    # The second alternative has equal margins on both sides.
    scales = ((last - first) / (high - low), 1.0 / np.maximum(low + high, _LEAST))
    offsets = (first - scales[0] * low, np.zeros(2))
    found = []
    for scale, offset in zip(scales, offsets, strict=True):
        if np.abs(np.concatenate([scale - 1.0, offset])).max() >= _STRETCHED:
            text = f"scaled by {scale[0]:.3g} and {scale[1]:.3g}"
            text = f"{_BOX} {text}, moved by {offset[0]:.3g} and {offset[1]:.3g}" if offset.any() else f"its UVs {text}"
            found.append((text, uv * scale + offset))
    return found


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
    return values.take(range(values.shape[axis] - 1), axis), values.take(range(1, values.shape[axis]), axis)
