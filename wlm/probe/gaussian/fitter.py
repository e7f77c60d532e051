"""Fits Gaussians to regions of probes, in this process or in another one (gaussian-probe-compression, section 3)."""

import math
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from wlm import interop
from wlm.dispatch import Advance
from wlm.errors import WlmError
from wlm.metrics import psnr_from_mse
from wlm.probe.data import ProbeSet
from wlm.probe.gaussian.model import check_outputs
from wlm.probe.gaussian.packing import pack_model
from wlm.probe.gaussian.pictures import Pixels
from wlm.probe.gaussian.trainer import Trainer
from wlm.probe.model import ProbeModel, Profile, box_of

_CHUNK = {"cpu": 5, "cuda": 500}  # steps between two looks at the clock


class Region(NamedTuple):
    """Probes to be fitted: what makes their model, their set and profile, and pixels of pictures, or None."""

    make: Callable[..., ProbeModel]
    probes: ProbeSet
    profile: Profile
    pixels: Pixels | None


class Fitter:
    """Fits groups of regions one after another; those of a group take their steps together, on a GPU at once."""

    def __init__(self, device: str, seed: int) -> None:
        self._device, self._seed = interop.check_device(device), seed
        self._trainers: list[Trainer] = []

    def start(self, job: list[Region], states: list[dict[str, np.ndarray] | None]) -> Advance:
        """Starts a group, or continues it from saved states; raises ValueError if they are wrong."""
        self.close()
        self._job = job
        for (_, probes, profile, pixels), state in zip(job, states, strict=True):
            hours, box = max(len(probes.times), 1), box_of(probes.position)
            relative = hours * (profile.error == "relative")
            sizes = profile.latent, profile.hidden, hours * probes.outputs
            check_outputs(probes.name, *sizes, relative, self._device)
            x = ((probes.position[probes.live] - box["origin"]) / box["extent"]).astype(np.float32)
            lit = probes.values[probes.live]
            self._trainers.append(Trainer(x, lit, profile, self._seed, self._device, hours, pixels))
            if state is not None:
                self._trainers[-1].load(state)
            if self._trainers[-1].step != (done := self._trainers[0].step):
                raise ValueError(f"part control: expected {done} steps, as its peers have")
        self._trainers[0].peers = self._trainers[1:]
        return Advance(done * len(job))

    def advance(self, seconds: float) -> Advance:
        """Trains the group for about `seconds`, at least a few steps, or to its end. Its result are the models, with
        integers as the file has them."""
        first, end = self._trainers[0], time.monotonic() + seconds
        step, chunk = first.step, _CHUNK["cpu" if self._device == "cpu" else "cuda"]
        while step < first.steps:
            count = min(chunk, first.steps - step)
            first.run(count)
            step += count
            if time.monotonic() >= end:
                break
        probes, error = self._job[0].probes, first.mse()
        if first.relative:
            figures = {"error": math.sqrt(error * (probes.outputs + 1))}
        else:
            # Dead probes decode exactly, and count.
            figures = {"PSNR_dB": psnr_from_mse(error * probes.live.mean(), float(np.ptp(probes.values)))}
        if step < first.steps:
            return Advance(step * len(self._job), figures)
        models = []
        for (make, probes, profile, pixels), trainer in zip(self._job, self._trainers, strict=True):
            trainer.finish()
            mse, content = trainer.mse(), trainer.quantised()
            if not (math.isfinite(mse) and np.isfinite(content.bounds).all() and np.isfinite(content.net).all()):
                told = f"the fit diverged; use smaller learning rates than profile {profile.name}"
                raise WlmError(f"{probes.name}: {told}")
            fitted = make(profile=profile, content=content, choice="Gaussians, as the profile asks")
            lit = probes.position[probes.live], probes.values[probes.live]
            models.append(pack_model(fitted, *lit, self._device, pixels is not None))
        self.close()
        return Advance(step * len(self._job), figures, True, models)

    def state(self) -> list[dict[str, np.ndarray]]:
        """Returns the arrays of each region on which later steps depend, by name."""
        return [trainer.state() for trainer in self._trainers]

    def close(self) -> None:
        """Drops the group and frees its memory."""
        for trainer in self._trainers:
            trainer.close()
        self._trainers = []
