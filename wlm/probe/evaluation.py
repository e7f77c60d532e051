"""Scoring decoded probes against their input (gaussian-probe-compression, section 5.2).

The paper scores pictures rendered in an engine. Here the coefficients themselves are scored, and the irradiance that
a diffuse surface would get from them, which needs no scene and no camera.

The stated behaviours:

====================================  ================================================================
input                                 behaviour
====================================  ================================================================
decoded exactly                       PSNR is 120 dB, the cap of `wlm.metrics`; its error is 0
all coefficients equal (range 0)      PSNR is NaN, null in JSON: there is no scale to measure against
irradiance the same everywhere        the same for its PSNR
D is not 3 (l + 1)²                   no bands and no irradiance: None
no live probe                         `psnr_live` and `irradiance_psnr` are NaN
one probe, one coefficient            fine
NaN or Inf in what was decoded        error that names the first probe
another number of probes or outputs   error
====================================  ================================================================
"""

import math
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from wlm.errors import WlmError
from wlm.metrics import LostLight, psnr_from_mse
from wlm.probe.between import HeldOut, between_psnr, held_out
from wlm.probe.data import ProbeSet
from wlm.probe.model import ProbeModel
from wlm.probe.noise import noise_psnr
from wlm.probe.sphere import coefficient_bands, fibonacci_sphere, irradiance, sh_count
from wlm.probe.transform import Transform
from wlm.system import Meter, OnProgress
from wlm.system import Report as BaseReport

# The mean square of any L2 irradiance over these is within 6% of that over the sphere: a score within 0.3 dB.
NORMALS = 32
_ROWS = 32768  # of probes in one piece, so that float64 copies stay at some tens of MB


