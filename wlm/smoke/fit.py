"""Training a network on pools of samples that are made as they are needed (section 4.4).

Training goes in rounds, each with a pool of its own, of sequences that no other round has. What a step does follows
from the seed, the round and the step alone, so that a run that was stopped goes on as if it hadn't been: on one device
its weights and its curves are the same to the bit, but for the seconds that the file and the curves tell. The stated
behaviours:

=====================================  ===============================================================
NaN or infinity in a pool              error that names the round, the tensor and the first sample
a step whose gradient isn't finite     left out and counted; error when a tenth of a round's are
worse than untrained by 3 dB           error at the end of the round; the best network so far is kept
an empty pool, or one of another size  error
out of time, or stopped                a checkpoint is written first
stopped before the first step          the checkpoint is of step 0, and no older one's
resumed, with a network that isn't     as without one: the next validation's is kept
the checkpoint's
resumed, and already finished          error
=====================================  ===============================================================
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, model_validator
from pydantic_core import PydanticCustomError

from wlm.config import load_settings, profile_path
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.checkpoint import Checkpoint
from wlm.interop import check_device
from wlm.smoke.codec import SYSTEM, load_network, save_network
from wlm.smoke.evaluation import Evaluation, evaluate
from wlm.smoke.learn.dataset import DatasetSettings
from wlm.smoke.learn.trainer import Trainer, TrainSettings, plan_round
from wlm.smoke.model import NetworkSettings
from wlm.smoke.planes import PLANES, Pool

__all__ = ["NetworkProfile", "Progress", "Result", "load_profile", "train"]

_CHUNK = 50  # steps between two looks at the clock and at the losses
_LEAST_SKIPPED = 10
_MOST_SKIPPED = 0.1  # of a round's steps
_WORSE = 3.0  # decibels below the untrained network from which on a training can't be meant to go on
_SCORES = ("psnr", "lowest", "highest", "flicker", "reference_flicker")  # of an `Evaluation`, in the curves


class NetworkProfile(BaseModel):
    """What `configs/smoke-network-*.yaml` hold.

    Attributes:
        name: Shown in reports.
        network, training, dataset: Its parts.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    network: NetworkSettings = NetworkSettings()
    training: TrainSettings = TrainSettings()
    dataset: DatasetSettings = DatasetSettings()

    @model_validator(mode="after")
    def _reads_what_is_made(self) -> NetworkProfile:
        if self.network.guide != self.dataset.guide:
            kinds = {"wanted": self.network.guide, "made": self.dataset.guide}
            told = "dataset.guide: expected {wanted}, which network.guide is, found {made}"
            raise PydanticCustomError("guide", told, kinds)
        if (self.training.crop or 0) > self.dataset.resolution:
            sizes = {"most": self.dataset.resolution, "found": self.training.crop}
            told = "training.crop: expected at most {most}, which dataset.resolution is, found {found}"
            raise PydanticCustomError("crop", told, sizes)
        return self


def load_profile(name: str) -> NetworkProfile:
    """Loads ``configs/smoke-network-NAME.yaml``, or a YAML file of one's own.

    Raises:
        WlmError: Unknown profile, unreadable file, or a wrong setting.
    """
    path = name if name.endswith((".yaml", ".yml")) else profile_path("smoke", f"network-{name}")
    return load_settings(NetworkProfile, path)


@dataclass(frozen=True)
class Progress:
    """Where a training is.

    Attributes:
        round, rounds: The one under way, from 0, and all.
        step, steps: Done and in all, over all rounds.
        loss: Mean since the last line of the curves.
        psnr: At the last validation; NaN before the first.
        skipped: Steps left out.
        seconds: So far, those before a stop too.
    """

    round: int
    rounds: int
    step: int
    steps: int
    loss: float
    psnr: float
    skipped: int
    seconds: float


@dataclass(frozen=True)
class Result:
    """What a training came to.

    Attributes:
        finished: False: it ran out of time and can be resumed.
        best: Validation PSNR of the network that was kept; NaN if none was validated yet.
        score: The last validation, or None.
        steps, skipped: Done, and left out of these.
        seconds: In all.
    """

    finished: bool
    best: float
    score: Evaluation | None
    steps: int
    skipped: int
    seconds: float


