"""Ablation of the network, of its losses and of its guiding map (section 5, figures 6 and 15).

One profile is trained again and again, each time with one change: from the same seed, for as many steps, on the same
samples, and is scored on the same validation of other sequences. These are short trainings of small images: the rows
show what differs between them, and not how good a network gets. The changes:

- "four adapters", "one level less", "stem 1": the network's shape;
- "no temporal loss": the loss; a step then learns from single frames, of twice as many samples;
- "guide of the paper": another guiding map, for the network and in its samples;
- "coarse march": nothing is trained, the guide of kind "six" is scored directly.

Changes that change nothing in a profile are left out.
"""

import gc
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from benchmarks.rivals.smoke import COARSE, coarse
from benchmarks.rows import Row
from benchmarks.runner import Bench, Note
from wlm.errors import WlmError
from wlm.smoke.evaluation import Score, of_network, score
from wlm.smoke.model import parameter_count
from wlm.smoke.network.dataset import make_pool, make_validation
from wlm.smoke.network.planes import PLANES
from wlm.smoke.network.pool import Pool
from wlm.smoke.network.settings import DatasetSettings, Profile
from wlm.smoke.network.trainer import Trainer, plan_round
from wlm.smoke.network.unet import SixWayNetwork

METHOD = "ablation"
"""The table of these rows."""

_SEED = 0  # of weights, samples and their order
_CHUNK = 50  # steps that are timed as one, at most
_CHUNKS = 4  # of a round, at least: the first are slow
_GUIDES = {"six": "guide of six lights", "paper": "guide of the paper"}
_PLANES = ("right", "left")  # with a column of their own


@dataclass(frozen=True)
class AblationSizes:
    """Samples and length of the trainings.

    Attributes:
        dataset: Settings of the samples, in place of the profile's.
        validation: Settings of the validation, in place of those.
        rounds, steps: Rounds of each training, and steps of each round.
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
"""For a CPU, to see that all of it works: so few steps show nothing."""


def run(
    profile: str = "fast",
    only: Sequence[str] = (),
    *,
    quick: bool,
    device: str,
    rounds: int | None = None,
    steps: int | None = None,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Trains the variants of a profile and compares them.

    Args:
        profile: Its name, or a YAML file.
        only: Names of variants; none: all.
        quick: Small images and few steps, for seconds on a CPU.
        device: "cpu" or "cuda:0".
        rounds, steps: As in `AblationSizes`; None: those of the sizes.
        progress: Called with a line before each part of the work, and for each variant that is left out.
        done: Called after each row with all rows so far.

    Returns:
        One row for each variant.

    Raises:
        WlmError: The profile can't be read, no variant has such a name, one that was named can't be made, or the device
            isn't there or hasn't the memory.
    """
    sizes = QUICK if quick else FULL
    changes = {name: value for name, value in {"rounds": rounds, "steps": steps}.items() if value is not None}
    return run_rows(replace(sizes, **changes), Profile.load(profile), only, device=device, progress=progress, done=done)


