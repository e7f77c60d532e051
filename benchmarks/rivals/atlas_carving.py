"""Carving of a lightmap together with the mesh's UVs, after "Texture Size Reduction Through Symmetric Overlap and
Texture Carving" (Knodt and Gao, ACM Transactions on Graphics 44(1), 2025).

The abstract of the method and section 4.3 of lightmap-uv-clustering-cascade state: it carves redundant and void
texels in a way that is aware of the UVs and of the texture, without inverting the UV mesh and without a change of the
mesh itself; carving is seam carving. Its other half, charts laid over their mirror images, is left out, as it is there:
light isn't symmetric.

Seams are those of Avidan and Shamir 2007: one texel of each row, next to that of the row above, of least cost, found by
dynamic programming. Rows and columns are treated alike, in turns. Ours, where that is silent:

- A texel costs what a bilinear read is wrong by once it is gone: its difference from the mean of its two neighbours
  in the row. Gaps hold the nearest chart's light, and cost nothing until charts with other light meet. The size of the
  gradient, as in 2007, is 5 dB worse at equal bits on three lightmaps, and worse than a smaller lightmap, which is what
  lightmap-uv-clustering-cascade finds of the method.
- Removing a seam moves UVs by a map without folds: nothing up to the centre of the texel before the seam, one texel
  from that of the texel behind it, linearly between. A triangle's inside follows its corners, so the texture is
  drawn again after every few seams, and the last one has the least squared error where charts are read.
- A seam that would turn a triangle over isn't taken: its texels there are blocked until the next drawing.
- The texture is RGB9E5, and costs the texels that charts read, as for other rivals. UVs are free in eq. 9.
"""

import time
from dataclasses import dataclass

import numpy as np
import torch
from scipy import sparse

from benchmarks.rivals.atlas_share import budget_bits, read_blocks
from benchmarks.rivals.rival import Rival
from wlm.atlas.colour import quantise
from wlm.atlas.data import LightmappedScene, Sheet
from wlm.atlas.model import COLOUR_BITS, TEXELS
from wlm.atlas.views import Points, corner_weights, texel_triangles
from wlm.formats.exr import HALF_MAX
from wlm.ops import raster
from wlm.texels import fill_gaps

_ROUND = 32  # a side over the seams between two drawings; with 16 it is 1 dB worse
_FINE = 2  # points along a texel, where errors are least: with one, reads between centres are 3 dB worse
_THIN = 1e-9  # twice a triangle's area in texels
_PULL = 1e-4  # regularisation towards the mean of the points around a texel
_ROUNDS = 20  # rounds of conjugate gradients


