"""What each part of the network, of its losses and of its guiding map is worth (section 5, figures 6 and 15).

One profile is trained again and again, each time with one thing changed: from the same seed, for as many steps, on the
same samples, and is held against the same validation of other sequences. These are short trainings of small images: the
rows say what differs between them, and not how good a network gets. What is changed:

- "no adapters", "one level less", "stem 1": the network's shape;
- "no depth": the guide's depth isn't read;
- "no sRGB", "no temporal loss", "with perceptual loss": the loss. Our profiles have no perceptual part, so that the
  paper's row of it is here the other way round. The other weights stay: a mean square in linear light is a tenth or so
  smaller than one in sRGB, and the rest counts for as much more beside it. Without a temporal part a step learns from
  single frames, of twice as many samples;
- "guide of ...": another guiding map, for the network and in its samples;
- "coarse march": nothing is trained, the guide of kind "six" is shown as it is.

What a profile is already, or what needs a package that isn't installed, is left out.
"""

from __future__ import annotations

import gc
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from pydantic import BaseModel

from wlm.baselines.smoke import COARSE, coarse
from wlm.bench.runner import Row
from wlm.bench.smoke_setup import number
from wlm.bench.smoke_setup import row as smoke_row
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.smoke.evaluation import Score, of_network, score
from wlm.smoke.learn.dataset import make_pool, make_validation
from wlm.smoke.learn.losses import Losses
from wlm.smoke.learn.pool import Pool
from wlm.smoke.learn.settings import DatasetSettings
from wlm.smoke.learn.trainer import Trainer, plan_round
from wlm.smoke.model import Profile, SixWayNetwork, parameter_count
from wlm.smoke.planes import PLANES

__all__ = ["FULL", "METHOD", "QUICK", "AblationSizes", "run", "run_rows", "variants"]

METHOD = "ablation"
"""The table of these rows."""

_SEED = 0  # of weights, samples and their order
_CHUNK = 50  # steps that are timed as one, at most
_CHUNKS = 4  # of a round, at least: the first are slow
# At the coarse march's errors the perceptual part is 19 times the mean square, and the temporal one 110 times: at this
# weight it counts five times as much as the mean square, a fourth of what the temporal one counts at 0.2.
_PERCEPTUAL = 0.3
_GUIDES = {
    "six": "guide of six lights",
    "paper": "guide of the paper",
    "front": "guide of the front",
    "sides": "guide of front and sides",
}
_PLANES = ("right", "left")  # with a column of their own

_Settings = TypeVar("_Settings", bound=BaseModel)


@dataclass(frozen=True)
class AblationSizes:
    """What is learned from, and for how long.

    Attributes:
        dataset: Settings of the samples that replace the profile's.
        validation: Settings of the validation that replace those.
        rounds, steps: Of each training.
    """

    dataset: Mapping[str, int]
    validation: Mapping[str, int]
    rounds: int
    steps: int


FULL = AblationSizes(
    dataset={"cells": 50, "resolution": 256, "sequences": 14, "frames": 8, "validation_sequences": 4},
    validation={"frames": 4},
    rounds=2,
    steps=1200,
)
"""For a GPU."""

QUICK = AblationSizes(
    dataset={"cells": 16, "refine": 4, "resolution": 32, "sequences": 1, "frames": 2, "validation_sequences": 1},
    validation={"views": 2},
    rounds=2,
    steps=4,
)
"""For a CPU, to see that all of it works: so few steps tell nothing."""


