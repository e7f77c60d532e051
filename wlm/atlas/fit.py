"""From a mesh with a lightmap to an atlas model."""

import math
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import maximum_filter, minimum_filter

from wlm import interop
from wlm.atlas import colour as codec
from wlm.atlas import tiles as grid
from wlm.atlas.cascade import fit_cascade
from wlm.atlas.charts import mesh_charts
from wlm.atlas.cluster import cluster
from wlm.atlas.coverage import covered_texels
from wlm.atlas.data import LightmappedMesh
from wlm.atlas.decode import Decoder
from wlm.atlas.model import (
    BLOCK_SIDE,
    COLOUR_BITS,
    LUT_BITS,
    MOST_SIZE,
    SIDE_BITS,
    SOURCE_BITS,
    AtlasModel,
    Profile,
    pack_entries,
)
from wlm.atlas.resize import fitting_size, resize
from wlm.atlas.views import sphere_views, surface_points, texel_triangles, visibility
from wlm.errors import WlmError
from wlm.formats.exr import HALF_MAX
from wlm.ops.raster import texture
from wlm.texels import fill_gaps

__all__ = ["Cells", "Progress", "compress", "weights"]

Progress = Callable[[str], None]
"""Called with the name of each stage as it begins, and in long ones with how far it is."""

_RIM = 2  # quarters of a texel along an axis: one texel
_VIEW = 768  # pixels along a side, where visibility is counted
_NO_ROOM = "budget: {:g} of {}x{} texels is less than the smallest tiles and their table take: expected more"
_POINTS = 4  # random points of the surface for each cell, where there are no views
_POINTS_AT_ONCE = 1 << 20
# A sample must save this share of the squared range, of one texel of the lightmap: half float's rounding there.
_LEAST_GAIN = 2.0**-24
_WIDTHS = np.linspace(0.7, 1.5, 17)  # of T_p, over the root of its samples


def compress(
    mesh: LightmappedMesh, profile: Profile, *, seed: int = 0, device: str = "cpu", progress: Progress | None = None
) -> AtlasModel:
    """Compresses the lightmap of a mesh.

    Args:
        mesh: The mesh.
        profile: The settings.
        seed: Of the random views.
        device: "cpu" or "cuda:0".
        progress: Called at the start of each stage.

    Returns:
        The model. It is "plain", a smaller lightmap at as many bits, where the method has the larger error.

    Raises:
        WlmError: No such device, a missing package, or a budget that the smallest model exceeds.
    """
    device = interop.check_device(device)
    clock, cells = _Clock(progress or (lambda stage: None), device), Cells(mesh, device)
    if profile.method == "cascade":
        model = _cascade(mesh, profile, seed, device, clock)
    else:
        model = _tiles(cells, profile, seed, clock)
    if profile.fallback:
        with clock("compare"):
            model = _better(cells, model, profile, seed)
    elif model is None:
        raise WlmError(_NO_ROOM.format(profile.budget, *mesh.mask.shape[::-1]))
    # The cascade's own stages stand in for the one that they make up.
    seconds = {stage: time for stage, time in clock.seconds.items() if stage != "cascade"}
    return replace(model, report=model.report | {"seconds": seconds | model.report.get("seconds", {})})


def _cascade(mesh: LightmappedMesh, profile: Profile, seed: int, device: str, clock: "_Clock") -> AtlasModel:
    clusters = None
    if profile.threshold > 0:
        # Any number will do for a black lightmap, whose triangles are all alike.
        brightest = float(mesh.lightmap[mesh.mask].max()) or 1.0
        with clock("cluster") as said:
            clusters = cluster(
                mesh.uv,
                mesh.triangle,
                fill_gaps(mesh.lightmap, mesh.mask),
                threshold=profile.threshold,
                colour_threshold=profile.colour_threshold,
                max_radiance=brightest if profile.max_radiance is None else profile.max_radiance,
                active=mesh.active,
                device=device,
                progress=said,
            )
    with clock("cascade") as said:
        return fit_cascade(mesh, clusters, profile, seed=seed, device=device, progress=said)


