"""Scoring a file of several hours: each hour as a file of its own would be scored."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from wlm.errors import WlmError
from wlm.metrics import LostLight
from wlm.probe.between import EVERY, HeldOut, between_psnr, score_held
from wlm.probe.data import ProbeSet, from_arrays
from wlm.probe.day import DayModel
from wlm.probe.day_fit import compress_day
from wlm.probe.evaluation import Report, score
from wlm.probe.hours import check_hours
from wlm.probe.noise import noise_psnr
from wlm.system import Meter, OnProgress


def evaluate_day(
    model: DayModel,
    sets: Sequence[ProbeSet],
    *,
    device: str = "cpu",
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
    hold_out: bool = False,
) -> list[Report]:
    """Decodes a model at all of its hours and compares them with the input.

    Args:
        model: The model.
        sets: The input of each of its times, in their order.
        device: Where it is decoded.
        progress: Called after each hour.
        file_bytes: Size of the model's file; None: of the one that `model.save` writes.
        hold_out: Whether four fifths of the probes are fitted once more, to score the light at the others' places.

    Returns:
        A report for each hour; `bytes`, `bits_per_probe` and `ratio` are an hour's even share of the file.

    Raises:
        WlmError: Sets that don't fit the times, no such device, or as `wlm.probe.score`.
    """
    check_hours(sets, model.times)
    meter = Meter(progress, "evaluate", len(sets))
    share = max(1, round((model.file_bytes() if file_bytes is None else file_bytes) / len(sets)))
    held = _held_out(model, sets, device, progress) if hold_out else [None] * len(sets)
    reports = []
    for i, (time, probes) in enumerate(zip(model.times, sets, strict=True)):
        decoder = model.at(time).decoder(device)
        decoded = decoder.decode_probes(probes.position)
        lost = LostLight()
        lost.add(probes.values, decoded)
        warnings = lost.warnings(f"{probes.name}, {time:g} h", "probe", "the set")
        report = score(decoded, probes, share)
        between = between_psnr(decoder, probes)
        more = {"between_psnr": between, "held_out": held[i], "noise_psnr": noise_psnr(probes)}
        reports.append(replace(report, warnings=warnings, **more))
        meter.report(i + 1, PSNR_dB=report.psnr)
    return reports


def _held_out(model: DayModel, sets: Sequence[ProbeSet], device: str, progress: OnProgress | None) -> list[HeldOut]:
    """Fits the hours of four fifths of the probes in four fifths of the bytes, and decodes the places of the rest."""
    lit = np.flatnonzero(np.logical_or.reduce([probes.live for probes in sets]))
    if len(lit) < 2:
        raise WlmError(f"{model.name}: expected at least 2 live probes to hold one out, found {len(lit)}")
    out = np.arange(len(lit)) % EVERY == min(EVERY, len(lit)) - 1
    known, asked = lit[~out], lit[out]
    size = model.without_places().file_bytes() * (EVERY - 1) // EVERY
    try:
        others = [from_arrays(p.position[known], p.values[known], name=p.name) for p in sets]
        # One region, as the model is.
        region = max(model.profile.region, len(known))
        fitted = compress_day(others, model.times, max_bytes=size, region=region, progress=progress)
    except WlmError as error:
        raise WlmError(f"{model.name}: cannot fit {len(known)} probes to hold out {len(asked)}: {error}") from error
    scores = []
    for time, probes, rest in zip(model.times, sets, others, strict=True):
        decoder = fitted.at(time).decoder(device)
        decoder.decode_probes(rest.position)
        scores.append(score_held(decoder, rest, probes, asked[probes.live[asked]], fitted.file_bytes()))
    return scores
