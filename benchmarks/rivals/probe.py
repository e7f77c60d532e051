"""Rivals of a compressed probe set: the PCA family, a moving basis, and the 8-bit packing of an engine.

Each function takes N probes, their positions [N, 3] and D values of each, [N, D] in any unit. It returns a `Rival` with
the values decoded from `bytes` bytes, float32 [N, D] (gaussian-probe-compression, sections 2.2 and 5.1). Positions cost
nothing, as in the paper, because an engine has them anyway. The paper's rivals store weights as half floats; weights of
4 or 5 bits leave room for more components and gain several decibels at the same size, so `at_bytes` tries them too.

The functions share two settings: `components`, the number of basis vectors of a part of the set, 1 to D; and `bits`,
the bits of a weight, 1 to 16, over the range of each part and component, or None for half floats. Means and bases are
always half floats. All functions raise a `WlmError` where there are no probes, or NaN or infinite numbers, and a
`ValueError` for wrong shapes or a setting out of range.
"""

import bisect
import functools
from collections.abc import Callable, Sequence

import numpy as np

from benchmarks.rivals import probe_mbd, probe_pca
from benchmarks.rivals.rival import Rival, measure
from wlm.errors import WlmError
from wlm.probe.engines.unreal import RANGE, ambient_colour, packed

# Bits of a weight that `at_bytes` tries; None for half floats. Below 4 bits the rounding error dominates.
WEIGHT_BITS = (4, 5, 6, 8, 10, None)
# Limit of `at_bytes`: more parts take long to compute, and doubling their number gains little.
MAX_PARTS = 512
MAX_GRID = 64
# Component counts that may follow the best so far without an improvement.
_PATIENCE = 2
# Rounds of the moving basis while `at_bytes` searches: the order of the settings is clear after these.
_SEARCH_ROUNDS = 4
_ROUNDS = 10


def global_pca(position: np.ndarray, values: np.ndarray, components: int, *, bits: int | None = None) -> Rival:
    """Compresses all probes with one set of principal components (global PCA)."""
    position, values = _checked(position, values, components, bits)
    return _pca("global_pca", "part", position, values, components, bits, lambda: probe_pca.whole(position))


def clustered_pca(
    position: np.ndarray,
    values: np.ndarray,
    components: int,
    clusters: int,
    seed: int = 0,
    *,
    signal: bool = False,
    bits: int | None = None,
) -> Rival:
    """Compresses each cluster of probes with its own principal components (clustered PCA).

    Args:
        position, values, components, bits: As the module's docstring states.
        clusters: Number of clusters, at least 1; clusters that end up empty are dropped.
        seed: Seed of the initial centres.
        signal: False clusters the positions with k-means (gaussian-probe-compression, section 5.1): the centres are
            stored, and a probe needs no index. True assigns each probe to the cluster that reconstructs it best (Sloan
            et al. 2003): each probe stores an index of ceil(log2 clusters) bits.
    """
    position, values = _checked(position, values, components, bits)
    _in_range("clusters", clusters, 1)
    if signal:
        name, divide = "clustered_pca_signal", lambda: probe_pca.by_signal(values, clusters, components, seed)
    else:
        name, divide = "clustered_pca", lambda: probe_pca.by_place(position, clusters, seed)
    return _pca(name, "clusters", position, values, components, bits, divide)


def moving_basis(
    position: np.ndarray,
    values: np.ndarray,
    components: int,
    grid: int,
    iterations: int = _ROUNDS,
    *,
    bits: int | None = None,
) -> Rival:
    """Compresses probes at any positions by moving basis decomposition (Silvennoinen and Sloan 2021).

    Args:
        position, values, components, bits: As the module's docstring states, where a part is a cell of the grid.
        grid: Cells along the longest side of the probes' box, 1 to 2**20.
        iterations: Rounds of alternating least squares, which start from the PCA of all probes; at least 0.
    """
    position, values = _checked(position, values, components, bits)
    _in_range("grid", grid, 1, probe_pca.MAX_CELLS)
    _in_range("iterations", iterations, 0)
    return measure(
        "moving_basis",
        lambda: probe_mbd.encode(position, values, components, grid, iterations, bits),
        lambda payload: probe_mbd.decode(payload, position),
        option=lambda payload: f"K={components}, grid {grid}, {_weights(bits)}",
    )


