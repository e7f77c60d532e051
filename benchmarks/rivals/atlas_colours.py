"""Triangles of one colour share a texel, after "Texture Atlas Compression Based on Repeated Content Removal" (Luo et
al., SIGGRAPH Asia 2023), at a size of its own.

The abstract of the method, the interface of its published program and section 4.3 of
lightmap-uv-clustering-cascade state: repeated contents share texels; the rest is background, whose triangles are
grouped by colour, with a threshold of 10 levels; a new atlas holds what remains at its own resolution; a second pass
leaves triangles out that were wrong: in 50 views of 512 x 512 pixels, where a view is below 38 dB, one triangle after
another, that with the largest error first, until it isn't. 38 dB are those of the whole picture, background and all.

Ours, where that is silent:

- Levels are 1/255 of the square root of exposed light: near sRGB, which the method's textures are in, without a white
  to clip at. PSNR has the same scale.
- A triangle has one colour if no channel is further than the threshold from the middle of its range. Groups are the
  cells of a grid twice as wide as the threshold; a group's colour is the mean of its light over UV space, near that
  which drawing from random views would find.
- Repeated contents, which the method finds with a network for segmentation, aren't looked for: lightmaps hardly have
  them.
- The packer is better than any: a triangle that stays costs the texels that it touches, without gaps or borders, and is
  read without any loss but rounding to half. So the size is less than the method's own.
"""

import math
import time

import numpy as np
import torch

from benchmarks.rivals.rival import Rival
from wlm.atlas.coverage import touched_texels
from wlm.atlas.data import LightmappedScene, Sheet
from wlm.atlas.evaluation import RESOLUTION, VIEWS
from wlm.atlas.model import SOURCE_BITS
from wlm.atlas.stages import one_thread
from wlm.atlas.views import Points, points_at, scene_views, visible_uv
from wlm.ops import raster
from wlm.texels import exposure as exposure_of

_THRESHOLD = 10 / 255
_FLOOR = 38.0
_SEED = 1  # other views than those of a score
_SAMPLES_AT_ONCE = 1 << 20


def single_colour(
    scene: LightmappedScene,
    *,
    threshold: float = _THRESHOLD,
    floor: float = _FLOOR,
    views: int = VIEWS,
    resolution: int = RESOLUTION,
) -> Rival:
    """Triangles of nearly one colour become one texel each, the same for all that are nearly alike; others stay.

    Args:
        scene: A scene of one lightmap.
        threshold: How far a triangle's colours may be from their middle in any channel, see the module. A group's
            colours are within four times that of each other.
        floor: PSNR in dB of each view, see the module, but for what changes as groups lose triangles; -inf: none.
        views: Number of views, as of `wlm.atlas.views.scene_views`.
        resolution: Pixels along a side of a view.

    Raises:
        ValueError: A negative threshold.
    """
    if not threshold >= 0.0:
        raise ValueError(f"threshold: expected at least 0, got {threshold}")
    start, (mesh,) = time.perf_counter(), scene.sheets
    exposure = exposure_of(mesh.lightmap[mesh.mask])
    low, high, mean = _colours(mesh, exposure)
    flat = mesh.active & (((high - low) / 2.0).max(axis=1) <= threshold)
    cell = (low + high) / 2.0
    if threshold > 0.0:
        cell = np.floor(cell / (2.0 * threshold))
    image = mesh.lightmap.astype(np.float16).astype(np.float32)
    groups = _Groups(mesh, flat, cell, mean, image)
    if floor > -math.inf and flat.any():
        wrong = _wrong_triangles(scene, groups, exposure, floor, views, resolution)
        groups = _Groups(mesh, flat & ~wrong, cell, mean, image)
    return Rival("single colour", groups.texels * SOURCE_BITS // 8, time.perf_counter() - start, None, groups)


class _Groups:
    """Triangles that share colours, as a `Sampler`.

    Attributes:
        colour: int64 [F], the number of each triangle's colour, -1 for none.
        texels: Number of texels of the colours and of the triangles that stay.
    """

    def __init__(self, mesh: Sheet, flat: np.ndarray, cell: np.ndarray, mean: np.ndarray, image: np.ndarray) -> None:
        self.colour = np.full(len(flat), -1)
        number = np.unique(cell[flat], axis=0, return_inverse=True)[1].reshape(-1)
        self.colour[flat] = number
        count = int(number.max(initial=-1)) + 1
        corner = mesh.uv[mesh.triangle[flat]]
        ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
        area = np.abs(ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0])
        light = [np.bincount(number, area * channel, count) for channel in mean[flat].T]
        palette = np.stack(light, 1) / np.bincount(number, area, count)[:, None]
        # The last entry stands for triangles without a colour; it isn't read.
        self._palette = torch.tensor(np.concatenate([palette, np.zeros((1, 3))]).astype(np.float16).astype(np.float32))
        self._image = torch.tensor(image)
        stays = mesh.triangle[mesh.active & ~flat]
        self.texels = count + int(np.count_nonzero(touched_texels(mesh.uv, stays, *mesh.mask.shape)))

    def __call__(self, points: Points, state: int) -> torch.Tensor:
        device = points.uv.device
        colour = torch.tensor(self.colour, device=device)[points.triangle]
        read = raster.texture(self._image.to(device), points.uv)
        return torch.where(colour[:, None] >= 0, self._palette.to(device)[colour], read)


