"""One model of a scene with many objects and lighting states, against one model for each object in each state.

The scene is a lightmap set with its mesh, cut into objects that have their own lightmaps. An object is a connected set
of triangles: triangles are connected where their corners share a position. Pieces with few texels, such as knobs and
screws, are added to the nearest object that has more. The charts of an object are cut out of the lightmaps, downsampled
each without its neighbours, and laid out again at whole texels, so that a chart that keeps its size is not resampled.

The results table has a row of method "scene" for each profile: file size, times of compression and of its stages, and
error in views of the whole scene. A row of method "parts" follows it: every object in every state is compressed alone
by the profile `standard` (`benchmarks.rivals.scene_parts`), in the same total number of bits or a few more.

The row of method "copies" bounds what tiles that copy another object's tile could gain (`benchmarks.atlas_affine`).

"gain" is the mean PSNR of the scene's model over views and states, minus the mean PSNR of the parts; "least gain" is
this difference in the state where it is smallest.
"""

import math
import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from benchmarks.atlas import make_square
from benchmarks.atlas_affine import affine_gain
from benchmarks.rivals.scene_parts import scene_parts
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm import interop
from wlm.atlas.charts import charts, welded
from wlm.atlas.codec import sizes
from wlm.atlas.data import LightmappedScene, from_arrays, join
from wlm.atlas.evaluation import SHARED_RESOLUTION, SHARED_VIEWS, Sampler, compare
from wlm.atlas.fit import compress
from wlm.atlas.matching import chart_map
from wlm.atlas.model import Profile
from wlm.atlas.shared.weights import peaks_of, scene_weights, variation
from wlm.atlas.tiles.layout import Shelves
from wlm.errors import WlmError
from wlm.formats.gltf import read_gltf
from wlm.lightmap.data import SheetFrames
from wlm.lightmap.data import load as load_set
from wlm.texels import fill_gaps, nearest_valid

PROFILES = ("standard",)
"""Profiles of a run."""

LEAST_TEXELS = 16
"""The smallest number of texels of an object, at the requested size."""

_GAP = 2  # texels between charts: a bilinear read of one meets none of the next
_SAME_PLACE = 1e-5  # distance of equal positions, over the size of the scene
_SEED = 1  # seed of the views of the parts' weights


def run(
    *,
    scene_path: str | os.PathLike[str],
    hours: Sequence[float] | None = None,
    side: int | None = None,
    profiles: Sequence[str] | None = None,
    budget: float | None = None,
    parts: bool = True,
    quick: bool = False,
    device: str = "cpu",
    progress: Note | None = None,
) -> list[Row]:
    """Measures a model of a whole scene against models of each object in each lighting state.

    Args:
        scene_path, hours, side: As `path`, `hours` and `side` of `read_scene`.
        profiles: Names or YAML files of profiles; None: `PROFILES`.
        budget: Maximum share of the uncompressed bits, in place of the budget of each profile; None: not replaced.
        parts: Whether to measure the models of single objects too, which take most of the time.
        quick: Whether to measure errors in few small views, for a CPU.
        device: "cpu" or "cuda:0".
        progress: Called with a line before each part of the work.

    Returns:
        The rows of each profile, in the order of the profiles.

    Raises:
        WlmError: A file, a profile or the device does not exist, or the budget is less than the smallest model takes.
    """
    scene = read_scene(scene_path, hours or (), side)
    views = {"views": 8, "resolution": 128} if quick else {}
    return run_rows(scene, profiles or PROFILES, budget=budget, device=device, parts=parts, **views, progress=progress)


def run_rows(
    scene: LightmappedScene,
    names: Sequence[str],
    *,
    budget: float | None = None,
    device: str,
    parts: bool = True,
    views: int = SHARED_VIEWS,
    resolution: int = SHARED_RESOLUTION,
    progress: Note | None = None,
) -> list[Row]:
    """Measures a scene's model against models of its objects, in `views` cameras around the scene and as many inside.
    Pictures have `resolution` pixels along a side. Other arguments are as for `run`."""
    profiles = [Profile.load(name) for name in names]
    if budget is not None:
        profiles = [profile.override({"budget": budget}) for profile in profiles]
    title = f"{scene.name}, {len(scene.sheets)} objects, {len(scene.states)} states"
    bench = _SceneBench(title, scene, interop.check_device(device), (views, resolution), progress)
    rows = []
    for profile in profiles:
        rows += bench.rows(profile, parts)
    return rows


