"""Lightmaps at a lower resolution, to be read bilinearly."""

import warnings

import numpy as np
import scipy.sparse as sparse
import torch

from wlm.formats.exr import HALF_MAX
from wlm.texels import fill_gaps

FILTERS = ("bilinear", "box", "lanczos", "fit")
_LOBES = 3
# Of conjugate gradients: 5 are within 0.1 dB of these, and three times as many gain nothing.
_ROUNDS = 20
# Regularisation towards the box filter's result: it decides texels that no chart reads, and hardly changes any other.
_PULL = 1e-4


def fitting_size(height: int, width: int, budget: float, block: tuple[int, int], bits: float) -> tuple[int, int] | None:
    """The largest size of a given aspect ratio whose blocks are within a budget.

    Args:
        height, width: The shape, and the largest size.
        budget: Bits.
        block: Rows and columns of texels in a block, 1 and 1 for none.
        bits: Bits per texel; blocks count whole.

    Returns:
        Rows and columns; None if not even one block fits.
    """
    longest = max(height, width)
    for side in range(longest, 0, -1):
        rows, columns = (max(1, round(side * size / longest)) for size in (height, width))
        if -(-rows // block[0]) * -(-columns // block[1]) * block[0] * block[1] * bits <= budget:
            return rows, columns
    return None


def resize(
    lightmap: np.ndarray, mask: np.ndarray, height: int, width: int, filter: str = "fit", device: str = "cpu"
) -> np.ndarray:
    """Makes a smaller lightmap, to be read bilinearly.

    Args:
        lightmap: [H, W, 3], finite, in [0, 65504] in the mask.
        mask: bool [H, W], true where a texel counts.
        height, width: 1 to H and 1 to W.
        filter: "bilinear" reads the lightmap at the new texels' centres; "box" averages it over their squares;
            "lanczos" has 3 lobes; "fit" has the least squared error when it is read at the mask's texels.
        device: "cpu" or "cuda:N".

    Returns:
        float64 [height, width, 3] in [0, 65504]; at the lightmap's own size it is the lightmap with its gaps filled.

    Raises:
        ValueError: No such filter, or a size out of range.
    """
    if filter not in FILTERS:
        raise ValueError(f"filter: expected one of {', '.join(FILTERS)}, got {filter!r}")
    if not (1 <= height <= lightmap.shape[0] and 1 <= width <= lightmap.shape[1]):
        raise ValueError(f"size: expected up to {lightmap.shape[:2]}, got {(height, width)}")
    return resized(fill_gaps(lightmap, mask), mask, height, width, filter, device).cpu().numpy()


def resized(
    filled: np.ndarray, mask: np.ndarray, height: int, width: int, filter: str = "fit", device: str = "cpu"
) -> torch.Tensor:
    """As `resize`, of a lightmap whose gaps are filled, at an allowed size, and on the device."""
    light = torch.from_numpy(filled).to(device).double()
    if (height, width) == mask.shape:
        return light
    weights = _WEIGHTS["box" if filter == "fit" else filter]
    small = _along(weights(width, mask.shape[1]), _along(weights(height, mask.shape[0]), light))
    if filter == "fit":
        small = _fit(light, torch.from_numpy(mask).to(device), small)
    return small.clamp(0.0, HALF_MAX)


def box(image: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Means of an image [H, W, C], float64, over the squares of fewer texels: [height, width, C]."""
    return _along(_box(width, image.shape[1]), _along(_box(height, image.shape[0]), image))


def _along(matrix: sparse.csr_matrix, image: torch.Tensor) -> torch.Tensor:
    """A matrix [new, old] along the first axis of an image [old, N, C], the result turned: [N, new, C]."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that sparse tensors may change
        parts = (torch.from_numpy(values) for values in (matrix.indptr, matrix.indices, matrix.data))
        on_device = torch.sparse_csr_tensor(*parts, matrix.shape, dtype=torch.float64).to(image.device)
    product = on_device @ image.reshape(len(image), -1)
    return product.reshape(matrix.shape[0], *image.shape[1:]).transpose(0, 1)


def _fit(filled: torch.Tensor, mask: torch.Tensor, start: torch.Tensor) -> torch.Tensor:
    """Minimises the squared error at the mask's texels by conjugate gradients, from an initial [h, w, 3]."""
    rows, columns = (_bilinear(new, old) for new, old in zip(mask.shape, start.shape[:2], strict=True))
    turned_rows, turned_columns = rows.T.tocsr(), columns.T.tocsr()

    def read(small: torch.Tensor) -> torch.Tensor:
        return _along(columns, _along(rows, small))

    def gathered(image: torch.Tensor) -> torch.Tensor:
        return _along(turned_columns, _along(turned_rows, image * mask[..., None]))

    change = torch.zeros_like(start)
    residual = gathered(filled - read(start))
    direction, energy = residual.clone(), residual.square().sum((0, 1))
    for _ in range(_ROUNDS):
        image = gathered(read(direction)) + _PULL * direction
        curvature = (direction * image).sum((0, 1))
        # A channel that is solved already has a curvature of 0.
        step = torch.where(curvature > 0.0, energy / curvature, 0.0)
        change += step * direction
        residual -= step * image
        before, energy = energy, residual.square().sum((0, 1))
        direction = residual + torch.where(before > 0.0, energy / before, 0.0) * direction
    return start + change


def _bilinear(new: int, old: int) -> sparse.csr_matrix:
    """[new, old], reads `old` texels at the centres of `new` ones, clamped."""
    place = (np.arange(new) + 0.5) * old / new - 0.5
    first = np.floor(place).astype(np.int64)
    column = np.clip(np.stack([first, first + 1]), 0, old - 1)
    weight = np.stack([1.0 - (place - first), place - first])
    row = np.broadcast_to(np.arange(new), (2, new))
    return sparse.csr_matrix((weight.reshape(-1), (row.reshape(-1), column.reshape(-1))), shape=(new, old))


def _box(new: int, old: int) -> sparse.csr_matrix:
    """[new, old], means of `old` texels over the squares of `new` ones."""
    side, texel = np.arange(new + 1) * (old / new), np.arange(old)
    weight = np.minimum(side[1:, None], texel + 1.0) - np.maximum(side[:-1, None], texel)
    return _normalised(np.maximum(weight, 0.0))


def _lanczos(new: int, old: int) -> sparse.csr_matrix:
    """[new, old], a windowed sinc with the bandwidth of `new` texels."""
    scale = old / new
    x = (np.arange(old) + 0.5 - (np.arange(new) + 0.5)[:, None] * scale) / scale
    return _normalised(np.where(np.abs(x) < _LOBES, np.sinc(x) * np.sinc(x / _LOBES), 0.0))


def _normalised(weight: np.ndarray) -> sparse.csr_matrix:
    return sparse.csr_matrix(weight / weight.sum(axis=1, keepdims=True))


_WEIGHTS = {"bilinear": _bilinear, "box": _box, "lanczos": _lanczos}
