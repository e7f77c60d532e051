"""Where a model's probes are, and how large and how bright a ball may stand for each."""

import os
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.probe.data import load
from wlm.probe.model import ProbeModel, live_probes
from wlm.probe.sphere import fibonacci_sphere, irradiance
from wlm.probe.transform import Transform
from wlm.texels import exposure

_NORMALS = 32
_SHARE = 0.45  # of the median distance between neighbours: balls don't touch


class Known(NamedTuple):
    """What is known of a model's probes.

    Attributes:
        position: float64 [N, 3].
        values: float32 [N, D], as they were; None where the file that was compressed isn't there.
        live: bool [N].
        normal: float64 [N, 3], as of `wlm.probe.ProbeSet`.
    """

    position: np.ndarray
    values: np.ndarray | None
    live: np.ndarray
    normal: np.ndarray | None


def probes_of(model: ProbeModel | Transform, original: str | os.PathLike[str] | None, key: str | None = None) -> Known:
    """The places of a model's probes, and with the file that was compressed their numbers and normals.

    Args:
        model: The model.
        original: The file that was compressed; None: the positions stored with the model.
        key: Which of the file's arrays, as for `wlm.probe.load`.

    Raises:
        WlmError: No positions are known, or the file can't be read or is of other probes.
    """
    live = live_probes(model.dead, model.probes)
    if original is not None:
        probes = load(original, key=key)
        if len(probes.position) != model.probes or probes.values.shape[1] != model.outputs:
            raise WlmError(
                f"{original}: expected {model.probes} probes of {model.outputs} numbers, found "
                f"{len(probes.position)} of {probes.values.shape[1]}"
            )
        return Known(probes.position, probes.values, live, probes.normal)
    if not model.has_positions:
        raise WlmError(f"{model.name}: the file has no positions; expected --original, the file that was compressed")
    return Known(model.stored_positions(), None, live, None)


def ball_exposure(values: np.ndarray) -> float:
    """The exposure at which nearly all of white diffuse balls under SH radiance [N, C, 3] is below white."""
    return exposure(irradiance(values, fibonacci_sphere(_NORMALS)) / np.pi)


def ball_radius(position: np.ndarray) -> float:
    """A radius at which balls at places [N, 3] stay apart; 1 where there is but one place."""
    nearest = cKDTree(position).query(position, k=2)[0][:, 1] if len(position) > 1 else np.zeros(0)
    apart = nearest[nearest > 0]
    return _SHARE * float(np.median(apart)) if apart.size else 1.0