@dataclass(frozen=True)
class Report(BaseReport):
    """Size and errors of compressed probes.

    Every PSNR is `10 log10(peak² / mse)`. For coefficients the peak is one number, largest less smallest of all
    coefficients of all probes of the input, so that the bands and the coefficients can be compared.

    Attributes:
        name: The set's name.
        probes, live, outputs: N, how many of them are live, D.
        bytes: Size of the file on disk.
        bits_per_probe: `bytes * 8 / N`, of all probes; the paper's bpp.
        ratio: File bytes over those of the input as float32, `N * D * 4`.
        peak: Range of the input's coefficients.
        psnr: dB, over all coefficients of all probes.
        psnr_live: dB, of the live probes alone: the others decode to zero exactly.
        mse, mean_abs_error, max_abs_error: Over all coefficients of all probes.
        worst_probe: The probe of the largest mean squared error: `probe` (its number), `psnr` and
            `position`; None where all are exact.
        psnr_by_band: dB, for each SH band over all probes and RGB; None where D is not 3 (l + 1)².
        psnr_by_coefficient: dB, float64 [D], over all probes.
        irradiance_psnr: dB, over `NORMALS` fixed normals of every live probe in RGB; its peak is the range of the
            input's irradiance there. None as `psnr_by_band`.
        warnings: Light that was lost and that the means hide.
        between_psnr: dB, half-way between probes, see `wlm.probe.between`; None where that isn't asked.
        held_out: The score where nothing was compressed; None where that isn't asked.
        noise_psnr: dB, of the input's own noise, see `wlm.probe.noise`: a `psnr` above it is spent on noise. None where
            it can't be told, or isn't asked.
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
    mean_abs_error: float
    max_abs_error: float
    worst_probe: dict[str, Any] | None
    psnr_by_band: list[float] | None
    psnr_by_coefficient: np.ndarray
    irradiance_psnr: float | None
    warnings: list[str] = field(default_factory=list)
    between_psnr: float | None = None
    held_out: HeldOut | None = None
    noise_psnr: float | None = None


def evaluate(
    model: ProbeModel | Transform,
    probes: ProbeSet,
    *,
    device: str = "cpu",
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
    hold_out: bool = False,
) -> Report:
    """Decodes a model at its probes and compares them with the input.

    Args:
        model: The model.
        probes: The input, in the order of the fit.
        device: Where it is decoded.
        progress: Called after the decode and at the end.
        file_bytes: Size of the model's file; None: of the one that `model.save` writes.
        hold_out: Whether four fifths of the probes are fitted once more, to score the light at the others' places.

    Returns:
        The report.

    Raises:
        WlmError: No such device, or as `score`.
    """
    meter = Meter(progress, "evaluate", 2)
    decoder = model.decoder(device)
    decoded = decoder.decode_probes(probes.position)
    meter.report(1)
    report = score(decoded, probes, model.file_bytes() if file_bytes is None else file_bytes)
    lost = LostLight()
    lost.add(probes.values, decoded)
    report = replace(
        report,
        warnings=lost.warnings(probes.name, "probe", "the set"),
        between_psnr=between_psnr(decoder, probes),
        held_out=held_out(model, probes, device=device, progress=progress) if hold_out else None,
        noise_psnr=noise_psnr(probes),
    )
    meter.report(2, PSNR_dB=report.psnr)
    return report


def score(decoded: np.ndarray, probes: ProbeSet, file_bytes: int) -> Report:
    """Compares probes that any decoder gave with their input.

    Args:
        decoded: float32 [N, D], in the input's order.
        probes: The input.
        file_bytes: Size of the compressed file.

    Returns:
        The report.

    Raises:
        WlmError: The probes or their numbers are not as many as the input's, or one decodes to NaN or infinity.
        ValueError: `file_bytes` is not positive, or `decoded` is no matrix.
    """
    if file_bytes <= 0:
        raise ValueError(f"file_bytes: expected a positive number, got {file_bytes}")
    decoded, values, live = np.asarray(decoded), probes.values, probes.live
    if decoded.ndim != 2:
        raise ValueError(f"decoded: expected [N, D], got {decoded.shape}")
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

    by_probe = np.empty(count)  # mean squared error
    by_coefficient = np.zeros(outputs)  # sum of squares
    absolute, largest = 0.0, 0.0
    for start in range(0, count, _ROWS):
        rows = slice(start, start + _ROWS)
        error = np.abs(decoded[rows].astype(np.float64) - values[rows])
        absolute, largest = absolute + float(error.sum()), max(largest, float(error.max()))
        error *= error
        by_probe[rows] = error.mean(axis=1)
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
        psnr_live=psnr_from_mse(by_probe[live].mean(), peak) if live.any() else math.nan,
        mse=mse,
        mean_abs_error=absolute / (count * outputs),
        max_abs_error=largest,
        worst_probe=_worst(by_probe, probes.position, peak),
        psnr_by_band=by_band,
        psnr_by_coefficient=np.array([psnr_from_mse(error, peak) for error in by_coefficient]),
        irradiance_psnr=None if coefficients is None else _irradiance_psnr(decoded[live], values[live], coefficients),
    )


def _worst(by_probe: np.ndarray, position: np.ndarray, peak: float) -> dict[str, Any] | None:
    worst = int(np.argmax(by_probe))
    if by_probe[worst] == 0.0:
        return None
    return {"probe": worst, "psnr": psnr_from_mse(by_probe[worst], peak), "position": position[worst].tolist()}


def _irradiance_psnr(decoded: np.ndarray, values: np.ndarray, coefficients: int) -> float:
    """Of live probes [L, D]; NaN if there are none."""
    if len(values) == 0:
        return math.nan
    normals = fibonacci_sphere(NORMALS)
    total, low, high = 0.0, math.inf, -math.inf
    rows = max(1, _ROWS // NORMALS)
    for start in range(0, len(values), rows):
        pair = np.stack([values[start : start + rows], decoded[start : start + rows]])
        exact, predicted = irradiance(pair.reshape(2, -1, coefficients, 3), normals)
        low, high = min(low, float(exact.min())), max(high, float(exact.max()))
        total += float(np.square(predicted - exact).sum())
    return psnr_from_mse(total / (len(values) * NORMALS * 3), high - low)
