"""Training of a network on samples that are simulated during the training (neural-six-way-lightmaps, section 4.4).

A training has rounds. Each round simulates a pool of samples, from sequences that no other round uses, and trains on
these samples. A step depends only on the seed, the round and the number of the step. A training that was stopped and
resumed therefore gives the same weights and curves as an uninterrupted one, to the bit on the same device.
"""

import csv
import hashlib
import io
import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch

from wlm.dispatch import Place
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_write
from wlm.formats.checkpoint import EVERY, Checkpoint
from wlm.formats.lock import locked
from wlm.formats.parts import Part, check_parts
from wlm.interop import check_device
from wlm.smoke.evaluation import Score, of_network, score
from wlm.smoke.model import SmokeModel
from wlm.smoke.network import dataset
from wlm.smoke.network.planes import PLANES, Pool
from wlm.smoke.network.settings import Profile
from wlm.smoke.network.trainer import Trainer, plan_round
from wlm.system import Meter, OnProgress, Progress, load

_CHUNK = 50  # steps between two reports
_LEAST_SKIPPED = 10
_MOST_SKIPPED = 0.1  # largest share of skipped steps in a round
_WORSE = 3.0  # decibels below the untrained network at which a training has diverged
_SCORES = ("psnr", "lowest", "highest", "flicker", "reference_flicker")  # columns of the curves


@dataclass(frozen=True)
class Training:
    """Result of a training.

    Unless it is `finished`, the time ran out and it can be resumed. `best` is the validation PSNR of the saved network,
    `model`, in dB; NaN and None without any yet. `score` has the scores of the last validation, None if there was none.
    `skipped` of the steps had no update because the gradient was not finite; `seconds` include earlier runs.
    """

    finished: bool
    best: float
    score: Score | None
    steps: int
    skipped: int
    seconds: float
    model: SmokeModel | None = field(compare=False)


def train(
    profile: str | os.PathLike[str] | Profile,
    output: str | os.PathLike[str],
    *,
    seed: int = 0,
    device: str = "cpu",
    minutes: float | None = None,
    resume: bool = False,
    checkpoint_every: float = EVERY,
    progress: OnProgress | None = None,
    workers: int | None = None,
    cluster: str | None = None,
    **overrides: Mapping[str, Any],
) -> Training:
    """Trains a network and saves it as it was at its best validation.

    The losses and scores over time are written as `OUTPUT.csv`. Until the training is finished, `OUTPUT.partial` is its
    checkpoint.

    Args:
        profile: A profile's name, the path of a YAML file, or the profile itself.
        output: The network's file.
        seed: Seed of the initial weights, the pools and the order of samples.
        device: "cpu", "cuda" or "cuda:N".
        minutes: Time limit in minutes, after which the training stops with a checkpoint; None: no limit.
        resume: Whether to continue from the checkpoint, if it exists.
        checkpoint_every: Seconds between two checkpoints; 0: after every 50 steps. A checkpoint is also written at the
            end of each round.
        progress: Called after each simulated sequence and every 50 steps, with the figures "PSNR dB" of the last
            validation and "loss", the mean of the round.
        workers, cluster: Where sequences are made side by side, see `wlm.dispatch.Place`; the network is trained here.
        **overrides: Replace settings of the profile: `training={"rounds": 2}`.

    Raises:
        WlmError: A setting is wrong, the device does not exist, the checkpoint is damaged or of another training, the
            training to resume is finished, samples are missing or not finite, the training diverged, or a file cannot
            be written or is being written by another process.
        KeyboardInterrupt: Raised by `progress`, after the checkpoint has been written.
    """
    # A training is on a device of this machine, that of a cluster is any of its kind.
    place = Place(device if cluster is None else device.partition(":")[0], workers, cluster)
    profile, device = Profile.load(profile).override(overrides), check_device(device)
    fit = {
        **profile.model_dump(mode="json", include={"network", "training", "dataset"}),
        "seed": int(seed),
        "device": "cpu" if device == "cpu" else "cuda",
    }
    source = hashlib.blake2b(json.dumps(fit, sort_keys=True).encode(), digest_size=16).hexdigest()
    with locked(output):
        checkpoint = Checkpoint(output, SmokeModel.SYSTEM, fit, source, resume=resume, every=checkpoint_every)
        if resume and not checkpoint.resumed and Path(output).exists():
            raise WlmError(f"{output}: cannot resume: the training is finished; start anew without --resume")
        meter = Meter(progress, "train", profile.training.total)
        run = _Run(profile, Path(output), device, checkpoint, meter, seed, minutes)
        options = {"device": device, "place": place, "progress": run.report}
        # Stopping between two sequences of a pool loses nothing: earlier steps are in the checkpoint.
        validation = dataset.make_validation(profile.dataset, **options)
        _check_pool("validation", validation)
        run.begin(validation)
        while run.round < profile.training.rounds:
            pool = dataset.make_pool(profile.dataset, seed=seed, round=run.round, **options)
            _check_pool(f"round {run.round}", pool)
            if not run.do_round(pool):
                return run.result(False)
            run.end_round(validation)
            if run.late and run.round < profile.training.rounds:
                return run.result(False)
        checkpoint.remove()
        return run.result(True)


