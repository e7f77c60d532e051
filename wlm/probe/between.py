"""Scores of the light between probes: half-way to a neighbour, and at probes that are left out of a fit.

An engine reads light between probes, where no bake exists to compare with. Two scores stand in. Half-way from each
probe to its nearest neighbour, the decoded light is compared with an interpolation of the uncompressed probes. And
every fifth probe is left out of a second fit, whose light at that place is compared with the probe.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.decode import Decoder
from wlm.probe.fit import compress
from wlm.probe.model import ProbeModel
from wlm.system import OnProgress

EVERY = 5
"""One in this many live probes is left out."""

_NEAREST = 8  # probes that are weighted by the inverse square of their distance


@dataclass(frozen=True)
class HeldOut:
    """Errors at the probes that were left out, in dB over all their numbers; the peak is the range of the live probes.

    Attributes:
        probes: Number of probes that were left out.
        bytes: File size of the fit to the others.
        psnr: PSNR of that fit at the left-out probes.
        nearest: PSNR of the nearest of the other probes, uncompressed.
        distance: PSNR of the eight nearest others, uncompressed, weighted by the inverse square of their distance.
    """

    probes: int
    bytes: int
    psnr: float
    nearest: float
    distance: float


def held_out(
    model: ProbeModel,
    probes: ProbeSet,
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> HeldOut:
    """Fits four fifths of a set with a model's settings, and scores the light at the other probes.

    Args:
        model: A model of the whole set.
        probes: The whole set.
        seed, device, progress: As for `wlm.probe.compress`.

    Raises:
        WlmError: There are fewer than two live probes, the device does not exist, or the fit failed.
    """
    live = np.flatnonzero(probes.live)
    if len(live) < 2:
        raise WlmError(f"{probes.name}: expected at least 2 live probes to leave one out, found {len(live)}")
    out = np.arange(len(live)) % EVERY == min(EVERY, len(live)) - 1
    known, asked = live[~out], live[out]
    others = from_arrays(probes.position[known], probes.values[known], name=probes.name)
    fitted = compress(others, model.profile, seed=seed, device=device, progress=progress, method=model.method)
    decoder = fitted.decoder(device, position=others.position)
    position, expected = probes.position[asked], probes.values[asked].astype(np.float64)
    peak = float(np.ptp(probes.values[probes.live]))

    def score(values: np.ndarray) -> float:
        return psnr_from_mse(float(np.square(values - expected).mean()), peak)

    return HeldOut(
        probes=len(asked),
        bytes=fitted.file_bytes(),
        psnr=score(decoder.decode(position)),
        nearest=score(by_distance(others, position, 1)),
        distance=score(by_distance(others, position, _NEAREST)),
    )


def between_psnr(decoder: Decoder, probes: ProbeSet) -> float:
    """Scores decoded light half-way from each live probe to its nearest neighbour.

    Args:
        decoder: A decoder that has the positions of its probes.
        probes: The input.

    Returns:
        PSNR in dB against the eight nearest probes of the input, weighted by the inverse square of their distance; the
        peak is the range of the live probes. NaN for fewer than two live probes.
    """
    place, values = probes.position[probes.live], probes.values[probes.live]
    if len(place) < 2:
        return float("nan")
    nearest = cKDTree(place).query(place, k=2)[1][:, 1]
    middle = 0.5 * (place + place[nearest])
    error = decoder.decode(middle) - by_distance(probes, middle, _NEAREST)
    return psnr_from_mse(float(np.square(error).mean()), float(np.ptp(values)))


def by_distance(probes: ProbeSet, position: np.ndarray, count: int) -> np.ndarray:
    """Interpolates the nearest live probes at points [M, 3] with weights 1 / distance^2; float64 [M, D]."""
    place, values = probes.position[probes.live], probes.values[probes.live].astype(np.float64)
    count = min(count, len(place))
    distance, index = cKDTree(place).query(position, k=np.arange(1, count + 1))
    # A probe at the point itself takes all of the weight.
    least = np.maximum(distance[:, :1], np.finfo(np.float64).tiny)
    weight = np.square(least / np.maximum(distance, least * 1e-9))
    weight /= weight.sum(1, keepdims=True)
    return (values[index] * weight[..., None]).sum(1)