def run_rows(
    sizes: AblationSizes,
    base: Profile,
    only: Sequence[str] = (),
    *,
    device: str,
    progress: Note | None = None,
    done: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Trains the variants of a profile at the given sizes; the rest as for `run`."""
    bench = Bench("smoke-network", device, progress, scene=f"validation, {base.name}")
    training = {"rounds": sizes.rounds, "steps": sizes.steps, "crop": None}
    base = base.override({"dataset": sizes.dataset, "training": training})
    chosen = _chosen(base, only, bench.note)
    samples = _Samples(sizes, bench)
    rows = []
    for name, profile in chosen.items():
        if profile is None:
            validation = samples.validation(base.dataset.model_copy(update={"guide": "six"}))
            rows.append(_row(bench, name, score(coarse, validation), "no network"))
        else:
            rows.append(_trained_row(bench, name, profile, samples))
        if done is not None:
            done(rows)
    return rows


def _trained_row(bench: Bench, name: str, profile: Profile, samples: "_Samples") -> Row:
    validation, pools = samples.validation(profile.dataset), samples.pools(profile.dataset, profile.training.rounds)
    bench.note(f"trains {name}")
    network, skipped, seconds, step_ms = _train(profile, pools, bench.device)
    figures = {"encode_seconds": seconds, "step_ms": step_ms, "parameters": parameter_count(network)}
    note = f"{skipped} steps gave NaN or infinity" if skipped else ""
    return _row(bench, name, score(of_network(network), validation), note, **figures)


def variants(base: Profile) -> dict[str, Profile | None]:
    """The profiles that are compared.

    Args:
        base: What each is with one change.

    Returns:
        Profiles by their rows' names, and None for the march, which needs none. Where a change changes nothing, the
        profile equals the base.
    """
    changes = {
        "four adapters": {"network": {"adapters": True}},
        "no temporal loss": {"training": {"temporal": 0.0}},
        "one level less": {"network": {"levels": max(base.network.levels - 1, 2)}},
        "stem 1": {"network": {"stem": 1}},
    }
    for kind, name in _GUIDES.items():
        # The paper's guide has no nodes, and so no distance between them.
        dataset = {"guide": kind} | ({"guide_spacing": None} if kind == "paper" else {})
        changes[name] = {"network": {"guide": kind}, "dataset": dataset}
    return {"base": base, **{name: base.override(change) for name, change in changes.items()}, COARSE: None}


def _chosen(base: Profile, only: Sequence[str], note: Note) -> dict[str, Profile | None]:
    """The variants that were asked for and can be trained."""
    profiles = variants(base)
    for name in only:
        if name not in profiles:
            raise WlmError(f"bench: --only: expected one of {', '.join(profiles)}; found '{name}'")
    chosen = {}
    for name, profile in profiles.items():
        if only and name not in only:
            continue
        if profile != base or name == "base":
            chosen[name] = profile
        elif only:
            raise WlmError(f"bench: --only: {name}: {base.name} is so already")
        else:
            note(f"{name}: left out, {base.name} is so already")
    return chosen


class _Samples:
    """Samples, each made once: validations stay, a training's samples until others are asked for."""

    def __init__(self, sizes: AblationSizes, bench: Bench) -> None:
        self._sizes, self._device, self._note = sizes, bench.device, bench.note
        self._validations: dict[DatasetSettings, Pool] = {}
        self._pools: tuple[DatasetSettings | None, list[Pool]] = None, []

    def validation(self, settings: DatasetSettings) -> Pool:
        """The validation of all variants with these settings."""
        if settings not in self._validations:
            self._note(f"makes the validation, guide {settings.guide}")
            pool = make_validation(settings.model_copy(update=self._sizes.validation), self._device)
            self._validations[settings] = _with_smoke("the validation", pool)
        return self._validations[settings]

    def pools(self, settings: DatasetSettings, rounds: int) -> list[Pool]:
        """The samples of each round."""
        if self._pools[0] != settings:
            # Their memory goes back first, and not to torch alone: the simulation is Warp's.
            self._pools = None, []
            torch.cuda.empty_cache()
            pools = []
            for i in range(rounds):
                self._note(f"makes samples, guide {settings.guide}, round {i + 1} of {rounds}")
                pool = make_pool(settings, seed=_SEED, round=i, device=self._device)
                pools.append(_with_smoke(f"round {i}", pool))
            self._pools = settings, pools
        return self._pools[1]


def _with_smoke(where: str, pool: Pool) -> Pool:
    if not len(pool):
        raise WlmError(f"bench: {where}: expected frames with smoke, found none")
    return pool


def _train(profile: Profile, pools: Sequence[Pool], device: str) -> tuple[SixWayNetwork, int, float, float]:
    """Trains a network; returns also the skipped steps, the seconds in all and the median milliseconds of a step."""
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


def _row(bench: Bench, name: str, evaluation: Score, note: str = "", **figures: float) -> Row:
    return bench.row(
        METHOD,
        name,
        note,
        psnr=evaluation.psnr,
        psnr_min=evaluation.lowest,
        psnr_max=evaluation.highest,
        flicker_ratio=evaluation.flicker_ratio,
        **{f"{plane}_psnr": evaluation.planes[PLANES.index(plane)] for plane in _PLANES},
        **figures,
    )