def train(
    output: str | os.PathLike[str],
    profile: NetworkProfile,
    *,
    make_pool: Callable[..., Pool],
    make_validation: Callable[..., Pool],
    seed: int = 0,
    device: str = "cpu",
    minutes: float | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
) -> Result:
    """Trains a network and keeps the best of its validations.

    Beside ``output`` lie ``OUTPUT.csv``, the curves, and, until it is done, ``OUTPUT.partial``, the checkpoint.

    Args:
        output: The file of the network, as `network_file` writes it.
        profile: The settings.
        make_pool, make_validation: As those of `dataset`.
        seed: Of the first weights, the pools and the order of the samples.
        device: As `check_device` takes it.
        minutes: After which it stops, with a checkpoint; None: at the end. At least one chunk of steps is done.
        resume: Whether to go on from the checkpoint, if there is one.
        progress: Called about every 50 steps; it may raise KeyboardInterrupt to stop.

    Raises:
        WlmError: No such device, a checkpoint that is damaged or of another training, a finished network to resume, a
            pool that isn't fit to be learned from, a training that diverged, or a file that can't be written.
        KeyboardInterrupt: Raised by ``progress``, after the checkpoint has been written.
    """
    device = check_device(device)
    fit = {
        "network": profile.network.model_dump(mode="json"),
        "training": profile.training.model_dump(mode="json"),
        "dataset": profile.dataset.model_dump(mode="json"),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    source = hashlib.blake2b(json.dumps(fit, sort_keys=True).encode(), digest_size=16).hexdigest()
    checkpoint = Checkpoint(output, SYSTEM, fit, source, resume=resume)
    if resume and not checkpoint.resumed and Path(output).exists():
        raise WlmError(f"{output}: is finished; without --resume it is trained anew")
    run = _Run(Path(output), profile, seed, device, checkpoint, progress, minutes)
    validation = make_validation(profile.dataset, device)
    _check_pool("validation", validation)
    run.begin(validation)
    while run.round < profile.training.rounds:
        pool = make_pool(profile.dataset, seed=seed, round=run.round, device=device)
        _check_pool(f"round {run.round}", pool)
        if not run.do_round(pool):
            return run.result(False)
        run.end_round(validation)
        if run.late and run.round < profile.training.rounds:
            return run.result(False)
    checkpoint.remove()
    return run.result(True)


class _Run:
    """The parts of `train` that rounds share."""

    def __init__(self, output, profile, seed, device, checkpoint, progress, minutes) -> None:
        self.output, self.profile, self.settings, self.seed = output, profile, profile.training, seed
        self.device = device
        self.checkpoint, self.progress = checkpoint, progress
        self.trainer = Trainer(profile.network, profile.training, seed=seed, device=device)
        self.start = time.perf_counter()
        self.limit = math.inf if minutes is None else 60.0 * minutes
        self.before, self.best, self.first, self.score = 0.0, math.nan, math.nan, None
        self.kept = self.first_skipped = 0  # steps of the best; steps left out before the round
        self.columns = ["step", "seconds", "rate", "loss", *self.settings.losses.parts, "skipped"]
        self.columns += [*_SCORES, *PLANES]
        self.curve = np.zeros((0, len(self.columns)))
        if (state := checkpoint.running(0)) is not None:
            try:
                self.trainer.load(state)
                self.before, self.best, self.first = (float(value) for value in state["clock"])
                self.kept, self.first_skipped = (int(value) for value in state["counts"])
                self.curve = state["curve"].reshape(-1, len(self.columns))
            except (KeyError, ValueError) as error:
                raise WlmError(f"{checkpoint.path}: expected the state of a training: {error}") from error
            if not self._holds_best():
                self.best = math.nan
        self._loss = math.nan

    @property
    def late(self) -> bool:
        """Whether the time is up."""
        return time.perf_counter() - self.start > self.limit

    @property
    def round(self) -> int:
        return self.trainer.step // self.settings.steps

    @property
    def seconds(self) -> float:
        return self.before + time.perf_counter() - self.start

    def do_round(self, pool: Pool) -> bool:
        """Does what is left of a round; False: out of time."""
        number, begin = self.round, self.round * self.settings.steps
        plan = plan_round(self.settings, pool, seed=self.seed, round=number)
        if self.trainer.step == begin:
            self.first_skipped = self.trainer.skipped
        while (done := self.trainer.step - begin) < self.settings.steps:
            self.trainer.run(pool, plan.part(done, done + _CHUNK))
            self._check_steps(number)
            self._loss = self._losses()[0]
            if self.trainer.step == begin + self.settings.steps:
                return True  # it is validated before anything can stop it
            try:
                self.report(number)
            except KeyboardInterrupt:
                self.save()
                raise
            if self.late:
                self.save()
                return False
        return True

    def begin(self, validation: Pool) -> None:
        """Validates the untrained network, which every later one has to beat."""
        if self.trainer.step == 0:
            self.score = evaluate(self.trainer.average, validation)
            self.first = self.best = self.score.psnr
            # In this order: with no network, or an older one, its best counts for nothing.
            self.save()
            save_network(self.output, self.trainer.average, self._summary())

    def end_round(self, validation: Pool) -> None:
        """Validates, keeps the network if it is the best, and writes curves and checkpoint."""
        validated = self.round % self.settings.validate_every == 0 or self.round == self.settings.rounds
        if validated:
            self.score = evaluate(self.trainer.average, validation)
            if self.score.psnr < self.first - _WORSE:
                raise WlmError(
                    f"{self.output}: the training diverged: {self.score.psnr:.1f} dB after {self.trainer.step} steps,"
                    f" {self.first:.1f} before the first; expected a smaller rate than {self.settings.rate:g}"
                )
            # True where the best is NaN too.
            if not self.score.psnr <= self.best:
                self.best, self.kept = self.score.psnr, self.trainer.step
                save_network(self.output, self.trainer.average, self._summary())
        self._add_line(validated)
        self.save()
        self.report(self.round - 1)

    def report(self, number: int) -> None:
        """Tells where the training is."""
        if self.progress is None:
            return
        psnr = math.nan if self.score is None else self.score.psnr
        step, total, skipped = self.trainer.step, self.settings.total, self.trainer.skipped
        self.progress(Progress(number, self.settings.rounds, step, total, self._loss, psnr, skipped, self.seconds))

    def save(self) -> None:
        """Writes the checkpoint."""
        clock = np.array([self.seconds, self.best, self.first])
        counts = np.array([self.kept, self.first_skipped])
        state = {"clock": clock, "counts": counts, "curve": self.curve}
        self.checkpoint.save_running(0, {**self.trainer.state(), **state})

    def result(self, finished: bool) -> Result:
        return Result(finished, self.best, self.score, self.trainer.step, self.trainer.skipped, self.seconds)

    def _holds_best(self) -> bool:
        """Whether the output is the network that the checkpoint calls the best."""
        try:
            summary = load_network(self.output)[1]
        except WlmError:
            return False  # gone or damaged: no loss, since there will be another
        return (summary.get("steps"), summary.get("psnr")) == (self.kept, self.best)

    def _losses(self) -> list[float]:
        """Means since the last line of the curves."""
        last = self.curve[-1] if len(self.curve) else np.zeros(len(self.columns))
        steps, skipped = (self.columns.index(name) for name in ("step", "skipped"))
        count = self.trainer.step - last[steps] - (self.trainer.skipped - last[skipped])
        return [float(value / count) if count else math.nan for value in self.trainer.take_losses()]

    def _check_steps(self, number: int) -> None:
        skipped = self.trainer.skipped - self.first_skipped
        if skipped > max(_LEAST_SKIPPED, _MOST_SKIPPED * self.settings.steps):
            raise WlmError(
                f"{self.output}: the training diverged: {skipped} steps of round {number} gave NaN or infinity; "
                f"expected a smaller rate than {self.settings.rate:g}"
            )

    def _add_line(self, validated: bool) -> None:
        found = self.score
        scores = [math.nan] * (len(_SCORES) + len(PLANES))
        if validated:
            scores = [*(getattr(found, name) for name in _SCORES), *found.planes]
        rate = self.settings.rate_at(self.trainer.step - 1)
        row = [self.trainer.step, self.seconds, rate, *self._losses(), self.trainer.skipped, *scores]
        self.curve = np.concatenate([self.curve, np.array(row)[None]])
        self.trainer.clear_losses()
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([f"{value:.8g}" for value in line] for line in self.curve)
        atomic_write(f"{self.output}.csv", text.getvalue().encode())

    def _summary(self) -> dict[str, Any]:
        return {
            "profile": self.profile.name,
            "seed": self.seed,
            "steps": self.trainer.step,
            "seconds": round(self.seconds, 1),
            "device": "cpu" if self.device == "cpu" else torch.cuda.get_device_name(self.device),
            **self.score.to_json(),
            "training": self.settings.model_dump(mode="json"),
            "dataset": self.profile.dataset.model_dump(mode="json"),
        }


def _check_pool(where: str, pool: Pool) -> None:
    if len(pool) == 0:
        raise WlmError(f"{where}: expected samples, found none")
    for field in fields(pool):
        # Sample by sample: a mask of the whole would take half as much memory again.
        fine = torch.stack([torch.isfinite(sample).all() for sample in getattr(pool, field.name)])
        if not fine.all():
            first = int((~fine).nonzero()[0])
            raise WlmError(f"{where}: {field.name}: sample {first}: expected finite numbers, found NaN or infinity")