def run(
    profile: str = "24",
    only: Sequence[str] = (),
    *,
    quick: bool,
    device: str,
    rounds: int | None = None,
    steps: int | None = None,
    progress: Callable[[str], None] | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Trains the variants of a profile and compares them.

    Args:
        profile: Its name, or a YAML file.
        only: Names of variants; none: all.
        quick: Small images and few steps, for seconds on a CPU.
        device: "cpu" or "cuda:0".
        rounds, steps: Of each training; None: those of the sizes.
        progress: Called with a line before each part of the work, and for each variant that is left out.
        done: Called after each row with all that there are.

    Returns:
        A row a variant.

    Raises:
        WlmError: The profile can't be read, no variant has such a name, one that was named can't be made, or the device
            isn't there or hasn't the memory.
    """
    sizes = QUICK if quick else FULL
    given = {name: value for name, value in {"rounds": rounds, "steps": steps}.items() if value is not None}
    return run_rows(replace(sizes, **given), Profile.load(profile), only, device=device, progress=progress, done=done)


def run_rows(
    sizes: AblationSizes,
    base: Profile,
    only: Sequence[str] = (),
    *,
    device: str,
    progress: Callable[[str], None] | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Trains the variants of a profile at given sizes.

    Args:
        sizes: Of the samples and the trainings.
        base: The profile.
        only, device, progress, done: As for ``run``.

    Raises:
        WlmError: As ``run``.
    """
    device, note = check_device(device), progress or (lambda line: None)
    training = {"rounds": sizes.rounds, "steps": sizes.steps, "crop": None}
    base = _changed(base, {"dataset": sizes.dataset, "training": training})
    chosen = _chosen(base, only, note)
    samples, scene = _Samples(sizes, device, note), f"validation, {base.name}"
    rows = []
    for name, profile in chosen.items():
        if profile is None:
            validation = samples.validation(_changed(base.dataset, {"guide": "six"}))
            found = score(coarse, validation)
            rows.append(_row(scene, name, found, {}, "no network"))
        else:
            rows.append(_trained_row(scene, name, profile, samples, note, device))
        if done is not None:
            done(rows)
    return rows


def _trained_row(
    scene: str, name: str, profile: Profile, samples: _Samples, note: Callable[[str], None], device: str
) -> Row:
    validation, pools = samples.validation(profile.dataset), samples.pools(profile.dataset, profile.training.rounds)
    note(f"trains {name}")
    network, skipped, seconds, ms = _train(profile, pools, device)
    figures = {
        "training s": number(seconds),
        "ms a step": f"{ms:.3g}",
        "parameters": number(parameter_count(network)),
    }
    lost = f"{skipped} steps gave NaN or infinity" if skipped else ""
    return _row(scene, name, score(of_network(network), validation), figures, lost, encode_seconds=seconds)


def variants(base: Profile) -> dict[str, Profile | None]:
    """The profiles that are compared.

    Args:
        base: What each is with one change.

    Returns:
        Profiles by their rows' names, and None for the march that needs none. Those that the base is already are equal
        to it.
    """
    losses = base.training.losses
    changes = {
        "no adapters": {"network": {"adapters": False}},
        "no sRGB": {"training": {"losses": {"srgb": False}}},
        # The last part that there is stays.
        "no temporal loss": {"training": {"losses": {"temporal": 0.0} if len(losses.parts) > 1 else {}}},
        "with perceptual loss": {"training": {"losses": {"perceptual": losses.perceptual or _PERCEPTUAL}}},
        "no depth": {"network": {"depth": False}},
        "one level less": {"network": {"levels": max(base.network.levels - 1, 2)}},
        "stem 1": {"network": {"stem": 1}},
    }
    for kind, name in _GUIDES.items():
        changes[name] = {"network": {"guide": kind}, "dataset": _seen_by(kind)}
    made = {name: _changed(base, change) for name, change in changes.items()}
    return {"base": base, **made, COARSE: None}


def _seen_by(kind: str) -> dict[str, object]:
    """Changes to the settings of samples for another kind of guide: the paper's has no nodes to be set apart."""
    return {"guide": kind} | ({"guide_spacing": None} if kind == "paper" else {})


def _chosen(base: Profile, only: Sequence[str], note: Callable[[str], None]) -> dict[str, Profile | None]:
    """Those variants that are wanted and can be trained."""
    known = variants(base)
    for name in only:
        if name not in known:
            raise WlmError(f"bench: --only: expected one of {', '.join(known)}; found '{name}'")
    chosen = {}
    for name, profile in known.items():
        if only and name not in only:
            continue
        reason = "" if profile is None or name == "base" else _left_out(profile, base)
        if not reason:
            chosen[name] = profile
        elif only:
            raise WlmError(f"bench: --only: {name}: {reason}")
        else:
            note(f"{name}: left out, {reason}")
    return chosen


def _left_out(profile: Profile, base: Profile) -> str:
    """Why a variant isn't trained; empty if it is."""
    if profile == base:
        return f"{base.name} is so already"
    try:
        # Before any sample is made.
        Losses(profile.training.losses)
    except WlmError as error:
        return str(error)
    return ""


class _Samples:
    """Samples, each made once: those of the validations stay, a training's until others are asked for."""

    def __init__(self, sizes: AblationSizes, device: str, note: Callable[[str], None]) -> None:
        self._sizes, self._device, self._note = sizes, device, note
        self._validations: dict[DatasetSettings, Pool] = {}
        self._pools: tuple[DatasetSettings | None, list[Pool]] = None, []

    def validation(self, settings: DatasetSettings) -> Pool:
        """What all variants with these settings are held against."""
        if settings not in self._validations:
            self._note(f"makes the validation, guide {settings.guide}")
            made = make_validation(_changed(settings, self._sizes.validation), self._device)
            self._validations[settings] = _with_smoke("the validation", made)
        return self._validations[settings]

    def pools(self, settings: DatasetSettings, rounds: int) -> list[Pool]:
        """One a round."""
        if self._pools[0] != settings:
            # Their memory goes back first, and not to torch alone: the simulation is Warp's.
            self._pools = None, []
            torch.cuda.empty_cache()
            made = []
            for i in range(rounds):
                self._note(f"makes samples, guide {settings.guide}, round {i + 1} of {rounds}")
                pool = make_pool(settings, seed=_SEED, round=i, device=self._device)
                made.append(_with_smoke(f"round {i}", pool))
            self._pools = settings, made
        return self._pools[1]


def _with_smoke(where: str, pool: Pool) -> Pool:
    if not len(pool):
        raise WlmError(f"bench: {where}: expected frames with smoke, found none")
    return pool


def _train(profile: Profile, pools: Sequence[Pool], device: str) -> tuple[SixWayNetwork, int, float, float]:
    """Trains a network; returns also the steps left out, the seconds in all and a step's milliseconds, the median."""
    gc.collect()  # a trainer and its graph hold each other, and much memory
    settings = profile.training
    trainer = Trainer(profile.network, settings, seed=_SEED, device=device)
    chunk = max(1, min(_CHUNK, settings.steps // _CHUNKS))
    total, steps = 0.0, []
    for i, pool in enumerate(pools):
        plan = plan_round(settings, pool, seed=_SEED, round=i)
        for begin in range(0, settings.steps, chunk):
            part = plan.part(begin, begin + chunk)
            _wait(device)
            start = time.perf_counter()
            trainer.run(pool, part)
            _wait(device)
            seconds = time.perf_counter() - start
            total += seconds
            steps.append(1e3 * seconds / len(part.samples))
    return trainer.average, trainer.skipped, total, statistics.median(steps)


def _wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize(device)


def _row(scene: str, name: str, found: Score, figures: dict[str, str], note: str, **values) -> Row:
    decibels = {"least": found.lowest, "most": found.highest}
    decibels |= {plane: found.planes[PLANES.index(plane)] for plane in _PLANES}
    quality = {f"{title} dB": f"{value:.2f}" for title, value in decibels.items()}
    quality["flicker over the reference's"] = f"{found.flicker_ratio:.3f}"
    return smoke_row(scene, METHOD, name, quality | figures, note, system="smoke-network", psnr=found.psnr, **values)


def _changed(settings: _Settings, changes: Mapping[str, object]) -> _Settings:
    """Settings with some of them, and some of their parts', replaced, and all checked again."""
    given = {
        name: _changed(getattr(settings, name), value) if isinstance(value, Mapping) else value
        for name, value in changes.items()
    }
    return type(settings).model_validate({**dict(settings), **given})
