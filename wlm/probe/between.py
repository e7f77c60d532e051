"""Light where no probe was compressed: at probes that are held out of a fit, and half-way between probes.

An engine reads probes between them. There is no bake there to compare with, so two things are scored instead. Every
fifth probe is left out of a fit of the others, and the light that is decoded at its place is compared with it; what the
uncompressed others give there by the plain rules of engines is beside it. And half-way from each probe to its nearest
the decoded light is compared with what the uncompressed probes give there by kriging.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.day import DayModel
from wlm.probe.fit import compress
from wlm.probe.kriging import Kriging
from wlm.probe.model import ProbeModel
from wlm.probe.transform import Transform
from wlm.system import OnProgress

EVERY = 5
"""One of so many live probes is held out."""

_NEAREST = 8  # probes that are weighted by the inverse square of their distance


@dataclass(frozen=True)
class HeldOut:
    """How well light is told where nothing was compressed, dB of all numbers of the probes held out.

    The peak is the range of the live probes' numbers.

    Attributes:
        probes: How many were held out.
        bytes: Size of the file of the others.
        psnr: Of what that file decodes to at their places.
        nearest: Of the nearest of the others, uncompressed.
        distance: Of the eight nearest of the others, uncompressed, weighted by the inverse square of their distance.
        kriging: Of the others, uncompressed, by `wlm.probe.kriging`: what a transform gives without any loss.
    """

    probes: int
    bytes: int
    psnr: float
    nearest: float
    distance: float
    kriging: float


def held_out(
    model: ProbeModel | Transform,
    probes: ProbeSet,
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> HeldOut:
    """Fits four fifths of a set as a model was, and decodes the places of the rest.

    Args:
        model: Of the whole set: Gaussians are fitted with its settings, a transform in four fifths of its bytes.
        probes: The whole set.
        seed, device, progress: As for `wlm.probe.compress`.

    Raises:
        WlmError: Fewer than two live probes, no such device, or a fit that failed.
    """
    if isinstance(model, DayModel):
        raise WlmError(f"{model.name}: expected one hour to hold probes out of, found a file of {len(model.times)}")
    live = np.flatnonzero(probes.live)
    if len(live) < 2:
        raise WlmError(f"{probes.name}: expected at least 2 live probes to hold one out, found {len(live)}")
    out = np.arange(len(live)) % EVERY == min(EVERY, len(live)) - 1
    known, asked = live[~out], live[out]
    others = from_arrays(probes.position[known], probes.values[known], name=probes.name)
    settings: dict[str, Any] = {}
    if isinstance(model, Transform):
        # The others' file has no positions.
        settings["max_bytes"] = model.without_places().file_bytes() * (EVERY - 1) // EVERY
    try:
        fitted = compress(others, model.profile, seed=seed, device=device, progress=progress, **settings)
    except WlmError as error:
        raise WlmError(f"{probes.name}: cannot fit {len(known)} probes to hold out {len(asked)}: {error}") from error
    decoder = fitted.decoder(device)
    decoder.decode_probes(others.position)
    return score_held(decoder, others, probes, asked, fitted.file_bytes())


def score_held(decoder: Any, others: ProbeSet, probes: ProbeSet, asked: np.ndarray, size: int) -> HeldOut:
    """Scores the light where probes were left out of a fit.

    Args:
        decoder: Of the fit, which knows its places.
        others: What was fitted.
        probes: The whole set.
        asked: int [M], which of them were left out and are live.
        size: Bytes of the fit's file.
    """
    position, expected = probes.position[asked], probes.values[asked].astype(np.float64)
    peak = float(np.ptp(probes.values[probes.live]))

    def score(values: np.ndarray) -> float:
        return psnr_from_mse(float(np.square(values - expected).mean()), peak)

    return HeldOut(
        probes=len(asked),
        bytes=size,
        psnr=score(decoder.decode(position)),
        nearest=score(by_distance(others, position, 1)),
        distance=score(by_distance(others, position, _NEAREST)),
        kriging=score(by_kriging(others, position)),
    )


def between_psnr(decoder: Any, probes: ProbeSet) -> float:
    """The PSNR of decoded light half-way from each live probe to its nearest.

    Args:
        decoder: A decoder that knows its places.
        probes: The input.

    Returns:
        dB against the kriging of the live probes of the input, over the range of their numbers; NaN for fewer than two.
    """
    place, values = probes.position[probes.live], probes.values[probes.live]
    if len(place) < 2:
        return float("nan")
    nearest = cKDTree(place).query(place, k=2)[1][:, 1]
    middle = 0.5 * (place + place[nearest])
    error = decoder.decode(middle) - by_kriging(probes, middle)
    return psnr_from_mse(float(np.square(error).mean()), float(np.ptp(values)))


def by_distance(probes: ProbeSet, position: np.ndarray, count: int) -> np.ndarray:
    """Light at points [M, 3] from the nearest live probes, weighted by 1 / distance²; float64 [M, D]."""
    place, values = probes.position[probes.live], probes.values[probes.live].astype(np.float64)
    count = min(count, len(place))
    distance, index = cKDTree(place).query(position, k=count)
    distance, index = distance.reshape(len(position), count), index.reshape(len(position), count)
    # A probe at the point itself takes all of the weight.
    least = np.maximum(distance[:, :1], np.finfo(np.float64).tiny)
    weight = np.square(least / np.maximum(distance, least * 1e-9))
    weight /= weight.sum(1, keepdims=True)
    return (values[index] * weight[..., None]).sum(1)


def by_kriging(probes: ProbeSet, position: np.ndarray) -> np.ndarray:
    """Light at points [M, 3] from live probes by kriging; float64 [M, D]."""
    place, values = probes.position[probes.live], probes.values[probes.live].astype(np.float64)
    low = place.min(0)
    index, weight = Kriging(place - low).weights(np.clip(position - low, 0.0, np.ptp(place, axis=0)))
    return (values[index] * weight[..., None]).sum(1)