class Cells:
    """Quarters of the lightmap's texels, [2 H, 2 W]: what is found of them once and counts for all that is compared.

    Attributes:
        mesh, device: As given.
    """

    def __init__(self, mesh: LightmappedMesh, device: str):
        self.mesh, self.device = mesh, device
        self.height, self.width = (2 * count for count in mesh.mask.shape)

    @cached_property
    def triangle(self) -> tuple[torch.Tensor, torch.Tensor]:
        """As ``texel_triangles`` gives them: the triangle that holds a centre, and the weights of its corners."""
        return texel_triangles(self.mesh, self.height, self.width, self.device)

    @cached_property
    def covered(self) -> np.ndarray:
        """bool, whether a triangle holds the centre, exactly."""
        mesh = self.mesh
        return covered_texels(mesh.uv, mesh.triangle[mesh.active], self.height, self.width) > 0

    @cached_property
    def border(self) -> np.ndarray:
        """bool, within ``_RIM`` of a border between charts or of a chart and nothing."""
        found = self.triangle[0].cpu().numpy()
        label = np.where(found < 0, -1, mesh_charts(self.mesh)[found])
        window = 2 * _RIM + 1
        return maximum_filter(label, window) != minimum_filter(label, window)


def _better(cells: Cells, model: AtlasModel | None, profile: Profile, seed: int) -> AtlasModel:
    """The model, or a smaller lightmap of at most as many bits whose weighted error is no larger.

    Without a model the smaller lightmap has the budget's bits, and a texel, or a block, at least.
    """
    mesh, device = cells.mesh, cells.device
    height, width = mesh.mask.shape
    share = profile.budget if model is None else 1.0 - model.compression_ratio
    whole = 1 if profile.colour == "half" else BLOCK_SIDE
    bits = COLOUR_BITS[profile.colour]
    size = fitting_size(height, width, share * height * width * SOURCE_BITS, (whole, whole), bits)
    if size is None:
        if model is not None:
            return model
        size = 1, 1
    blocks, texels = _stored(resize(mesh.lightmap, mesh.mask, *size), profile.colour)
    no_lut, no_uv = np.empty((0, 0, 2), np.uint16), np.empty((0, 3, 2), np.float32)
    plain = AtlasModel(
        mesh.name, mesh.source, profile, "plain", profile.colour, height, width, texels, blocks, no_lut, no_uv
    )
    if model is None:
        return replace(plain, report={"why plain": "tiles do not fit the budget"})
    # Other views than those of the fit, which would flatter it.
    points, weight = _scored_points(cells, weights(cells, profile, seed + 1))
    wanted = texture(torch.from_numpy(fill_gaps(mesh.lightmap, mesh.mask)).to(device), points[0])
    own, other = (
        float(((Decoder(each, device)(*points) - wanted).double().square().sum(1) * weight).sum())
        for each in (model, plain)
    )
    ratio = {"error against a plain lightmap of as many bits": own / other if other else None}
    if own < other:
        return replace(model, report=model.report | ratio)
    seconds = {key: value for key, value in model.report.items() if key == "seconds"}
    return replace(plain, report=seconds | ratio | {"why plain": f"its error is no larger than that of {model.method}"})


