"""Measures the error of decoded probes against the original probes (gaussian-probe-compression, section 5.2).

The paper compares pictures rendered in an engine. This module compares the coefficients themselves, and the irradiance
that they give a diffuse surface, without a scene or a camera; `wlm.probe.views` compares pictures.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.decode import Decoder
from wlm.probe.hours import listed_times
from wlm.probe.model import ProbeModel
from wlm.probe.places import nearest_weights
from wlm.probe.relative import norms, relative_errors
from wlm.probe.sphere import coefficient_bands, fibonacci_sphere, irradiance, sh_count
from wlm.system import Meter, OnProgress
from wlm.system import Report as BaseReport

NORMALS = 32
"""Number of normals: the mean square of any L2 irradiance over them is within 6% of that over the sphere, 0.3 dB."""

OFF = 0.5
"""Relative error above which a probe is counted as off."""

MANY_OFF = 0.01
"""Share of the live probes that may be off without a warning."""

_RELATIVE = ("relative_error", "relative_median", "relative_p95", "off")
_OF_HOUR = ("psnr", "psnr_live", "irradiance_psnr", "between_psnr", *_RELATIVE)
_NEAREST = 8  # probes that are weighted by the inverse square of their distance
_ROWS = 32768  # probes per piece, so that float64 copies stay at some tens of MB


@dataclass(frozen=True)
class Report(BaseReport):
    """Size and errors of compressed probes.

    Every PSNR is `10 log10(peak² / mse)` in dB. The peak of coefficients is one number, the range of all coefficients
    of all probes of the input, so that bands and coefficients can be compared.

    Attributes:
        name: Name of the set.
        probes, live, outputs: Number of probes N, number of live probes, and numbers per probe D.
        bytes: Size of the file on disk.
        bits_per_probe: `bytes * 8 / N`, over all probes; the paper's bpp.
        ratio: Bytes of the file divided by `N * D * 4`, the bytes of the input in float32.
        gpu_bytes: Bytes of the buffers that a GPU holds; 0 if unknown.
        hours: For each of several hours its `time`, `psnr`, `psnr_live`, `irradiance_psnr` and `between_psnr`; other
            figures are those of the hour with the lowest PSNR.
        peak: Range of the input's coefficients.
        psnr: PSNR over all coefficients of all probes.
        psnr_live: PSNR over the live probes; dead probes decode exactly to zero.
        mse, max_abs_error: Errors over all coefficients of all probes.
        relative_error: Root mean square of the live probes' relative errors, see `wlm.probe.relative`; NaN if no probe
            is live.
        relative_median, relative_p95: Median and 95th percentile of these errors.
        off: Share of the live probes whose relative error exceeds `OFF`.
        worst_probe: The live probe with the largest relative error: `probe` (index), `error`, `position`, and the norms
            of its numbers, `light`, and of the decoded ones, `decoded`; None if all are exact.
        psnr_by_band: PSNR of each band of spherical harmonics, over all probes and colours.
        irradiance_psnr: PSNR of the irradiance, at least 0, on `NORMALS` fixed normals of every live probe in RGB; its
            peak is the range of the input's irradiance.
        warnings: A sentence that names the worst probe, if more than a share `MANY_OFF` of the live probes is off.
        between_psnr: PSNR between the probes, see the function `between_psnr`; None if it was not computed.
    """

    name: str
    probes: int
    live: int
    outputs: int
    bytes: int
    bits_per_probe: float
    ratio: float
    peak: float
    psnr: float
    psnr_live: float
    mse: float
    max_abs_error: float
    relative_error: float
    relative_median: float
    relative_p95: float
    off: float
    worst_probe: dict[str, Any] | None
    psnr_by_band: list[float] | None
    irradiance_psnr: float | None
    warnings: list[str] = field(default_factory=list)
    between_psnr: float | None = None
    gpu_bytes: int = 0
    hours: list[dict[str, Any]] = field(default_factory=list)


def evaluate(
    model: ProbeModel,
    probes: ProbeSet,
    *,
    device: str = "cpu",
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
) -> Report:
    """Decodes a model at its probes and compares the result with the input.

    Args:
        model: The model.
        probes: The input, in the order of the fit.
        device: Where the model is decoded.
        progress: Called after each hour.
        file_bytes: Size of the model's file; None: the size that `model.save` would write.

    Returns:
        The report.

    Raises:
        WlmError: The device does not exist, the set has other probes or hours, or a decoded number is not finite.
    """
    if len(probes.position) != model.probes:
        raise WlmError(f"{probes.name}: has {probes.probes} probes, but {model.probes} were compressed")
    if not np.array_equal(probes.times, model.times):
        found, expected = (listed_times(times) or "one" for times in (probes.times, model.times))
        raise WlmError(f"{probes.name}: has the hours {found}, but {expected} were compressed; choose with --key")
    decoder = model.decoder(device, position=probes.position)
    size = model.file_bytes() if file_bytes is None else file_bytes
    times = probes.times.tolist() or [None]
    meter = Meter(progress, "evaluate", len(times))
    reports = []
    for done, time in enumerate(times, 1):
        if time is not None:
            decoder.set_time(time)
        reports.append(_evaluate(decoder, probes.at(time), size))
        meter.report(done, PSNR_dB=reports[-1].psnr)
    worst = min(reports, key=lambda report: report.psnr)
    hours = [
        {"time": time} | {name: getattr(each, name) for name in _OF_HOUR}
        for time, each in zip(times, reports, strict=True)
    ]
    return replace(
        worst,
        gpu_bytes=model.content.nbytes,
        ratio=worst.ratio / len(times),
        warnings=[at_hour(time) + text for time, each in zip(times, reports, strict=True) for text in each.warnings],
        hours=hours if len(times) > 1 else [],
    )


def at_hour(time: float | None) -> str:
    """Returns the beginning of a sentence about one of several hours."""
    return "" if time is None else f"at {time:g} h, "


def _evaluate(decoder: Decoder, probes: ProbeSet, file_bytes: int) -> Report:
    """Compares the light that a decoder has at its present time with that of one hour."""
    decoded = decoder.decode_probes()
    return replace(score(decoded, probes, file_bytes), between_psnr=between_psnr(decoder, probes))


def score(decoded: np.ndarray, probes: ProbeSet, file_bytes: int) -> Report:
    """Compares the output of any decoder with the input.

    Args:
        decoded: float32 [N, D], in the order of the input.
        probes: The input.
        file_bytes: Size of the compressed file.

    Returns:
        The report. A PSNR is 120 dB at most, the cap of `wlm.metrics`, and NaN if all numbers of the input are equal or
        no probe is live. The PSNRs of bands and irradiance are None if D is not 3 (l + 1)² for any band l.

    Raises:
        WlmError: The number of probes or of their numbers differs, a number is NaN or infinite, or the input has
            several hours.
        ValueError: `file_bytes` is not positive, or `decoded` is no matrix.
    """
    if file_bytes <= 0:
        raise ValueError(f"file_bytes: expected a positive number, got {file_bytes}")
    probes = probes.at()
    decoded, values, live = np.asarray(decoded), probes.values, probes.live
    if decoded.ndim != 2:
        raise ValueError(f"decoded: expected an array [N, D], got {decoded.shape}")
    count, outputs = values.shape
    if decoded.shape != values.shape:
        raise WlmError(
            f"{probes.name}: has {count} probes of {outputs} numbers, but {decoded.shape[0]} of {decoded.shape[1]} "
            "were decoded"
        )
    broken = ~np.isfinite(decoded).all(axis=1)
    if broken.any():
        raise WlmError(
            f"{probes.name}: expected finite numbers, but {np.count_nonzero(broken)} probes decode to NaN or "
            f"infinity, first probe {int(np.argmax(broken))}"
        )

    by_coefficient = np.zeros(outputs)  # sum of squares
    largest = of_live = 0.0
    for start in range(0, count, _ROWS):
        rows = slice(start, start + _ROWS)
        error = np.abs(decoded[rows].astype(np.float64) - values[rows])
        largest = max(largest, float(error.max()))
        error *= error
        of_live += float(error[live[rows]].sum())
        by_coefficient += error.sum(axis=0)

    peak = float(values.max()) - float(values.min())
    by_coefficient /= count
    mse = float(by_coefficient.mean())
    coefficients = sh_count(outputs)
    by_band = None
    if coefficients is not None:
        band = np.repeat(coefficient_bands(coefficients), 3)
        by_band = [psnr_from_mse(by_coefficient[band == i].mean(), peak) for i in range(band[-1] + 1)]
    return Report(
        name=probes.name,
        probes=count,
        live=int(np.count_nonzero(live)),
        outputs=outputs,
        bytes=file_bytes,
        bits_per_probe=file_bytes * 8 / count,
        ratio=file_bytes / (count * outputs * 4),
        peak=peak,
        psnr=psnr_from_mse(mse, peak),
        psnr_live=psnr_from_mse(of_live / (live.sum() * outputs), peak) if live.any() else math.nan,
        mse=mse,
        max_abs_error=largest,
        **relative_figures(decoded, probes),
        psnr_by_band=by_band,
        irradiance_psnr=None if coefficients is None else _irradiance_psnr(decoded[live], values[live], coefficients),
    )


def relative_figures(decoded: np.ndarray, probes: ProbeSet) -> dict[str, Any]:
    """Returns the entries of a `Report` that are about relative errors, and `warnings`, by name; arguments as for
    `score`."""
    index = np.flatnonzero(probes.live)
    if not len(index):
        none = dict.fromkeys(_RELATIVE, math.nan)
        return none | {"worst_probe": None, "warnings": []}
    decoded, values = decoded[index], probes.values[index]
    error = relative_errors(decoded, values)
    worst, off = int(error.argmax()), float((error > OFF).mean())
    probe = int(index[worst])
    light, found = (float(norms(each[worst : worst + 1])[0]) for each in (values, decoded))
    place = probes.position[probe].tolist()
    warnings = []
    if off > MANY_OFF:
        at = ", ".join(f"{x:.4g}" for x in place)
        warnings.append(
            f"{probes.name}: {off:.1%} of the live probes are off by more than {OFF:.0%} of their light; the worst is "
            f"probe {probe} at ({at}), whose light of {light:.4g} decodes to {found:.4g}"
        )
    named = {"probe": probe, "error": float(error[worst]), "position": place, "light": light, "decoded": found}
    return {
        "relative_error": float(np.sqrt(np.square(error).mean())),
        "relative_median": float(np.median(error)),
        "relative_p95": float(np.percentile(error, 95)),
        "off": off,
        "worst_probe": named if error[worst] else None,
        "warnings": warnings,
    }


def _irradiance_psnr(decoded: np.ndarray, values: np.ndarray, coefficients: int) -> float:
    """Returns the PSNR in dB of the irradiance that live probes [V, D] give; NaN if there are none."""
    if len(values) == 0:
        return math.nan
    normals = fibonacci_sphere(NORMALS)
    total, low, high = 0.0, math.inf, -math.inf
    rows = max(1, _ROWS // NORMALS)
    for start in range(0, len(values), rows):
        pair = np.stack([values[start : start + rows], decoded[start : start + rows]])
        exact, predicted = np.maximum(irradiance(pair.reshape(2, -1, coefficients, 3), normals), 0.0)
        low, high = min(low, float(exact.min())), max(high, float(exact.max()))
        total += float(np.square(predicted - exact).sum())
    return psnr_from_mse(total / (len(values) * NORMALS * 3), high - low)


def between_psnr(decoder: Decoder, probes: ProbeSet) -> float:
    """Returns the PSNR in dB of decoded light half-way from each live probe to its nearest neighbour, where no bake
    exists. The decoder must have the positions of its probes. The reference at those points is the input, interpolated
    from the eight nearest probes with weights 1 / distance². The peak of the PSNR is the range of the live probes'
    numbers. With fewer than two live probes the result is NaN."""
    place, values = probes.position[probes.live], probes.values[probes.live]
    if len(place) < 2:
        return float("nan")
    nearest = cKDTree(place).query(place, k=2)[1][:, 1]
    middle = 0.5 * (place + place[nearest])
    error = decoder.decode(middle) - by_distance(probes, middle, _NEAREST)
    return psnr_from_mse(float(np.square(error).mean()), float(np.ptp(values)))


def by_distance(probes: ProbeSet, position: np.ndarray, count: int) -> np.ndarray:
    """Interpolates the `count` nearest live probes at points [M, 3] with weights 1 / distance^2; float64 [M, D]."""
    place, values = probes.position[probes.live], probes.values[probes.live].astype(np.float64)
    index, weight = nearest_weights(cKDTree(place), position, count)
    return (values[index] * weight[..., None]).sum(1)
