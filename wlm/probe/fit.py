"""Compresses a checked probe set to a model."""

import math
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.evaluation import at_hour, relative_figures
from wlm.probe.gaussian.model import check_outputs, gaussian_bytes, gaussian_count
from wlm.probe.gaussian.packing import pack_model
from wlm.probe.gaussian.trainer import Trainer
from wlm.probe.model import CODES, ProbeModel, Profile, box_of
from wlm.probe.pca.model import ENOUGH, fit_components
from wlm.system import Meter, OnProgress

_MOST_LATENT, _MOST_HIDDEN = 32, 128  # of a fit of several hours
_CHUNK = {"cpu": 5, "cuda": 500}  # steps after which progress and checkpoint may be due


def open_checkpoint(
    output: str | os.PathLike[str],
    probes: ProbeSet,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
) -> Checkpoint:
    """Opens the checkpoint of a fit, the file `OUTPUT.partial`.

    Args:
        output: The model's file, which is written when the fit is finished.
        probes, profile, seed: The arguments of `compress`; the checkpoint is only valid for them.
        device: Only its kind matters: a fit can continue on another GPU.
        resume: Whether to continue from the file, if it exists.
        every: Seconds between two saves of a running fit; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged or of another fit; the message names the difference.
    """
    fit = {
        "input": probes.source,
        "profile": Profile.load(profile).model_dump(mode="json"),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    return Checkpoint(output, ProbeModel.SYSTEM, fit, probes.source, resume=resume, every=every)


def compress(
    probes: ProbeSet,
    profile: str | os.PathLike[str] | Profile = "standard",
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    positions: bool = False,
    **overrides: Any,
) -> ProbeModel:
    """Compresses a probe set.

    A profile of the method "auto", as all shipped Gaussian profiles are, yields Gaussians unless principal components
    have less error in no more GPU memory, which is the case for a few hundred probes; `ProbeModel.choice` says why.
    Dead probes take no part in the fit: the model stores one bit per probe if any probe is dead.

    Several hours are fitted as one, with probes that have the numbers of all hours; those of each hour are divided by
    their root mean square.

    Args:
        probes: The set.
        profile: The settings: a name, a YAML file, or a `Profile`.
        seed: Seed of the fit; the same seed gives the same result on one kind of device.
        device: "cpu" or "cuda:N".
        progress: Called about twice a second, with the live probes' relative error, "error", or with the PSNR over all
            numbers of all probes if the profile asks for the absolute error.
        checkpoint: From `open_checkpoint` for the same settings, or None. A running fit is saved there, and an
            interrupted one is resumed from there.
        positions: Whether the model stores the probes' positions, 16 bits per axis; not needed if the engine has them.
        overrides: Settings that replace the profile's, such as `steps=500`.

    Returns:
        The model; its `warnings` say whether many probes are off, and which most.

    Raises:
        WlmError: The profile, a setting or the device does not exist, there are too many numbers per probe, the
            checkpoint is of another fit, or the fit diverged.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written.
    """
    profile = Profile.load(profile).override(overrides)
    device = interop.check_device(device)
    if not probes.live.any():
        raise WlmError(f"{probes.name}: every probe is dark: there is nothing to fit")
    hours = max(len(probes.times), 1)
    values, scales = probes.values, np.ones(hours)
    if hours > 1:
        by_hour = np.split(values, hours, axis=1)
        scales = np.sqrt([np.einsum("nd,nd->", light, light, dtype=np.float64) for light in by_hour])
        scales /= scales.max()
        even = [light / np.float32(scale or 1.0) for light, scale in zip(by_hour, scales, strict=True)]
        values = np.concatenate(even, 1)
        latent = min(_MOST_LATENT, round(profile.latent * (1.0 + 0.5 * math.log2(hours))))
        hidden = min(_MOST_HIDDEN, 8 * round(profile.hidden * (1.0 + 0.25 * math.log2(hours)) / 8))
        profile = profile.model_copy(update={"latent": latent, "hidden": hidden})
    box = box_of(probes.position)
    stored = np.zeros((0, 3), np.uint16)
    if positions:
        size = box["extent"] * np.where(box["size"] > 0, box["size"], 1.0)
        stored = np.clip(np.rint((probes.position - box["origin"]) / size * CODES), 0, CODES).astype(np.uint16)

    make = partial(
        ProbeModel,
        name=probes.name,
        source=probes.source,
        probes=probes.probes,
        outputs=probes.outputs,
        dead=np.zeros(0, bool) if probes.live.all() else ~probes.live,
        positions=stored,
        times=probes.times,
        scales=scales,
        **box,
    )
    even = replace(probes, values=values)
    values = values[probes.live]
    pca, relative = Profile(name=profile.name, method="pca"), profile.error == "relative"
    if profile.method == "pca":
        content = fit_components(values, None, hours, relative=relative)[0]
        model = make(profile=pca, content=content, choice="PCA, as the profile asks")
        return _measured(model, probes, device)[0]
    if profile.method == "auto":
        count = gaussian_count(profile.ratio, len(values))
        budget = gaussian_bytes(count, profile.latent, profile.hidden, profile.columns(probes.outputs), hours)
        components, error = fit_components(values, budget, hours)
        if error <= ENOUGH and components.nbytes <= budget:
            took = (
                f"{components.count} components reach {error:.1%} of each probe's light in {components.nbytes:,} bytes"
            )
            choice = f"PCA: {took} of GPU memory, Gaussians take {budget:,}"
            return _measured(make(profile=pca, content=components, choice=choice), probes, device)[0]
    check_outputs(probes.name, profile.latent, profile.hidden, hours * probes.outputs, hours * relative, device)
    # Magnitudes follow each probe at each hour by themselves, and half floats would round a scale's logarithm.
    of_fit = (partial(make, scales=np.ones(hours)), probes) if relative else (make, even)
    gaussians = _fit_gaussians(*of_fit, profile, seed, device, progress, checkpoint)
    gaussians, error = _measured(gaussians, probes, device)
    if profile.method == "gaussians":
        return gaussians
    most = gaussians.content.nbytes
    told = f"Gaussians reach a relative error of {error:.1%} in {most:,} bytes of GPU memory"
    components, _ = fit_components(values, most, hours)
    if components.nbytes > most:
        return replace(gaussians, choice=f"Gaussians: {told}, less than one PCA component takes")
    rival, possible = _measured(make(profile=pca, content=components), probes, device)
    if possible < error:
        return replace(rival, choice=f"PCA: {components.count} components reach {possible:.1%}, {told}")
    return replace(gaussians, choice=f"Gaussians: {told}, PCA of that size reaches {possible:.1%}")


def _measured(model: ProbeModel, probes: ProbeSet, device: str) -> tuple[ProbeModel, float]:
    """Returns the model with its warnings, and its relative error, the root mean square over all hours."""
    decoder = model.decoder(device, position=probes.position)
    warnings, squares = [], []
    for time in probes.times.tolist() or [None]:
        decoder.set_time(time or 0.0)
        figures = relative_figures(decoder.decode_probes(), probes.at(time))
        warnings += [at_hour(time) + line for line in figures["warnings"]]
        squares.append(figures["relative_error"] ** 2)
    return replace(model, warnings=tuple(warnings)), math.sqrt(np.nanmean(squares))


def _fit_gaussians(
    make: Callable[..., ProbeModel],
    probes: ProbeSet,
    profile: Profile,
    seed: int,
    device: str,
    progress: OnProgress | None,
    checkpoint: Checkpoint | None,
) -> ProbeModel:
    """Trains and quantises Gaussians (gaussian-probe-compression, sections 3.2 and 3.3)."""
    box = box_of(probes.position)
    position, values = probes.position[probes.live], probes.values[probes.live]
    x = ((position - box["origin"]) / box["extent"]).astype(np.float32)
    trainer = Trainer(x, values, profile, seed, device, max(len(probes.times), 1))
    try:
        if checkpoint is not None:
            checkpoint.restore(0, trainer.load)
        _train(trainer, probes, progress, checkpoint)
        trainer.finish()
        mse = trainer.mse()
        content = trainer.quantised()
    finally:
        trainer.close()
    if not (math.isfinite(mse) and np.isfinite(content.bounds).all() and np.isfinite(content.net).all()):
        raise WlmError(f"{probes.name}: the fit diverged; use smaller learning rates than profile {profile.name}")
    fitted = make(
        profile=profile.model_copy(update={"method": "gaussians"}),
        content=content,
        choice="Gaussians, as the profile asks",
    )
    return pack_model(fitted, position, values, device)


def _train(trainer: Trainer, probes: ProbeSet, progress: OnProgress | None, checkpoint: Checkpoint | None) -> None:
    steps, chunk = trainer.steps, _CHUNK["cpu" if trainer.device == "cpu" else "cuda"]
    meter = Meter(progress, "fit", steps)
    peak, live = float(np.ptp(probes.values)), probes.live.mean()  # dead probes decode exactly, and count

    def figures() -> dict[str, float]:
        error = trainer.mse()
        if trainer.relative:
            return {"error": math.sqrt(error * (probes.outputs + 1))}
        return {"PSNR_dB": psnr_from_mse(error * live, peak)}

    for start in range(trainer.step, steps, chunk):
        step = min(start + chunk, steps)
        trainer.run(step - start)
        if meter.due(step):
            try:
                meter.report(step, **figures())
            except KeyboardInterrupt:
                if checkpoint is not None:
                    checkpoint.save({0: trainer.state()})
                raise
        if checkpoint is not None and checkpoint.due():
            checkpoint.save({0: trainer.state()})