class _SceneBench(Bench):
    def __init__(
        self, title: str, scene: LightmappedScene, device: str, views: tuple[int, int], progress: Note | None
    ) -> None:
        super().__init__("atlas", device, progress, scene=title)
        self._scene, self._views = scene, dict(zip(("views", "resolution"), views, strict=True))
        self._varies = variation(scene, peaks_of(scene), device)

    def rows(self, profile: Profile, parts: bool) -> list[Row]:
        """Returns the row of the scene and, if `parts`, the row of its objects compressed alone in each state."""
        scene, device = self._scene, self.device
        self.note(f"{profile.name}: compiling kernels")
        compress(make_square(max(len(scene.states), 2)), profile.override({"budget": 1.0, "views": 1}), device=device)
        self.note(f"{profile.name}: compressing the scene")
        fit = self.fit(profile.name, lambda: compress(scene, profile, device=device))
        model = fit.model
        stages = {f"{name}_seconds": seconds for name, seconds in fit.fitted.report["seconds"].items()}
        decoders: dict[str, Sampler] = {"scene": model.decoder(device)}
        row = self.row(
            "scene",
            profile.name,
            "separate tiles of each state" if model.later else "tiles shared by the states",
            bytes=fit.bytes - sizes(model)[1],
            bpp=self._bpp(model.bits),
            compression_ratio=model.compression_ratio,
            encode_seconds=fit.seconds,
            lightmaps=len(scene.sheets) * len(scene.states),
            **stages,
        )
        rows = [row]
        if parts:
            self.note(f"{profile.name}: compressing {len(scene.sheets) * len(scene.states)} lightmaps, each by itself")
            weights = scene_weights(scene, self._varies, profile, _SEED, device)
            alone = scene_parts(scene, weights, model.bits, profile.colour, device)
            decoders["parts"] = alone
            plain = sum(each.method == "plain" for of_sheet in alone.models for each in of_sheet)
            share = alone.bits / model.source_bits
            notes = f"each object and state alone, {plain} of them plain smaller lightmaps; no file"
            sizes_of_parts = {"bpp": self._bpp(alone.bits), "compression_ratio": 1.0 - share}
            rows.append(self.row("parts", f"bits of {profile.name}", notes, **sizes_of_parts))
            self.note("matching tiles of different objects")
            gain, copied = affine_gain(scene, weights, share, device)
            notes = f"an upper bound; {copied:.0%} of the tiles would be copies"
            copies = self.row("copies", f"gain and offset, bits of {profile.name}", notes, gain=gain)
        self.note("measuring errors in views")
        scores = compare(scene, decoders, device=device, **self._views)
        for number, name in enumerate(scores):
            figures = {each: getattr(scores[name], each) for each in ("psnr", "psnr_worst", "texel_psnr")}
            rows[number] = rows[number].with_figures(**figures)
        if parts:
            gains = np.subtract(*(scores[name].psnr_by_state for name in ("scene", "parts")))
            gain = scores["scene"].psnr - scores["parts"].psnr
            rows[0] = rows[0].with_figures(gain=gain, gain_min=float(np.nanmin(gains)))
            rows.append(copies)
        return rows

    def _bpp(self, bits: float) -> float:
        return bits / self._scene.texels


