"""How much of probes' light is noise, told from probes that are next to each other.

Half the mean square of what two probes differ by, as their distance goes to zero, is the variance of what each has for
itself (the nugget of a variogram: Cressie, Statistics for Spatial Data, section 2.3): what a bake's paths left, since
light itself would be the same. It is taken from a fit of 1, h and h² with factors that aren't negative to pairs nearer
than most, and not believed unless it is three times its own standard error.
"""

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import cKDTree

from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet

_NEIGHBOURS = 4
_PAIRS = 100_000  # looked at, at most
_BINS, _EACH = 20, 40  # of distances; pairs in each, at least
_FEWEST = 200
_CLOSE, _FEWEST_CLOSE = 0.3, 40  # of the median distance, and pairs that are that close: on a lattice there are none
_PARTS = 10  # of which one is left out at a time
_SURE = 3.0


def noise_psnr(probes: ProbeSet) -> float | None:
    """The PSNR of a set's own noise: a codec's error above it tells light, one below it is spent on noise.

    Args:
        probes: The set.

    Returns:
        dB over all numbers of all probes, as a report's `psnr` (dead ones have no noise); None where it can't be told:
        no pairs are close enough, or light that changes as much hides it.
    """
    place, values = probes.position[probes.live], probes.values[probes.live]
    if len(place) < _FEWEST:
        return None
    distance, index = cKDTree(place).query(place, k=_NEIGHBOURS)
    apart = distance[:, 1][distance[:, 1] > 0.0]
    if not len(apart):
        return None
    median = float(np.median(apart))
    first, other = np.repeat(np.arange(len(place)), _NEIGHBOURS - 1), index[:, 1:].ravel()
    # Each pair once, whichever of the two is the other's neighbour.
    near = np.flatnonzero(distance[:, 1:].ravel() <= median)
    pairs = np.unique(np.sort(np.stack([first[near], other[near]], 1), axis=1), axis=0)
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    pairs = pairs[:: -(-len(pairs) // _PAIRS)]
    away = np.linalg.norm(place[pairs[:, 0]] - place[pairs[:, 1]], axis=1) / median
    if len(pairs) < _FEWEST or np.count_nonzero(away < _CLOSE) < _FEWEST_CLOSE:
        return None
    change = values[pairs[:, 0]].astype(np.float64) - values[pairs[:, 1]]
    square = 0.5 * np.square(change).mean(1)
    order = np.argsort(away, kind="stable")
    away, square = away[order], square[order]
    part = np.random.default_rng(0).integers(0, _PARTS, len(square))
    left_out = [_nugget(away[part != number], square[part != number]) for number in range(_PARTS)]
    error = np.sqrt((_PARTS - 1) * np.var(left_out))
    nugget = _nugget(away, square)
    if not nugget > _SURE * error:
        return None
    return psnr_from_mse(nugget * float(probes.live.mean()), float(np.ptp(probes.values)))


def _nugget(away: np.ndarray, square: np.ndarray) -> float:
    """What is left at no distance; of distances [P], rising, and squares [P]."""
    bins = np.array_split(np.arange(len(away)), min(_BINS, len(away) // _EACH))
    x, y = (np.array([numbers[each].mean() for each in bins]) for numbers in (away, square))
    # What is far varies most: each bin counts by its share, not by its size.
    weight = 1.0 / np.maximum(y, 1e-12 * max(float(y.max()), np.finfo(np.float64).tiny))
    powers = np.stack([np.ones_like(x), x, x * x], 1)
    return float(nnls(powers * weight[:, None], y * weight)[0][0])
