"""Moving basis decomposition (Silvennoinen and Sloan 2021) for probes at any positions.

    y_n ~ m(x_n) + sum_j w_nj b_j(x_n)

Probe y_n at position x_n has K weights w_nj. The mean m and the K basis vectors b_j are interpolated trilinearly from
the corners of a coarse grid. One mean and basis for all probes would be global PCA, and one for each cell blockwise
PCA, whose seams the interpolation removes. Weights belong to probes and not to a second grid, so probes can be
anywhere; gaussian-probe-compression, section 2.2, says that the method does not allow this.

What is stored, in this order and little-endian: a header (bits of a weight, 0 for half floats; D numbers per probe, K,
cells along the box's longest side, scale), means and bases at V corners, float16 [V, K + 1, D] in units of the scale,
and weights as in `probe_pca`, where each cell is a part. Only corners that some probe's interpolation reads and cells
with a probe are stored; a decoder finds them from the positions.
"""

import struct

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from benchmarks.rivals.probe_pca import (
    HALF_MAX,
    cell_keys,
    compact,
    extent_of,
    fit_subspaces,
    read_weights,
    rescale,
    scale_of,
    weight_bytes,
    write_weights,
)
from wlm.errors import WlmError

_HEADER = struct.Struct("<BHHIf")
# Weight of the damping term, relative to the mean of the normal equations' diagonal. It makes every system definite,
# also at corners that affect almost no probe, and cannot raise the error.
_STAY = 1e-3


class Solver:
    """Alternating least squares for weights and bases, which starts from the PCA of all probes.

    Each half step minimises the squared error plus a small multiple of the squared change, so the error never rises.
    The largest array has the bases at all N probes, 8 N (K + 1) D bytes: 50 MB for 15,000 probes, D = 27 numbers and
    K = 15 components.

    Attributes:
        corner: Mean and K basis vectors at each of V grid corners, float64 [V, K + 1, D].
        weight: K weights of each probe, float64 [N, K].
    """

    def __init__(self, position: np.ndarray, values: np.ndarray, components: int, grid: int) -> None:
        """Initialises weights and corners by the PCA of all probes.

        Args:
            position: float64 [N, 3].
            values: D numbers of each probe, float64 [N, D].
            components: K, the number of basis vectors, 1 to D.
            grid: Cells along the longest side of the probes' box, at least 1.
        """
        self._values = values
        self._near, self._share, _ = _interpolation(position, grid)
        mean, basis = fit_subspaces(values, [np.arange(len(values))], components)
        self.corner = np.repeat(np.concatenate([mean[:, None], basis], 1), self._near.max() + 1, 0)
        self.weight = (values - mean) @ basis[0].T

    def step(self, rounds: int = 1) -> None:
        """Improves the corners and then the weights, `rounds` times."""
        for _ in range(rounds):
            self.solve_corners()
            self.solve_weights()

    def error(self) -> float:
        """Returns the sum of squared errors of all probes' numbers with the current corners and weights."""
        return float(np.square(self._residual(self._at_probes())).sum())

    def solve_weights(self) -> None:
        """Solves for the weights while corners are fixed, and normalises them to a root mean square of 1."""
        here = self._at_probes()
        basis = here[:, 1:]
        gram = basis @ basis.transpose(0, 2, 1)
        gram += np.eye(gram.shape[1]) * (_STAY * gram.diagonal(0, 1, 2).mean() or 1.0)
        right = np.matmul(basis, self._residual(here)[:, :, None])
        self.weight += np.linalg.solve(gram, right)[:, :, 0]
        size = np.sqrt(np.square(self.weight).mean(0))
        size[size == 0.0] = 1.0
        self.weight /= size
        self.corner[:, 1:] *= size[:, None]

    def solve_corners(self) -> None:
        """Solves for means and bases at the corners while weights are fixed."""
        corners, columns, width = self.corner.shape
        factor = np.concatenate([np.ones((len(self.weight), 1)), self.weight], 1)
        data = self._share[:, :, None] * factor[:, None, :]
        column = self._near[:, :, None] * columns + np.arange(columns)
        row = np.arange(len(factor) + 1) * (8 * columns)
        design = sparse.csr_array((data.ravel(), column.ravel(), row), shape=(len(factor), corners * columns))
        normal = (design.T @ design).tocsc()
        normal += sparse.eye_array(normal.shape[0], format="csc") * (_STAY * normal.diagonal().mean())
        right = design.T @ self._residual(self._at_probes())
        # No pivoting: the matrix is definite.
        options = {"SymmetricMode": True}
        solved = splu(normal, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options).solve(right)
        self.corner += solved.reshape(corners, columns, width)

    def _at_probes(self) -> np.ndarray:
        """Returns the mean and the basis vectors interpolated at each probe, [N, K + 1, D]."""
        return _interpolate(self.corner, self._near, self._share)

    def _residual(self, here: np.ndarray) -> np.ndarray:
        return self._values - here[:, 0] - np.matmul(self.weight[:, None, :], here[:, 1:])[:, 0]