def read_scene(
    path: str | os.PathLike[str], hours: Sequence[float] = (), side: int | None = None, trust: bool = False
) -> LightmappedScene:
    """Reads a lightmap set and cuts it into objects.

    Args:
        path: The set, in a form that `wlm.lightmap.load` reads; it must name its mesh.
        hours: Times of the set that become lighting states; empty: all.
        side: Texels of the longer side after downsampling, a divisor of the set's longer side; None: not downsampled.
        trust: As for `wlm.lightmap.load`.

    Returns:
        A scene with one lightmap sheet for each object, the largest first. Its name is made of the set's name and
        side; each state is named after its hour.

    Raises:
        WlmError: The set or its mesh can't be read, or has no such hour or side.
    """
    lightmaps = load_set(path, trust=trust).light
    if lightmaps.mesh is None:
        raise WlmError(f"{path}: expected a lightmap set that names its mesh")
    for hour in hours:
        if not np.isclose(lightmaps.times, hour).any():
            raise WlmError(f"{path}: no lightmap of {hour:g} h; it has {', '.join(f'{t:g}' for t in lightmaps.times)}")
    chosen = np.isclose(lightmaps.times[:, None], np.array(hours or lightmaps.times)).any(1)
    longest = max(lightmaps.mask.shape)
    if side is not None and not (0 < side <= longest and longest % side == 0):
        raise WlmError(f"{path}: side: expected a divisor of the longer side, {longest} texels, got {side}")
    primitives = [each for each in read_gltf(lightmaps.mesh, trust)[1] if 0 in each.uv]
    if not primitives:
        raise WlmError(f"{lightmaps.mesh}: expected triangles with the attribute TEXCOORD_0, found none")
    first = np.cumsum([0, *(len(each.position) for each in primitives)])
    arrays = (
        np.concatenate([each.position for each in primitives]),
        np.concatenate([each.triangle + start for each, start in zip(primitives, first, strict=False)]),
        np.concatenate([each.uv[0] for each in primitives]).astype(np.float64).clip(0.0, 1.0),
    )
    states = tuple(f"{time:g} h" for time in lightmaps.times[chosen])
    scene = cut(replace(lightmaps, frames=lightmaps.frames[chosen]), *arrays, longest // (side or longest))
    return replace(scene, name=f"{lightmaps.name} {side or longest}", states=states)


def cut(
    lightmaps: SheetFrames, position: np.ndarray, triangle: np.ndarray, uv: np.ndarray, factor: int = 1
) -> LightmappedScene:
    """Cuts lightmaps of a mesh into one lightmap sheet for each connected object. Returns the scene of these sheets.

    Args:
        lightmaps: Lightmaps of the whole mesh; each time becomes a lighting state.
        position: Positions of the V vertices in metres, float64 [V, 3].
        triangle: Vertex indices of the F triangles, int [F, 3].
        uv: Lightmap UVs of the vertices, float64 [V, 2] in [0, 1].
        factor: Downsampling factor: each square of factor x factor texels becomes one texel.
    """
    height, width = lightmaps.mask.shape
    chart = charts(welded(position, uv, triangle))
    owner = np.where(lightmaps.mask, chart_map(position, uv, triangle, height, width), -1)
    if (owner >= 0).any():  # a texel that a chart only touches is that of the nearest
        rows, columns = nearest_valid(owner >= 0)
        owner = np.where(lightmaps.mask, owner[rows, columns], -1)
    texel = uv * (width, height)
    pieces = [
        _piece(lightmaps.frames, owner == number, texel[triangle[chart == number]].reshape(-1, 2), number, factor)
        for number in range(int(chart.max()) + 1)
    ]
    counts = np.array([int(inside.sum()) for _, inside, _ in pieces])
    object_of = _objects(position, triangle, chart, counts)
    scenes = []
    for number in range(int(object_of.max()) + 1):
        own = np.flatnonzero(object_of == number)
        name = f"{lightmaps.name} {number}"
        scenes.append(_object(position, triangle, texel, chart, own, pieces, factor, name))
    return join(scenes, lightmaps.name)


def _piece(
    frames: np.ndarray, inside: np.ndarray, corner: np.ndarray, number: int, factor: int
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Downsamples a chart. Returns light [states, h, w, 3], mask [h, w], and x and y of the chart in the lightmaps."""
    height, width = inside.shape
    low = np.floor(corner.min(0)).clip(0, (width - 1, height - 1)).astype(int) // factor * factor
    high = np.maximum(np.ceil(corner.max(0)).astype(int), low + 1)
    # Whole squares; what is beyond the lightmap has no light.
    columns, rows = (-(-(high - low) // factor)).tolist()
    x, y = low.tolist()
    part = (slice(y, y + rows * factor), slice(x, x + columns * factor))
    mask = inside[part] if inside[part].any() else np.ones_like(inside[part])
    light = frames[(slice(None), *part)] * mask[..., None]
    beyond = rows * factor - mask.shape[0], columns * factor - mask.shape[1]
    light = np.pad(light, ((0, 0), (0, beyond[0]), (0, beyond[1]), (0, 0)))
    count = np.pad(mask, ((0, beyond[0]), (0, beyond[1]))).reshape(rows, factor, columns, factor).sum((1, 3))
    light = light.reshape(len(light), rows, factor, columns, factor, 3).sum((2, 4)) / np.maximum(count, 1)[..., None]
    return fill_gaps(light, count > 0), count > 0, (x, y)


def _objects(position: np.ndarray, triangle: np.ndarray, chart: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Joins charts to connected objects, small ones to the nearest large one; returns each chart's, largest first."""
    size = max(float(np.ptp(position, axis=0).max()), 1e-30)
    grid = np.round(position / (_SAME_PLACE * size)).astype(np.int64)
    corner = np.unique(grid, axis=0, return_inverse=True)[1].reshape(-1)[triangle]
    links = np.concatenate([corner[:, :2], corner[:, 1:]])
    total = int(corner.max()) + 1
    # Charts are connected through their triangles' corners.
    graph = coo_array((np.ones(len(links), bool), tuple(links.T)), (total, total))
    label = connected_components(graph, directed=False)[1][corner[:, 0]]
    first = np.unique(chart, return_index=True)[1]
    piece = np.unique(label[first], return_inverse=True)[1]
    texels = np.bincount(piece, counts)
    middle = np.stack([np.bincount(chart, position[triangle].mean(1)[:, axis]) for axis in range(3)], 1)
    middle /= np.bincount(chart)[:, None]
    large = texels >= min(LEAST_TEXELS, texels.max())
    near = np.flatnonzero(large[piece])
    joined = piece.copy()
    joined[~large[piece]] = piece[near[cKDTree(middle[near]).query(middle[~large[piece]])[1]]]
    _numbers, result = np.unique(joined, return_inverse=True)
    order = np.argsort(-np.bincount(result, counts), kind="stable")
    return np.argsort(order)[result.reshape(-1)]


def _object(position, triangle, texel, chart, own, pieces, factor, name):
    """Returns the scene of one object, whose charts are packed into a new lightmap."""
    sizes = np.array([pieces[number][1].shape[::-1] for number in own]) + _GAP
    shelves, width = Shelves(sizes), max(int(sizes[:, 0].max()), math.ceil(math.sqrt(sizes.prod(1).sum())))
    first, (tall, wide) = shelves.place(width), shelves.extent(width)
    light, mask = np.zeros((len(pieces[0][0]), tall, wide, 3), np.float32), np.zeros((tall, wide), bool)
    shift = np.zeros((len(pieces), 2))
    for number, (x, y) in zip(own, first + _GAP // 2, strict=True):
        values, inside, before = pieces[number]
        at = (slice(y, y + inside.shape[0]), slice(x, x + inside.shape[1]))
        light[(slice(None), *at)], mask[at] = values, inside
        shift[number] = np.array([x, y]) - np.array(before) / factor
    faces = np.flatnonzero(np.isin(chart, own))
    # A vertex that two charts have has two places.
    pairs = np.column_stack([np.repeat(chart[faces], 3), triangle[faces].reshape(-1)])
    used, corner = np.unique(pairs, axis=0, return_inverse=True)
    uv = (texel[used[:, 1]] / factor + shift[used[:, 0]]) / (wide, tall)
    return from_arrays(position[used[:, 1]], corner.reshape(-1, 3), uv, light, mask, name, metres=True)