def _scored_points(
    cells: Cells, weight: np.ndarray
) -> tuple[tuple[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]:
    """Centres of quarters of texels that are in a triangle, as a decoder takes them, and what each counts.

    Where no triangle holds a centre, being too small, the quarters that count stand for their triangles.
    """
    found, barycentric = cells.triangle
    hit = found >= 0
    counts = torch.from_numpy(weight).to(cells.device)
    if not bool(hit.any()):
        hit = counts > 0
    row, column = torch.nonzero(hit, as_tuple=True)
    uv = torch.stack([(column + 0.5) / cells.width, (row + 0.5) / cells.height], 1).float()
    share, triangle = barycentric[hit], found[hit]
    triangle = torch.where(triangle < 0, int(np.flatnonzero(cells.mesh.active)[0]), triangle)
    return (uv, triangle, torch.cat([share, 1.0 - share.sum(1, keepdim=True)], 1)), counts[hit]


def _stored(texels: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray]:
    """T_p as stored: its blocks, and the half floats that it is read as."""
    blocks = np.empty((0, 16), np.uint8)
    if kind != "half":
        blocks, texels = codec.encode(texels, kind)
    return blocks, texels.astype(np.float16)


def weights(cells: Cells, profile: Profile, seed: int) -> np.ndarray:
    """How much each quarter of a texel counts: the pixels that show it in random views, and a little for the rest.

    Returns:
        float64 [2 H, 2 W], 0 where there is no triangle; at least one is above 0.
    """
    mesh, height, width = cells.mesh, cells.height, cells.width
    if not profile.views:
        seen = _areas(mesh, height, width, seed)
    else:
        seen = visibility(mesh, sphere_views(profile.views, seed), _VIEW, height, width, cells.device)
    used = cells.covered | (seen > 0)
    if not used.any():  # smaller than a quarter of a texel, and seen by nobody
        used = np.repeat(np.repeat(mesh.mask, 2, 0), 2, 1)
    usual = seen[used].mean() or 1.0
    result = np.where(used, seen + profile.unseen * usual, 0.0)
    return np.where(cells.border, profile.border * result, result)


def _areas(mesh: LightmappedMesh, height: int, width: int, seed: int) -> np.ndarray:
    """How many of random points of the mesh's surface lie in each cell of UV space, int64 [height, width]."""
    random = np.random.default_rng(seed)
    count = np.zeros(height * width, np.int64)
    total = _POINTS * height * width
    for first in range(0, total, _POINTS_AT_ONCE):
        points = min(_POINTS_AT_ONCE, total - first)
        triangle, weight = surface_points(mesh, points, random)
        uv = np.einsum("nk,nkc->nc", weight, mesh.uv[mesh.triangle[triangle]])
        column, row = ((uv[:, i] * n).astype(np.int64).clip(0, n - 1) for i, n in enumerate((width, height)))
        count += np.bincount(row * width + column, minlength=height * width)
    return count.reshape(height, width)


def _tiles(cells: Cells, profile: Profile, seed: int, clock: "_Clock") -> AtlasModel | None:
    """The model; None where not even the smallest tiles and their table fit the budget."""
    mesh = cells.mesh
    with clock("weights"):
        image = fill_gaps(mesh.lightmap, mesh.mask)
        tiles = grid.cut(image, weights(cells, profile, seed), profile.tile, cells.device)
    height, width = mesh.mask.shape
    rows, columns = grid.tile_counts(height, width, profile.tile)
    bits = profile.budget * height * width * SOURCE_BITS
    room = (bits - rows * columns * LUT_BITS) / COLOUR_BITS[profile.colour]
    sizes = _sizes(profile)
    if room < len(tiles.index) * min(nx * ny for nx, ny in sizes):
        return None
    with clock("curves"):
        stored = None if profile.colour == "half" else _through(profile.colour)
        error = grid.curves(tiles, sizes, stored)
    with clock("allocate"):
        peak = float(np.ptp(image[mesh.mask]))
        least = peak**2 * _LEAST_GAIN / (height * width)
        found = _fitted(error, np.array(sizes), room, least, profile.colour != "half")
        if found is None:
            return None
        chosen, first, shape = found
    with clock("solve"):
        samples = grid.solved(tiles, chosen)
    with clock("write"):
        texels, lut = _composed(samples, tiles.index.cpu().numpy(), chosen, first, shape, (rows, columns))
        blocks, texels = _stored(texels, profile.colour)
    report = {
        "tiles": len(tiles.index),
        "of tiles": rows * columns,
        "samples": int(chosen.prod(1).sum()),
        "constant tiles": int((chosen.prod(1) == 1).sum()),
    }
    return AtlasModel(
        mesh.name, mesh.source, profile, "tiles", profile.colour, height, width, texels, blocks, lut,
        np.empty((0, 3, 2), np.float32), report,
    )  # fmt: skip


class _Clock:
    """Names the stages and keeps their times."""

    def __init__(self, note: Progress, device: str):
        self.seconds: dict[str, float] = {}
        self._note, self._device = note, device

    @contextmanager
    def __call__(self, stage: str) -> Iterator[Callable[[int, int], None]]:
        """Gives what a stage calls with how much of it is done."""
        self._note(stage)
        start = time.perf_counter()
        yield lambda done, total: self._note(f"{stage}: {done:,} of {total:,}")
        if self._device != "cpu":
            torch.cuda.synchronize(self._device)
        self.seconds[stage] = time.perf_counter() - start


def _sizes(profile: Profile) -> list[tuple[int, int]]:
    """The sizes that a tile may have; where T_p is made of blocks, whole ones, so that no block has two tiles."""
    if profile.colour == "half":
        sides = range(1, profile.tile + 2)
    else:
        sides = range(BLOCK_SIDE, profile.tile + 1 + BLOCK_SIDE, BLOCK_SIDE)
        sides = [side for side in sides if side <= 1 << SIDE_BITS]
    return [(nx, ny) for ny in sides for nx in sides]


def _through(name: str) -> Callable[[torch.Tensor], torch.Tensor]:
    """What a block codec makes of tiles whose sides are whole blocks."""

    def stored(samples: torch.Tensor) -> torch.Tensor:
        count, ny, nx, _ = samples.shape
        strip = samples.cpu().numpy().reshape(count * ny, nx, 3)
        _, decoded = codec.encode(strip, name)
        return torch.from_numpy(decoded.reshape(count, ny, nx, 3)).to(samples)

    return stored


def _fitted(
    error: np.ndarray, sizes: np.ndarray, room: float, least: float, blocks: bool
) -> tuple[np.ndarray, np.ndarray, tuple[int, int]] | None:
    """Sizes for which T_p, a rectangle, has room: sizes int [T, 2], first texels [T, 2], rows and columns; or None."""
    cost, budget = sizes.prod(1).astype(np.float64), room
    step, fewest = BLOCK_SIDE if blocks else 1, error.shape[1] * cost.min()
    while True:
        chosen = sizes[grid.allocate(error, cost, budget, least)]
        total = chosen.prod(1).sum()
        best = None
        for share in _WIDTHS:
            width = max(int(chosen[:, 0].max()), -(-round(share * math.sqrt(total)) // step) * step)
            first, height = grid.place(chosen, width)
            # The last of the shelves are never all full to the same column.
            width = int((first[:, 0] + chosen[:, 0]).max())
            if best is None or width * height < best[0]:
                best = width * height, first, (height, width)
        area, first, shape = best
        if max(shape) > MOST_SIZE:
            raise WlmError(f"budget: T_p would have {max(shape)} texels along a side; tiles allow {MOST_SIZE}")
        if area <= room:
            return chosen, first, shape
        if total <= fewest:
            return None
        # What is wasted between the shelves is about as much next time.
        budget = min(budget, total) * min(0.999 * room / area, 0.99)


def _composed(
    samples: list[np.ndarray],
    index: np.ndarray,
    sizes: np.ndarray,
    first: np.ndarray,
    shape: tuple[int, int],
    counts: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """T_p, float32, and T_c. Tiles that don't matter show the texture's first texel."""
    texels = np.zeros((*shape, 3), np.float32)
    for values, (x, y), (nx, ny) in zip(samples, first.tolist(), sizes.tolist(), strict=True):
        texels[y : y + ny, x : x + nx] = values
    entry_first, entry_size = np.zeros((counts[0] * counts[1], 2), int), np.ones((counts[0] * counts[1], 2), int)
    entry_first[index], entry_size[index] = first, sizes
    return texels.clip(max=HALF_MAX), pack_entries(entry_first, entry_size).reshape(*counts, 2)