def _coded(light: np.ndarray | torch.Tensor, exposure: float) -> np.ndarray | torch.Tensor:
    """Linear light on the scale of the method's levels."""
    return (light * exposure) ** 0.5


def _wrong_triangles(
    scene: LightmappedScene, groups: _Groups, exposure: float, floor: float, views: int, resolution: int
) -> np.ndarray:
    """The triangles without whose errors every view has a PSNR of at least `floor`: bool [F]."""
    (mesh,) = scene.sheets
    wrong = np.zeros(len(mesh.triangle), bool)
    image = torch.tensor(mesh.lightmap)
    most = 10.0 ** (-floor / 10.0) * 3 * resolution**2
    with one_thread("cpu"):
        for drawn in visible_uv(scene, scene_views(scene, views, _SEED), resolution, "cpu"):
            points = points_at(scene, *drawn)[1]
            light = groups(points, 0), raster.texture(image, points.uv)
            error = (_coded(light[0], exposure) - _coded(light[1], exposure)).double().square().sum(1).numpy()
            triangle = points.triangle.numpy()
            error[wrong[triangle]] = 0.0
            worst, total = np.zeros(len(wrong)), np.bincount(triangle, error, len(wrong))
            np.maximum.at(worst, triangle, error)
            order = np.argsort(-worst, kind="stable")
            # The error without the first triangle, the first two, and so on, down to nothing.
            left = np.append(np.cumsum(total[order[::-1]])[-2::-1], 0.0)
            if total.sum() > most:
                wrong[order[: int(np.argmax(left <= most)) + 1]] = True
    # Triangles that keep their texels have errors of rounding alone.
    return wrong & (groups.colour >= 0)


def _colours(mesh: Sheet, exposure: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and largest coded colours of each triangle, and its mean light: float64 [F, 3] each, of points that are a
    texel or less apart."""
    height, width = mesh.mask.shape
    image = torch.tensor(mesh.lightmap)
    corner = mesh.uv[mesh.triangle]
    edge = (corner - np.roll(corner, 1, axis=1)) * [width, height]
    longest = np.hypot(edge[..., 0], edge[..., 1]).max(axis=1)
    parts = 1 << np.ceil(np.log2(np.maximum(longest, 1.0))).astype(np.int64)
    low, high, mean = (np.empty((len(corner), 3)) for _ in range(3))
    for count in np.unique(parts):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        i, j = i[i + j <= count] / count, j[i + j <= count] / count
        weight = np.stack([i, j, 1.0 - i - j], axis=1)
        members = np.flatnonzero(parts == count)
        for piece in np.array_split(members, math.ceil(len(members) * len(weight) / _SAMPLES_AT_ONCE)):
            uv = torch.tensor(np.einsum("sk,fkc->fsc", weight, corner[piece]), dtype=torch.float32)
            light = raster.texture(image, uv).numpy().astype(np.float64)
            mean[piece] = light.mean(axis=1)
            low[piece], high[piece] = (_coded(each, exposure) for each in (light.min(axis=1), light.max(axis=1)))
    return low, high, mean