def carving(scene: LightmappedScene, share: float) -> Rival:
    """Removes the seams of least cost from the lightmap, which is read bilinearly under UVs that follow.

    Args:
        scene: A scene of one lightmap.
        share: The budget.

    Raises:
        ValueError: A share without room for one texel, or that is reached by no seams that keep the triangles' winding.
    """
    start, (mesh,) = time.perf_counter(), scene.sheets
    most, bits = budget_bits(mesh, share) // COLOUR_BITS[TEXELS], COLOUR_BITS[TEXELS]
    if most == 0:
        raise ValueError(f"share: {share} of {mesh.mask.shape} texels has no room for {bits} bits")
    points = _Samples(mesh)
    sheet = _Texture(mesh.uv * mesh.mask.shape[::-1], mesh.mask.shape)
    while (count := read_blocks(points.places(sheet), sheet.size)) > most:
        # Each side has about the same share of its texels left, where it can.
        left = [side / most for side, most in zip(sheet.size, mesh.mask.shape, strict=True)]
        for axis in (0, 1) if left[0] > left[1] else (1, 0):
            # No more than are needed, were all columns read alike.
            seams = min(mesh.mask.shape[axis] // _ROUND, int(sheet.size[axis] * (1.0 - most / count)))
            carved = _carved(mesh, sheet, max(1, seams), turned=axis == 0)
            if carved.size != sheet.size:
                break
        else:
            raise ValueError(f"share: {share} of {mesh.mask.shape} texels is less than carving comes to")
        sheet = carved
    texels = quantise(points.fitted(sheet), TEXELS)["texels"]
    sample = _Sample(np.ascontiguousarray(texels, np.float32), sheet.uv[mesh.triangle])
    return Rival("carving", count * bits // 8, time.perf_counter() - start, None, sample, size=sheet.size)


@dataclass(frozen=True, eq=False)
class _Texture:
    """A texture that is carved.

    Attributes:
        place: float64 [V, 2], x and y of the vertices in texels; the first texel's outer corner is 0.
        size: Rows and columns.
    """

    place: np.ndarray
    size: tuple[int, int]

    @property
    def uv(self) -> np.ndarray:
        return self.place / self.size[::-1]


class _Sample:
    """A texture under UVs of its own, as a `Sampler`.

    Attributes:
        corner: float32 [F, 3, 2], the corners' UVs.
    """

    def __init__(self, texels: np.ndarray, corner: np.ndarray) -> None:
        self._texels, self.corner = torch.tensor(texels), torch.tensor(corner, dtype=torch.float32)

    def __call__(self, points: Points, state: int) -> torch.Tensor:
        corner = self.corner.to(points.uv.device)[points.triangle]
        return raster.texture(self._texels.to(points.uv.device), (points.weight[..., None].float() * corner).sum(1))


class _Samples:
    """Points of the charts at which a texture is fitted."""

    def __init__(self, mesh: Sheet) -> None:
        shape = tuple(_FINE * side for side in mesh.mask.shape)
        triangle, barycentric = texel_triangles(mesh, *shape, "cpu")
        inside = torch.tensor(mesh.mask.repeat(_FINE, 0).repeat(_FINE, 1)) & (triangle >= 0)
        # Where no chart holds a point, corners stand for all.
        if not inside.any():
            corner = mesh.triangle[mesh.active].reshape(-1)
            self._vertex, self._weight = corner[:, None].repeat(3, 1), np.full((len(corner), 3), 1 / 3)
            uv = mesh.uv[corner]
        else:
            self._vertex = mesh.triangle[triangle[inside].numpy()]
            self._weight = corner_weights(barycentric[inside]).numpy().astype(np.float64)
            row, column = np.nonzero(inside.numpy())
            uv = np.stack([(column + 0.5) / shape[1], (row + 0.5) / shape[0]], 1)
        image = torch.tensor(mesh.lightmap)
        self._light = raster.texture(image, torch.tensor(uv, dtype=torch.float32)).numpy().astype(np.float64)

    def places(self, sheet: _Texture) -> np.ndarray:
        """Row and column of each on a texture, from the first texel's centre: float64 [N, 2]."""
        return np.einsum("nk,nkc->nc", self._weight, sheet.place[self._vertex])[:, ::-1] - 0.5

    def fitted(self, sheet: _Texture) -> np.ndarray:
        """The texture of least squared error, float32 [h, w, 3]."""
        place, count = self.places(sheet), np.array(sheet.size)
        low = np.floor(place).astype(np.int64)
        share = place - low
        cells, weights = [], []
        for dy in (0, 1):
            for dx in (0, 1):
                near = np.clip(low + (dy, dx), 0, count - 1)
                cells.append(near[:, 0] * count[1] + near[:, 1])
                weights.append(np.abs(1 - dy - share[:, 0]) * np.abs(1 - dx - share[:, 1]))
        rows = np.tile(np.arange(len(place)), 4)
        shape = len(place), count.prod()
        matrix = sparse.csr_matrix((np.concatenate(weights), (rows, np.concatenate(cells))), shape=shape)
        gathered, weight = matrix.T @ self._light, np.asarray(matrix.sum(0)).reshape(-1)
        mean = gathered / np.maximum(weight, 1e-9)[:, None]
        mean = fill_gaps(mean.reshape(*sheet.size, 3), (weight > 1e-6).reshape(sheet.size)).reshape(-1, 3)
        squares = (matrix.T @ matrix + _PULL * sparse.identity(shape[1])).tocsr()
        light, residual = mean, gathered + _PULL * mean - squares @ mean
        direction, energy = residual, np.square(residual).sum(0)
        for _ in range(_ROUNDS):
            image = squares @ direction
            curvature = (direction * image).sum(0)
            # A channel that is already solved has a curvature of 0.
            step = np.divide(energy, curvature, out=np.zeros(3), where=curvature > 0.0)
            light, residual = light + step * direction, residual - step * image
            before, energy = energy, np.square(residual).sum(0)
            direction = residual + np.divide(energy, before, out=np.zeros(3), where=before > 0.0) * direction
        return light.clip(0.0, HALF_MAX).reshape(*sheet.size, 3).astype(np.float32)


def _carved(mesh: Sheet, sheet: _Texture, seams: int, turned: bool) -> _Texture:
    """Removes seams.

    Args:
        mesh: The mesh.
        sheet: The texture before.
        seams: Most seams; fewer where every other one would turn a triangle over.
        turned: Whether they run from the left to the right, and not from the top to the bottom.
    """
    image = _drawn(mesh, sheet)
    triangle = mesh.triangle[mesh.active]
    place = sheet.place
    if turned:
        image, place = image.transpose(1, 0, 2), place[:, ::-1]
    winding = _areas(place[triangle])
    # Rounding would decide for triangles with hardly an area.
    winding = np.where(np.abs(winding) > _THIN, np.sign(winding), 0.0)
    blocked = np.zeros(image.shape[:2], bool)
    for _ in range(min(seams, image.shape[1] - 1)):
        while (seam := _seam(np.where(blocked, np.inf, _costs(image)))) is not None:
            moved = _moved(place, seam, image.shape[1])
            wrong = _areas(moved[triangle]) * winding < 0.0
            if not wrong.any():
                break
            _block(blocked, seam, place[triangle[wrong]][..., 1])
        if seam is None:
            break
        place = moved
        image, blocked = (_without(each, seam) for each in (image, blocked))
    height, width = image.shape[:2]
    return (
        _Texture(np.ascontiguousarray(place[:, ::-1]), (width, height)) if turned else _Texture(place, (height, width))
    )


def _drawn(mesh: Sheet, sheet: _Texture) -> np.ndarray:
    """The lightmap under the sheet's UVs, its gaps filled: float64 [h, w, 3]."""
    triangle = mesh.triangle[mesh.active]
    drawn = raster.rasterize_uv(
        torch.tensor(sheet.uv, dtype=torch.float32), torch.tensor(triangle, dtype=torch.int32), *sheet.size
    )
    hit = drawn.triangle >= 0
    if not hit.any():
        return np.zeros((*sheet.size, 3))
    corner = mesh.uv[triangle[drawn.triangle[hit].numpy()]]
    uv = np.einsum("nk,nkc->nc", corner_weights(drawn.barycentric[hit]).numpy(), corner)
    image = np.zeros((*sheet.size, 3))
    image[hit.numpy()] = raster.texture(torch.tensor(mesh.lightmap), torch.tensor(uv, dtype=torch.float32)).numpy()
    return fill_gaps(image, hit.numpy())


def _costs(image: np.ndarray) -> np.ndarray:
    """The difference of each texel of [h, w, 3] from the mean of its neighbours in the row, [h, w]."""
    padded = np.pad(image, ((0, 0), (1, 1), (0, 0)), mode="edge")
    return np.abs(image - (padded[:, 2:] + padded[:, :-2]) / 2.0).sum(2)


def _seam(cost: np.ndarray) -> np.ndarray | None:
    """The columns of the seam of least cost through [h, w], from the top to the bottom: int [h]; None without any."""
    height, width = cost.shape
    total, above = cost.copy(), np.full(width + 2, np.inf)
    for y in range(1, height):
        above[1:-1] = total[y - 1]
        total[y] += np.minimum(np.minimum(above[:-2], above[1:-1]), above[2:])
    seam = np.empty(height, np.int64)
    seam[-1] = total[-1].argmin()
    if total[-1, seam[-1]] == np.inf:
        return None
    for y in range(height - 2, -1, -1):
        first = max(seam[y + 1] - 1, 0)
        seam[y] = first + total[y, first : seam[y + 1] + 2].argmin()
    return seam


def _moved(place: np.ndarray, seam: np.ndarray, width: int) -> np.ndarray:
    """Places [V, 2] on a texture of so many columns after a seam was removed."""
    centre = np.interp(place[:, 1], np.arange(len(seam)) + 0.5, seam + 0.5)
    # Nothing moves out at a border.
    begin, end = np.maximum(centre - 1.0, 0.0), np.minimum(centre + 1.0, width)
    x = place[:, 0] - ((place[:, 0] - begin) / (end - begin)).clip(0.0, 1.0)
    return np.stack([x, place[:, 1]], 1)


def _block(blocked: np.ndarray, seam: np.ndarray, heights: np.ndarray) -> None:
    """Blocks the texels of a seam in the rows of triangles, whose corners' heights are [N, 3]."""
    first = np.floor(heights.min(1) - 1.0).astype(np.int64).clip(0, len(seam) - 1)
    last = np.floor(heights.max(1) + 1.0).astype(np.int64).clip(0, len(seam) - 1)
    for top, bottom in zip(first, last, strict=True):
        rows = np.arange(top, bottom + 1)
        blocked[rows, seam[rows]] = True


def _without(image: np.ndarray, seam: np.ndarray) -> np.ndarray:
    """An image [h, w, ...] without a seam."""
    keep = np.ones(image.shape[:2], bool)
    keep[np.arange(len(seam)), seam] = False
    return image[keep].reshape(len(seam), -1, *image.shape[2:])


def _areas(corner: np.ndarray) -> np.ndarray:
    """Twice the signed areas of triangles [F, 3, 2]."""
    ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    return ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