def encode(
    position: np.ndarray, values: np.ndarray, components: int, grid: int, iterations: int, bits: int | None
) -> bytes:
    """Fits a moving basis and packs it.

    Args:
        position: float64 [N, 3].
        values: D numbers of each probe, float64 [N, D].
        components: K, the number of basis vectors, 1 to D.
        grid: Cells along the longest side of the probes' box, 1 to `MAX_CELLS`.
        iterations: Rounds of the solver, at least 0; with 0 rounds this is global PCA.
        bits: Bits of a weight, 1 to 16, over the range of each cell and component; None for half floats.

    Returns:
        The bytes in the layout that the module's docstring describes.
    """
    scale = scale_of(values)
    solver = Solver(position, values / scale, components, grid)
    solver.step(iterations)
    # Solving for the corners again compensates part of the rounding of the weights.
    _, _, cell = _interpolation(position, grid)
    weights = write_weights(solver.weight, cell, cell.max() + 1, bits)
    solver.weight = read_weights(weights, cell, cell.max() + 1, components, bits).astype(np.float64)
    if iterations:
        solver.solve_corners()
    corner = np.clip(solver.corner, -HALF_MAX, HALF_MAX).astype("<f2")
    return _HEADER.pack(bits or 0, values.shape[1], components, grid, scale) + corner.tobytes() + weights


def decode(payload: bytes, position: np.ndarray) -> np.ndarray:
    """Decodes the probes at positions [N, 3] to float32 [N, D]; a `WlmError` if the payload doesn't fit them."""
    probes = len(position)
    try:
        bits, width, components, grid, scale = _HEADER.unpack_from(payload)
    except struct.error as error:
        raise WlmError(f"probes: expected a moving basis with a header, got {len(payload)} bytes") from error
    near, share, cell = _interpolation(position, grid)
    size = payload_bytes(probes, width, components, (near.max() + 1, cell.max() + 1), bits or None)
    if size != len(payload):
        raise WlmError(f"probes: expected a payload of {size} bytes for {probes} probes, got {len(payload)}")
    shape = (near.max() + 1, components + 1, width)
    corner = np.frombuffer(payload, "<f2", np.prod(shape), _HEADER.size).reshape(shape).astype(np.float32)
    start = _HEADER.size + corner.size * 2
    weight = read_weights(payload[start:], cell, cell.max() + 1, components, bits or None)
    here = _interpolate(corner, near, share.astype(np.float32))
    return rescale(here[:, 0] + np.matmul(weight[:, None, :], here[:, 1:])[:, 0], scale)


def payload_bytes(probes: int, width: int, components: int, parts: tuple[int, int], bits: int | None) -> int:
    """Returns a payload's bytes, for `width` numbers per probe, `parts` from `grid_parts` and `bits` per weight."""
    corners, cells = parts
    return _HEADER.size + corners * (components + 1) * width * 2 + weight_bytes(probes, components, cells, bits)


def grid_parts(position: np.ndarray, grid: int) -> tuple[int, int]:
    """Returns the number of grid corners that some probe's interpolation reads, and of cells that contain a probe."""
    near, _, cell = _interpolation(position, grid)
    return int(near.max()) + 1, int(cell.max()) + 1


def _interpolate(corner: np.ndarray, near: np.ndarray, share: np.ndarray) -> np.ndarray:
    here = np.zeros((len(near), *corner.shape[1:]), corner.dtype)
    for k in range(8):
        here += share[:, k, None, None] * corner[near[:, k]]
    return here


def _interpolation(position: np.ndarray, grid: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Locates the probes in the grid.

    Returns:
        The 8 corners around each probe, int64 [N, 8]; their trilinear shares, float64 [N, 8]; and the cell that each
        probe lies in, int64 [N]. Only corners with a share and cells with a probe are numbered, from 0.
    """
    at = (position - position.min(0)) * (grid / extent_of(position))
    # A probe on the box's far side belongs to the last cell, not to one behind it.
    cell = np.minimum(np.floor(at), grid - 1)
    inside = at - cell
    offset = np.stack(np.meshgrid((0, 1), (0, 1), (0, 1), indexing="ij"), -1).reshape(8, 3)
    share = np.where(offset, inside[:, None], 1.0 - inside[:, None]).prod(2)
    key = cell_keys(cell[:, None] + offset)
    # A corner without a share is replaced by the one with the largest share.
    most = np.take_along_axis(key, share.argmax(1)[:, None], 1)
    near = compact(np.where(share > 0.0, key, most).ravel())[0]
    return near.reshape(key.shape), share, compact(cell_keys(cell))[0]
