"""Fitting a layered set: sheet after sheet, each as `wlm.lightmap.fit` fits a set."""

import os
from dataclasses import replace
from typing import Any

from wlm.errors import WlmError
from wlm.formats.checkpoint import EVERY, Checkpoint, CheckpointRange
from wlm.lightmap import fit
from wlm.lightmap.layers.data import LayeredSet
from wlm.lightmap.layers.model import LayeredModel, sheet_profile
from wlm.lightmap.model import Profile
from wlm.system import OnProgress, Progress

_BATCHES = 100_000  # numbers of batches that each sheet has in the checkpoint; a sheet has 16,384 tiles at most


def compress(
    lightmaps: LayeredSet,
    profile: str | os.PathLike[str] | Profile = "M",
    *,
    seed: int = 0,
    device: str = "cpu",
    workers: int | None = None,
    cluster: str | None = None,
    progress: OnProgress | None = None,
    checkpoint: Checkpoint | None = None,
    **overrides: Any,
) -> LayeredModel:
    """Compresses a layered set.

    Args:
        lightmaps: The set.
        profile: The settings of all sheets; linear ones have no gamma (`wlm.lightmap.layers.model.sheet_profile`).
        seed, device, workers, cluster, overrides: As for `wlm.lightmap.fit.compress`.
        progress: Called about twice a second; the stage names the sheet.
        checkpoint: From `open_checkpoint`.

    Returns:
        The model; its `warnings` say what could not be done as the settings ask.

    Raises:
        WlmError, KeyboardInterrupt: As `wlm.lightmap.fit.compress`.
    """
    profile = Profile.load(profile).override(overrides)
    models = {}
    for number, (sheet, own) in enumerate(lightmaps.sheets.items()):
        try:
            models[sheet] = fit.compress(
                own,
                sheet_profile(profile, sheet),
                seed=seed,
                device=device,
                workers=workers,
                cluster=cluster,
                progress=_named(progress, f"sheet {number + 1} of {len(lightmaps.sheets)}"),
                checkpoint=None if checkpoint is None else CheckpointRange(checkpoint, number * _BATCHES),
            )
        except (WlmError, KeyboardInterrupt):
            # A sheet that is stopped before its first step writes nothing, and earlier ones may have left something.
            if checkpoint is not None:
                checkpoint.flush()
            raise
        # Read from files each has a mask of its own.
        shared = next(model.mask for other, model in models.items() if other.atlas == sheet.atlas)
        models[sheet].mask = shared
    return LayeredModel(name=lightmaps.name, source=lightmaps.source, sheets=models)


def open_checkpoint(
    output: str | os.PathLike[str],
    lightmaps: LayeredSet,
    profile: str | os.PathLike[str] | Profile = "M",
    *,
    seed: int = 0,
    device: str = "cpu",
    resume: bool = False,
    every: float = EVERY,
    **overrides: Any,
) -> Checkpoint:
    """Opens the checkpoint of a fit, as `wlm.lightmap.fit.open_checkpoint` does."""
    options = {"seed": seed, "device": device, "resume": resume, "every": every}
    return fit.open_checkpoint(output, lightmaps, profile, **options, **overrides)


def _named(progress: OnProgress | None, sheet: str) -> OnProgress | None:
    """Adds the sheet to the stages of a fit."""
    if progress is None:
        return None

    def report(done: Progress) -> None:
        progress(replace(done, stage=sheet if done.stage == "fit" else f"{sheet}, {done.stage}"))

    return report
