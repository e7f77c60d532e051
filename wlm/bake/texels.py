"""Maps a lightmap's texels to surfaces: sample positions and normals within each texel, and its coverage."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from wlm.bake.geometry import Surface
from wlm.errors import WlmError
from wlm.ops import interpolate, rasterize_uv

_OVERLAP = 0.01  # share of the covered samples that may lie in two triangles, as on edges
_MOST_SIDE = 16384  # sample positions along a side of the lightmap


@dataclass(frozen=True, eq=False)
class Texels:
    """The T covered texels of a lightmap, with N sample positions in total.

    `index`, int64 [T], ascending, is row * width + column, and `first`, int64 [T + 1], each texel's first sample;
    `coverage`, float32 [T], is the covered share. Samples have positions, unit shading normals and unit geometric
    normals on the side of these, float32 [N, 3] each.
    """

    height: int
    width: int
    index: np.ndarray
    first: np.ndarray
    position: np.ndarray
    normal: np.ndarray
    face: np.ndarray
    coverage: np.ndarray

    def image(self, values: np.ndarray) -> np.ndarray:
        """Scatters values [T, ...] to an image, float32 [H, W, ...], 0 in uncovered texels."""
        picture = np.zeros((self.height * self.width, *values.shape[1:]), np.float32)
        picture[self.index] = values
        return picture.reshape(self.height, self.width, *values.shape[1:])


def place_texels(where: str, surfaces: Sequence[Surface], resolution: int, supersample: int) -> Texels:
    """Computes the sample positions of all texels: those points of a lattice in each texel that a triangle covers.
    Surfaces without lightmap UVs are skipped; `where` names the geometry in errors."""
    used = [each for each in surfaces if each.uv is not None]
    side = resolution * supersample
    if side > _MOST_SIDE:
        raise WlmError(f"lightmap: resolution times supersample: expected at most {_MOST_SIDE}, got {side}")
    if not used:
        raise WlmError(f"{where}: expected surfaces with lightmap UVs, found none")
    start = np.cumsum([0, *(len(each.position) for each in used)])
    triangle = np.concatenate([each.triangle + first for each, first in zip(used, start[:-1], strict=True)])
    uv = np.concatenate([each.uv for each in used])
    position = np.concatenate([each.position for each in used])
    a, b, c = position[triangle].transpose(1, 0, 2)
    face = np.cross(b - a, c - a)
    face /= np.linalg.norm(face, axis=1, keepdims=True)
    corner = np.concatenate([each.normal for each in used])[triangle]
    # A normal that is missing, or on the other side of its triangle, would gather light from inside the surface.
    wrong = np.einsum("fck,fk->fc", corner, face) <= 0
    corner[wrong] = np.broadcast_to(face[:, None], corner.shape)[wrong]
    raster = rasterize_uv(torch.tensor(uv, dtype=torch.float32), torch.tensor(triangle), side, side, coverage=True)
    number = raster.triangle.numpy()
    row, column = np.nonzero(number >= 0)
    if not len(row):
        raise WlmError(f"{where}: expected lightmap UVs that cover at least one texel, found none")
    overlap = float((raster.coverage.numpy()[row, column] > 1).mean())
    if overlap > _OVERLAP:
        raise WlmError(
            f"{where}: lightmap UVs: {overlap:.0%} of the covered area lies in several triangles, expected no "
            "overlap: set lightmap.unwrap: true to create new UVs"
        )
    chosen = number[row, column]
    local = np.arange(3 * len(triangle), dtype=np.int32).reshape(-1, 3)
    corners = torch.tensor(np.concatenate([position[triangle].reshape(-1, 3), corner.reshape(-1, 3)], 1)).float()
    values = interpolate(corners, torch.tensor(local), raster).numpy()[row, column]
    normal = values[:, 3:] / np.maximum(np.linalg.norm(values[:, 3:], axis=1, keepdims=True), 1e-20)
    texel = (row // supersample) * resolution + column // supersample
    order = np.argsort(texel, kind="stable")
    index, first = np.unique(texel[order], return_index=True)
    first = np.append(first, len(order))
    return Texels(
        resolution,
        resolution,
        index,
        first,
        np.ascontiguousarray(values[order, :3]),
        np.ascontiguousarray(normal[order]),
        np.ascontiguousarray(face[chosen[order]].astype(np.float32)),
        (np.diff(first) / supersample**2).astype(np.float32),
    )