def unreal_packing(position: np.ndarray, values: np.ndarray) -> Rival:
    """Packs spherical harmonics like Unreal's volumetric lightmap, without sky occlusion: 28 bytes a probe at order 2.

    The ambient colour, coefficient L00, is stored as R11G11B10F; values above 65,024 (64,512 in blue) are clamped.
    Every other coefficient is stored in 8 bits as its ratio to the ambient colour, which is 0 where the ambient is not
    above 0. Ratios are clamped to the range that light without negative values can have, up to rounding.
    Everything is rounded to nearest. Ratios are taken to the ambient colour as it is decoded, which costs nothing and
    is more exact than the engine's own ratio.

    Args:
        position: Positions of the probes; only their number is used.
        values: Coefficients from L00 on, each in red, green and blue: 3, 12 or 27 numbers (order 0, 1 or 2) take 4, 13
            or 28 bytes. Any other count raises a `WlmError`.
    """
    position, values = _checked(position, values)
    width = values.shape[1]
    bands = {3: 1, 12: 2, 27: 3}.get(width)
    if bands is None:
        raise WlmError(f"probes: unreal: expected 3, 12 or 27 numbers a probe (RGB of order 0, 1 or 2), got {width}")
    return measure(
        "unreal",
        lambda: pack_unreal(values, bands),
        lambda payload: unpack_unreal(payload, width, bands),
        option=lambda payload: f"L{bands - 1}",
    )


def pack_unreal(values: np.ndarray, bands: int) -> bytes:
    """Packs SH [N, D] up to `bands` to bytes: uint32 [N] ambient colours, then uint8 [N, 3, bands² - 1] ratios."""
    ambient, level = packed(np.asarray(values, np.float64).reshape(len(values), -1, 3)[:, : bands**2])
    return ambient.tobytes() + level.tobytes()


