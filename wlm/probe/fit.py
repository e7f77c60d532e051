"""Fitting a probe set: from checked input to a compressed model (gaussian-probe-compression, section 3.2 and 3.3).

A profile of the method "transform" is fitted in `wlm.probe.transform_fit`, within seconds.
"""

import math
import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.model import ProbeModel, Profile, check_outputs
from wlm.probe.packing import pack_model
from wlm.probe.trainer import Trainer
from wlm.probe.transform import Transform
from wlm.probe.transform_fit import compress_transform
from wlm.system import Meter, OnProgress

_OF_TRANSFORMS = ("target_psnr", "max_bytes", "region")
_CHUNK = {"cpu": 5, "cuda": 500}  # steps between two looks at the clock


def open_checkpoint(
    output: str | os.PathLike[str],
    probes: ProbeSet,
    profile: str | os.PathLike[str] | Profile = "transform",
    *,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
) -> Checkpoint:
    """Opens the checkpoint of a fit, the file `OUTPUT.partial`.

    Args:
        output: The file that the fit is for.
        probes, profile, seed: As for `compress`: what the fit depends on.
        device: Only its kind matters: a fit may go on on another GPU.
        resume: Whether to go on from the file, if there is one.
        every: Seconds between two saves of a running fit; 0: after every few steps.

    Raises:
        WlmError: With `resume`: the file is damaged, or of another fit; the line names what differs.
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
    profile: str | os.PathLike[str] | Profile = "transform",
    *,
    seed: int = 0,
    device: str = "cpu",
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    positions: bool = False,
    **overrides: Any,
) -> ProbeModel | Transform:
    """Compresses a probe set.

    Dead probes take no part: the model has a bit for each, if there are any.

    Args:
        probes: The set.
        profile: The settings: a name, a YAML file, or a `Profile`.
        seed: One seed gives one result on one device; a transform has nothing random.
        device: "cpu" or "cuda:0"; a transform is made on the CPU.
        progress: Called about twice a second, with the PSNR of all numbers of all probes.
        checkpoint: From `open_checkpoint` for the same settings, or None: where a running fit is kept, and an
            interrupted one resumed. A transform is made anew.
        positions: Whether the model carries the probes' positions, 16 bits an axis; an engine has them anyway.
        overrides: Settings that replace the profile's: `steps=500`, or of a transform `target_psnr=45`,
            `max_bytes=20000` and `region=65536`.

    Returns:
        The model.

    Raises:
        WlmError: A profile, a setting or a device that isn't there, too many probes or numbers of a probe, a checkpoint
            that isn't of this fit, or a fit that diverged.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint, if there is one, has been written.
    """
    profile = Profile.load(profile).override(overrides)
    check_method(profile, overrides)
    device = interop.check_device(device)
    if profile.method == "transform":
        return compress_transform(probes, profile, positions=positions, progress=progress)
    check_outputs(probes.name, profile, probes.outputs, device)
    origin, extent, size = _frame(probes.position)
    x = ((probes.position - origin) / extent).astype(np.float32)
    trainer = Trainer(x[probes.live], probes.values[probes.live], profile, seed, device)
    try:
        if checkpoint is not None:
            checkpoint.restore(0, trainer.load)
        _run(trainer, probes, profile, device, progress, checkpoint)
        trainer.finish()
        mse = trainer.mse()
        parts = trainer.quantised()
    finally:
        trainer.close()
    if not (math.isfinite(mse) and all(np.isfinite(part).all() for part in parts.values())):
        raise WlmError(f"{probes.name}: the fit diverged; expected smaller rates than those of {profile.name}")
    stored = np.zeros((0, 3), np.uint16)
    if positions:
        stored = np.rint((probes.position - origin) / extent / np.where(size > 0, size, 1.0) * 65535.0)
        stored = np.clip(stored, 0, 65535).astype(np.uint16)
    model = ProbeModel(
        name=probes.name,
        source=probes.source,
        profile=profile,
        probes=probes.probes,
        outputs=probes.outputs,
        origin=origin,
        extent=extent,
        size=size,
        dead=np.zeros(0, bool) if probes.live.all() else ~probes.live,
        positions=stored,
        dropped=int((~trainer.needed).sum()),
        **parts,
    )
    return pack_model(model, probes.position[probes.live], probes.values[probes.live], device)


def check_method(profile: Profile, overrides: Mapping[str, Any], prefix: str = "") -> None:
    """Checks that settings which replace a profile's mean something to its method.

    Args:
        profile: The profile.
        overrides: By name; None leaves a setting as it is.
        prefix: As for `Profile.override`.

    Raises:
        WlmError: One doesn't.
    """
    transform = profile.method == "transform"
    for name, value in overrides.items():
        if value is not None and name not in ("name", "method") and (name in _OF_TRANSFORMS) != transform:
            method = "gaussians" if transform else "transform"
            shown = prefix + (name.replace("_", "-") if prefix else name)
            raise WlmError(f"{shown}: expected a profile of the method {method}, found {profile.name}")


def _frame(position: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
    """Origin, extent and normalised size of the probes' box."""
    low, high = position.min(0), position.max(0)
    extent = float((high - low).max())
    if not extent > 0:
        # One probe, or all at one place: any unit will do.
        extent = 1.0
    return low, extent, np.minimum((high - low) / extent, 1.0)


def _run(
    trainer: Trainer,
    probes: ProbeSet,
    profile: Profile,
    device: str,
    progress: OnProgress | None,
    checkpoint: Checkpoint | None,
) -> None:
    meter = Meter(progress, "fit", profile.steps)
    peak = float(probes.values.max()) - float(probes.values.min())
    # Dead probes decode exactly, and count.
    live = probes.live.mean()
    step = trainer.step
    while step < profile.steps:
        count = min(_CHUNK["cpu" if device == "cpu" else "cuda"], profile.steps - step)
        trainer.run(count)
        step += count
        if meter.due(step):
            try:
                meter.report(step, PSNR_dB=psnr_from_mse(trainer.mse() * live, peak))
            except KeyboardInterrupt:
                if checkpoint is not None:
                    checkpoint.save_running(0, trainer.state())
                raise
        if checkpoint is not None and checkpoint.due():
            checkpoint.save_running(0, trainer.state())
