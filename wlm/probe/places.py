"""Finds positions of a model's probes, and the radius and exposure of balls that show the probes."""

import os
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.probe.data import load, load_positions
from wlm.probe.model import ProbeModel
from wlm.probe.sphere import fibonacci_sphere, irradiance
from wlm.texels import exposure

_NORMALS = 32
_SHARE = 0.45  # radius of a ball over the median distance between neighbours, so that balls do not touch


class Known(NamedTuple):
    """The positions of a model's probes, float64 [N, 3], and their original light, float32 [N, D], None if the input
    was not given. `live`, bool [N], is false for dead probes; `normal`, float64 [N, 3] or None, is that of
    `wlm.probe.ProbeSet`."""

    position: np.ndarray
    values: np.ndarray | None
    live: np.ndarray
    normal: np.ndarray | None


def probes_of(
    model: ProbeModel, original: str | os.PathLike[str] | None, key: str | None = None, time: float | None = None
) -> Known:
    """Finds the positions of a model's probes, and reads their values and normals from the input of the fit.

    Args:
        model: The model, of one hour.
        original: The file that was compressed; None: the positions stored with the model are used.
        key: Name of the file's array, as for `wlm.probe.load`.
        time: Hour of the day of the file's values, if it has several.

    Raises:
        WlmError: No positions are known, or the file cannot be read or has other probes.
    """
    live = model.live
    if original is not None:
        probes = load(original, key=key).at(time)
        if not model.has_probes_at(probes.position) or probes.outputs != model.outputs:
            raise WlmError(
                f"{original}: expected the {model.probes} probes of {model.outputs} numbers of {model.name}, in their "
                f"order, found {probes.probes} of {probes.outputs}"
            )
        return Known(probes.position, probes.values, live, probes.normal)
    if not model.has_positions:
        raise WlmError(f"{model.name}: the file stores no positions; expected --original, the file that was compressed")
    return Known(model.stored_positions(), None, live, None)


def positions_of(model: ProbeModel, original: str | os.PathLike[str] | None) -> np.ndarray | None:
    """Reads the positions of a model's probes from another file, float64 [N, 3]; None if no file is given. Raises a
    WlmError if the file cannot be read or has other probes."""
    if original is None:
        return None
    position = load_positions(original)
    if not model.has_probes_at(position):
        raise WlmError(f"{original}: expected the {model.probes} probes of {model.name}, in their order")
    return position


def nearest_weights(tree: cKDTree, points: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Finds the nearest probes at points [M, 3], and their weights by the inverse square of the distance.

    Returns:
        Indices of the `count` nearest probes in the tree, or of all if there are fewer, int [M, K]; and their weights,
        float64 [M, K], with the sum 1 at each point. A probe at the point itself takes all of the weight.
    """
    distance, index = tree.query(points, k=np.arange(1, min(count, tree.n) + 1))
    least = np.maximum(distance[:, :1], np.finfo(np.float64).tiny)
    weight = np.square(least / np.maximum(distance, least * 1e-9))
    return index, weight / weight.sum(1, keepdims=True)


def ball_exposure(values: np.ndarray) -> float:
    """Returns the exposure at which white diffuse balls, lit by SH radiance [N, C, 3], are hardly anywhere clipped."""
    return exposure(np.maximum(irradiance(values, fibonacci_sphere(_NORMALS)), 0.0) / np.pi)


def ball_radius(position: np.ndarray) -> float:
    """Returns a radius for balls at positions [N, 3]: 0.45 of the median distance to the nearest other; 1 if none."""
    nearest = cKDTree(position).query(position, k=2)[0][:, 1] if len(position) > 1 else np.zeros(0)
    apart = nearest[nearest > 0]
    return _SHARE * float(np.median(apart)) if apart.size else 1.0