def unpack_unreal(payload: bytes, width: int, bands: int) -> np.ndarray:
    """Unpacks the result of `pack_unreal` to float32 [N, width]; coefficients beyond the stored bands are zero."""
    probes = len(payload) // (4 + 3 * (bands**2 - 1))
    level = np.frombuffer(payload, np.uint8, offset=4 * probes).reshape(probes, 3, bands**2 - 1)
    colour = ambient_colour(np.frombuffer(payload, "<u4", probes))
    sh = np.zeros((probes, width // 3, 3), np.float32)
    sh[:, 0] = colour
    sh[:, 1 : bands**2] = ((level / 127.5 - 1.0) * colour[:, :, None] * RANGE[: bands**2 - 1]).transpose(0, 2, 1)
    return sh.reshape(probes, width)


def at_bytes(
    name: str, position: np.ndarray, values: np.ndarray, budget_bytes: int, bits: Sequence[int | None] = WEIGHT_BITS
) -> Rival:
    """Searches for the settings with which one method has the least squared error within a size in bytes.

    Numbers of bits are tried in their order, until one is no better than the one before. For each, numbers of
    components are tried from the largest down, until two in a row are no better.
    Each is tried with as many parts as fit: at most `MAX_PARTS` clusters, or `MAX_GRID` cells along the longest side.

    Args:
        name: A key of `RIVALS`.
        position, values: As the module's docstring states.
        budget_bytes: The maximum size in bytes.
        bits: Bits of a weight to try; `(None,)` tries half floats alone, as in gaussian-probe-compression.

    Returns:
        The best result; its times are those of its settings alone, without the search.

    Raises:
        WlmError: The name is unknown, or no settings fit the budget.
    """
    if name not in RIVALS:
        raise WlmError(f"probes: unknown baseline {name!r}, expected one of {', '.join(RIVALS)}")
    for number in bits:
        _check_bits(number)
    position, values = _checked(position, values)
    best = RIVALS[name](position, values, budget_bytes, bits)
    if best is None:
        raise WlmError(f"probes: {name}: no settings fit {len(values)} probes into {budget_bytes} bytes")
    return best


def _search(
    values: np.ndarray,
    bits: Sequence[int | None],
    largest: Callable[[int, int | None], int],
    make: Callable[[int, int, int | None], Rival],
) -> tuple[Rival, tuple[int, int, int | None]] | None:
    """Searches for the numbers of components, parts and bits with the least squared error, for `at_bytes`.

    `largest` returns how many parts fit with given components and bits, or 0; `make` compresses with all three.
    Returns the best result and its three settings, or None if nothing fits.
    """
    tried: list[tuple[float, Rival, tuple[int, int, int | None]]] = []
    before = np.inf
    for number in bits:
        least, waited = np.inf, 0
        for components in range(values.shape[1], 0, -1):
            parts = largest(components, number)
            if not parts:
                continue
            rival = make(components, parts, number)
            error = _error(values, rival)
            tried.append((error, rival, (components, parts, number)))
            waited = 0 if error < least else waited + 1
            least = min(least, error)
            if waited == _PATIENCE:
                break
        if least >= before < np.inf:
            break
        before = least
    return min(tried, key=lambda entry: (entry[0], entry[1].bytes))[1:] if tried else None


def _pca_at(
    kind: int,
    make: Callable[..., Rival],
    position: np.ndarray,
    values: np.ndarray,
    budget: int,
    bits: Sequence[int | None],
) -> Rival | None:
    probes, width = values.shape
    most = 1 if kind == probe_pca.WHOLE else min(probes, MAX_PARTS)

    def largest(components: int, number: int | None) -> int:
        size = functools.partial(probe_pca.payload_bytes, kind, probes, width, components, bits=number)
        return bisect.bisect_right(range(1, most + 1), budget, key=lambda parts: size(count=parts))

    def build(components: int, parts: int, number: int | None) -> Rival:
        divided = () if kind == probe_pca.WHOLE else (parts,)
        return make(position, values, components, *divided, bits=number)

    best = _search(values, bits, largest, build)
    return best[0] if best else None


def _moving_at(position: np.ndarray, values: np.ndarray, budget: int, bits: Sequence[int | None]) -> Rival | None:
    probes, width = values.shape
    grids: list[tuple[int, int]] = []
    while len(grids) < MAX_GRID:
        parts = probe_mbd.grid_parts(position, len(grids) + 1)
        # A finer grid has more corners, so none after this one would fit.
        if parts[0] * 4 * width > budget:
            break
        grids.append(parts)

    def largest(components: int, number: int | None) -> int:
        size = functools.partial(probe_mbd.payload_bytes, probes, width, components, bits=number)
        return max((g for g, parts in enumerate(grids, 1) if size(parts=parts) <= budget), default=0)

    def build(components: int, grid: int, number: int | None) -> Rival:
        return moving_basis(position, values, components, grid, _SEARCH_ROUNDS, bits=number)

    best = _search(values, bits, largest, build)
    if best is None:
        return None
    first, (components, grid, number) = best
    longer = moving_basis(position, values, components, grid, bits=number)
    return min((first, longer), key=lambda rival: _error(values, rival))


RIVALS: dict[str, Callable[[np.ndarray, np.ndarray, int, Sequence[int | None]], Rival | None]] = {
    "global_pca": functools.partial(_pca_at, probe_pca.WHOLE, global_pca),
    "clustered_pca": functools.partial(_pca_at, probe_pca.PLACE, clustered_pca),
    "clustered_pca_signal": functools.partial(_pca_at, probe_pca.SIGNAL, functools.partial(clustered_pca, signal=True)),
    "moving_basis": _moving_at,
}
"""Rivals by name: functions of positions, values, bytes and the bits to try that return the best `Rival`."""


def _pca(
    name: str,
    parts: str,
    position: np.ndarray,
    values: np.ndarray,
    components: int,
    bits: int | None,
    divide: Callable[[], probe_pca.Partition],
) -> Rival:
    return measure(
        name,
        lambda: probe_pca.encode(values, divide(), components, bits),
        lambda payload: probe_pca.decode(payload, position),
        option=lambda payload: f"K={components}, {probe_pca.part_count(payload)} {parts}, {_weights(bits)}",
    )


def _error(values: np.ndarray, rival: Rival) -> float:
    return float(np.square(rival.decoded - values).sum())


def _weights(bits: int | None) -> str:
    return "half floats" if bits is None else f"{bits} bits"


def _checked(
    position: np.ndarray, values: np.ndarray, components: int = 1, bits: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Checks positions and values, and returns them as float64 arrays, with the values rounded to float32."""
    position = np.asarray(position, np.float64)
    with np.errstate(over="ignore"):  # beyond float32 becomes infinite, and is refused as that
        values = np.asarray(values).astype(np.float32).astype(np.float64)
    if values.ndim != 2 or position.shape != (len(values), 3):
        raise ValueError(f"expected positions [N, 3] and values [N, D], got {position.shape} and {values.shape}")
    if 0 in values.shape:
        raise WlmError(f"probes: expected at least one probe with at least one number, got {values.shape}")
    for name, numbers in (("positions", position), ("values", values)):
        bad = np.count_nonzero(~np.isfinite(numbers).all(1))
        if bad:
            raise WlmError(f"probes: the {name} of {bad} of {len(numbers)} probes are NaN or infinite")
    _in_range("components", components, 1, values.shape[1])
    _check_bits(bits)
    return position, values


def _check_bits(bits: int | None) -> None:
    if bits is not None:
        _in_range("bits", bits, 1, 16)


def _in_range(name: str, value: float, low: float, high: float = np.inf) -> None:
    if not low <= value <= high or not np.isfinite(value):
        raise ValueError(f"{name}: expected a number from {low} to {high}, got {value}")
