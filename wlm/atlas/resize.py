"""Resizes lightmaps to a lower resolution, at which they are read bilinearly."""

import warnings

import numpy as np
import torch
from scipy import sparse

from wlm.formats.exr import HALF_MAX

_Array = torch.Tensor | np.ndarray
# Conjugate gradient rounds: 5 are within 0.1 dB of this number, and three times as many gain nothing.
_ROUNDS = 20
# Regularisation towards the box filter's result: it determines texels that no chart reads, and hardly changes others.
_PULL = 1e-4


def fitting_size(height: int, width: int, budget: float, block: tuple[int, int], bits: float) -> tuple[int, int] | None:
    """Returns the largest rows and columns, at most `height` and `width` and in their ratio, at which a lightmap takes
    at most `budget` bits. It is counted in whole blocks of `block` texels, at `bits` per texel. None if none fits."""
    longest = max(height, width)
    for side in range(longest, 0, -1):
        rows, columns = (max(1, round(side * size / longest)) for size in (height, width))
        if -(-rows // block[0]) * -(-columns // block[1]) * block[0] * block[1] * bits <= budget:
            return rows, columns
    return None


def resized(
    filled: _Array, mask: _Array, height: int, width: int, filter: str = "fit", device: str = "cpu"
) -> torch.Tensor:
    """Returns a smaller lightmap, to be read bilinearly, float64 [height, width, 3] in [0, 65504]. `filled` is the
    lightmap without gaps. The filter "box" averages the lightmap over the new texels' squares; "fit" minimises the
    squared error at the texels of the mask. At its own size the lightmap is returned unchanged."""
    light = torch.as_tensor(filled, device=device).double()
    if (height, width) == tuple(mask.shape):
        return light
    small = box(light, height, width)
    if filter == "fit":
        small = _fit(light, torch.as_tensor(mask, device=device), small)
    return small.clamp(0.0, HALF_MAX)


def box(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Reduces an image, float64 [H, W, C], to [height, width, C]: each new texel is the mean over its square."""
    down, across = (_on(_box(new, old), image.device) for new, old in ((height, len(image)), (width, image.shape[1])))
    return _along(across, _along(down, image))


def _on(matrix: sparse.csr_matrix, device: torch.device) -> torch.Tensor:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # about sparse tensors, whose interface may change
        parts = (torch.from_numpy(values) for values in (matrix.indptr, matrix.indices, matrix.data))
        return torch.sparse_csr_tensor(*parts, matrix.shape, dtype=torch.float64).to(device)


def _along(matrix: torch.Tensor, image: torch.Tensor) -> torch.Tensor:
    """Multiplies a matrix [new, old] with an image [old, N, C] along the first axis; returns [N, new, C]."""
    product = matrix @ image.reshape(len(image), -1)
    return product.reshape(len(matrix), *image.shape[1:]).transpose(0, 1)


def _fit(filled: torch.Tensor, mask: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """Refines a small image by conjugate gradients, so that bilinear reads match `filled` at the mask; [h, w, 3]."""
    both = [_bilinear(new, old) for new, old in zip(mask.shape, start.shape[:2], strict=True)]
    rows, columns, turned_rows, turned_columns = (_on(m, start.device) for m in (*both, *(m.T.tocsr() for m in both)))
    mask = mask.T.contiguous().T[..., None]  # in the memory order of what `read` returns

    def read(small: torch.Tensor) -> torch.Tensor:
        return _along(columns, _along(rows, small))

    def gathered(image: torch.Tensor) -> torch.Tensor:
        return _along(turned_columns, _along(turned_rows, image * mask))

    change = torch.zeros_like(start)
    residual = gathered(filled - read(start))
    direction, energy = residual.clone(), residual.square().sum((0, 1))
    for _ in range(_ROUNDS):
        image = gathered(read(direction)) + _PULL * direction
        curvature = (direction * image).sum((0, 1))
        # A channel that is already solved has a curvature of 0.
        step = torch.where(curvature > 0.0, energy / curvature, 0.0)
        change += step * direction
        residual -= step * image
        before, energy = energy, residual.square().sum((0, 1))
        direction = residual + torch.where(before > 0.0, energy / before, 0.0) * direction
    return start + change


def _bilinear(new: int, old: int) -> sparse.csr_matrix:
    """Makes the matrix [new, old] for a bilinear read of `old` texels at the centres of `new` texels, clamped."""
    place = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(place).astype(np.int64)
    column = np.clip(np.stack([first, first + 1]), 0, old - 1)
    weight = np.stack([1.0 - (place - first), place - first])
    row = np.broadcast_to(np.arange(new), (2, new))
    return sparse.csr_matrix((weight.reshape(-1), (row.reshape(-1), column.reshape(-1))), shape=(new, old))


def _box(new: int, old: int) -> sparse.csr_matrix:
    """Makes the matrix [new, old] that averages a row of `old` texels over each of `new` ones."""
    side = np.minimum(np.arange(new + 1) * (old / new), old)
    texel = side[:-1, None].astype(np.int64) + np.arange(int(old / new) + 2)
    weight = np.minimum(side[1:, None], texel + 1.0) - np.maximum(side[:-1, None], texel)
    weight = np.maximum(weight, 0.0)
    weight /= weight.sum(axis=1, keepdims=True)
    row = np.broadcast_to(np.arange(new)[:, None], texel.shape)
    inside = weight > 0.0
    return sparse.csr_matrix((weight[inside], (row[inside], texel[inside])), shape=(new, old))