class _Run:
    """State of a training: the trainer, the best network so far, and losses and scores over time."""

    def __init__(
        self,
        profile: Profile,
        output: Path,
        device: str,
        checkpoint: Checkpoint,
        meter: Meter,
        seed: int,
        minutes: float | None,
    ) -> None:
        self.settings, self.output, self.checkpoint = profile.training, output, checkpoint
        self.facts = {"profile": profile.name, "seed": seed, "dataset": profile.dataset.model_dump(mode="json")}
        self.meter, self.seed, self.device = meter, seed, device
        self.trainer = Trainer(profile.network, profile.training, seed=seed, device=device)
        self.limit = math.inf if minutes is None else 60.0 * minutes
        # Seconds of earlier runs; validation PSNR of the best and of the untrained network.
        self.before, self.best, self.untrained = 0.0, math.nan, math.nan
        self.best_step = self.first_skipped = 0  # step of the best network; steps skipped before this round
        self.score: Score | None = None
        self.loss = math.nan
        self.columns = ["step", "seconds", "rate", "loss", *self.settings.losses, "skipped"]
        self.columns += [*_SCORES, *PLANES]
        self.curve = np.zeros((0, len(self.columns)))
        if not checkpoint.restore(0, self._load):
            return
        saved = self._saved()
        if saved is None or (saved.summary.get("steps"), saved.summary.get("psnr")) != (self.best_step, self.best):
            self.best = math.nan

    def _load(self, state: dict[str, np.ndarray]) -> None:
        table = {
            # NaN where nothing has been validated.
            "clock": Part(np.float64, (3,), finite=False),
            "counts": Part(np.int64, (2,), least=0, most=self.settings.total),
            "curve": Part(np.float64, (None, len(self.columns)), finite=False),
        }
        own = check_parts({name: state[name] for name in table if name in state}, table)
        self.trainer.load({name: value for name, value in state.items() if name not in table})
        self.before, self.best, self.untrained = (float(value) for value in own["clock"])
        self.best_step, self.first_skipped = (int(value) for value in own["counts"])
        self.curve = own["curve"]

    @property
    def late(self) -> bool:
        """Whether the time limit of the training has passed."""
        return self.meter.seconds > self.limit

    @property
    def round(self) -> int:
        return self.trainer.step // self.settings.steps

    @property
    def seconds(self) -> float:
        return self.before + self.meter.seconds

    def begin(self, validation: Pool) -> None:
        """Validates and saves the untrained network, with which later networks are compared."""
        if self.trainer.step == 0:
            self.score = score(of_network(self.trainer.average), validation)
            self.untrained = self.best = self.score.psnr
            # The checkpoint is written first: without a matching network its best score is ignored.
            self.save()
            self._save_network()

    def do_round(self, pool: Pool) -> bool:
        """Runs the remaining steps of a round; returns False if the time limit ends it early."""
        number, begin = self.round, self.round * self.settings.steps
        plan = plan_round(self.settings, pool, seed=self.seed, round=number)
        if self.trainer.step == begin:
            self.first_skipped = self.trainer.skipped
        while True:
            done = self.trainer.step - begin
            self.trainer.run(pool, plan.part(done, done + _CHUNK))
            skipped = self.trainer.skipped - self.first_skipped
            if skipped > max(_LEAST_SKIPPED, _MOST_SKIPPED * self.settings.steps):
                raise WlmError(
                    f"{self.output}: the training diverged: {skipped} steps of round {number} gave NaN or infinity; "
                    f"use a learning rate below {self.settings.rate:g}"
                )
            self.loss = self._losses()[0]
            if self.round > number:
                return True  # the round is validated before the training can stop
            try:
                self.report()
            except KeyboardInterrupt:
                self.save()
                raise
            if self.late:
                self.save()
                return False
            if self.checkpoint.due():
                self.save()

    def end_round(self, validation: Pool) -> None:
        """Validates if due, saves the network if it is the best so far, and writes the scores and the checkpoint."""
        validated = self.round % self.settings.validate_every == 0 or self.round == self.settings.rounds
        if validated:
            self.score = score(of_network(self.trainer.average), validation)
            if self.score.psnr < self.untrained - _WORSE:
                raise WlmError(
                    f"{self.output}: the training diverged: {self.score.psnr:.1f} dB after {self.trainer.step} steps,"
                    f" {self.untrained:.1f} dB before the first; use a learning rate below {self.settings.rate:g}"
                )
            # Also true if the best is NaN.
            if not self.score.psnr <= self.best:
                self.best, self.best_step = self.score.psnr, self.trainer.step
                self._save_network()
        self._add_to_curve(validated)
        self.save()
        self.report()

    def report(self, _: Progress | None = None) -> None:
        psnr = math.nan if self.score is None else self.score.psnr
        self.meter.report(self.trainer.step, PSNR_dB=psnr, loss=self.loss)

    def save(self) -> None:
        state = {
            "clock": np.array([self.seconds, self.best, self.untrained]),
            "counts": np.array([self.best_step, self.first_skipped]),
            "curve": self.curve,
        }
        self.checkpoint.save({0: {**self.trainer.state(), **state}})

    def result(self, finished: bool) -> Training:
        step, skipped = self.trainer.step, self.trainer.skipped
        return Training(finished, self.best, self.score, step, skipped, self.seconds, self._saved())

    def _saved(self) -> SmokeModel | None:
        """Loads the network from the output file; None if the file is missing or damaged."""
        try:
            return load(self.output, SmokeModel.SYSTEM)
        except WlmError:
            return None

    def _save_network(self) -> None:
        summary = {
            **self.facts,
            "steps": self.trainer.step,
            "seconds": round(self.seconds, 1),
            "device": "cpu" if self.device == "cpu" else torch.cuda.get_device_name(self.device),
            **self.score.to_json(),
            "training": self.settings.model_dump(mode="json"),
        }
        SmokeModel(self.trainer.average, summary).save(self.output)

    def _losses(self) -> list[float]:
        """Returns the mean loss and the means of its parts over the steps of this round."""
        last = self.curve[-1] if len(self.curve) else np.zeros(len(self.columns))
        steps, skipped = (self.columns.index(name) for name in ("step", "skipped"))
        count = self.trainer.step - last[steps] - (self.trainer.skipped - last[skipped])
        return [float(value / count) if count else math.nan for value in self.trainer.take_losses()]

    def _add_to_curve(self, validated: bool) -> None:
        """Adds the losses and scores of a round (NaN: not validated) as a row, and writes all rows as the CSV file."""
        scores = [math.nan] * (len(_SCORES) + len(PLANES))
        if validated:
            scores = [*(getattr(self.score, name) for name in _SCORES), *self.score.planes]
        rate = self.settings.rate_at(self.trainer.step - 1)
        row = [self.trainer.step, self.seconds, rate, *self._losses(), self.trainer.skipped, *scores]
        self.curve = np.concatenate([self.curve, np.array(row)[None]])
        self.trainer.clear_losses()
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([f"{value:.8g}" for value in line] for line in self.curve)
        atomic_write(f"{self.output}.csv", text.getvalue().encode())


def _check_pool(where: str, pool: Pool) -> None:
    if len(pool) == 0:
        raise WlmError(f"{where}: expected samples with smoke, found none")
    for tensor in fields(pool):
        # Sample by sample: a mask of the whole pool would take half as much memory again.
        finite = torch.stack([torch.isfinite(sample).all() for sample in getattr(pool, tensor.name)])
        if not finite.all():
            first = int((~finite).nonzero()[0])
            raise WlmError(f"{where}: {tensor.name}: sample {first}: expected finite numbers, found NaN or infinity")
