"""Scores of lightmaps: a network's, and those of any other method on the same samples.

All scores are of encoded planes, that is in sRGB, as the paper's PSNR is (section 5).

=====================================  =====================================================
an exact prediction                    120 dB, as everywhere (`wlm.metrics`)
no visible smoke                       the flicker is NaN
a target that doesn't change           the ratio of flickers is NaN
no samples, or planes of another size  error
=====================================  =====================================================
"""

import copy
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch

from wlm import system
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.decode import Decoder
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.dataset import make_validation, pool_of_volume
from wlm.smoke.network.losses import residual
from wlm.smoke.network.planes import OPACITY_PLANE, PLANES
from wlm.smoke.network.pool import Pool
from wlm.smoke.network.settings import DatasetSettings
from wlm.system import Meter, OnProgress

Method = Callable[[Pool, slice], torch.Tensor]
"""Predicts planes [n, 2, 8, H, W] of both frames of the samples that a slice takes from a pool; `score` clamps."""

NETWORK, HALF = "network", "network, half floats"
"""Names of a network's own methods in a `Comparison`."""

REFERENCE = "reference"
"""The fine march's name in an `Example`."""

DENSITIES = (0.5, 1.0, 2.0)
"""Factors on the density, those of the paper's ablation (figure 5)."""

_BATCH = 8  # samples
_EXAMPLES = 2  # of a comparison
_STILL = 1e-4  # a flicker of no more than this, a fortieth of a byte's step, counts as none


@dataclass(frozen=True)
class Score(system.Report):
    """How well predicted planes fit a pool; decibels in sRGB with a peak of 1, over whole images.

    Attributes:
        psnr: Mean over the images, each over its six lightmaps, as in the paper.
        lowest, highest: Over the images.
        planes: For each of `PLANES`, of the mean square error over all images.
        flicker: Mean absolute change of the six lightmaps from frame to frame where smoke is visible, after warping the
            earlier frame by the smoke's motion. Shadows that move otherwise and new smoke count too.
        reference_flicker: The same of the targets, in which nothing flickers.
        images: PSNR of each image: of both frames of the first sample, then of the second.
    """

    psnr: float
    lowest: float
    highest: float
    planes: tuple[float, ...]
    flicker: float
    reference_flicker: float
    images: tuple[float, ...]

    @property
    def flicker_ratio(self) -> float:
        """Flicker over the targets': 1 is as steady as these; NaN where the targets don't change."""
        return self.flicker / self.reference_flicker if self.reference_flicker > _STILL else math.nan

    def to_json(self) -> dict[str, Any]:
        """As `wlm.system.Report.to_json`, with the ratio of flickers, and planes by name."""
        names = ("psnr", "lowest", "highest", "flicker", "reference_flicker", "flicker_ratio")
        planes = dict(zip(PLANES, self.planes, strict=True))
        return system.plain({name: getattr(self, name) for name in names} | {"planes": planes})


@dataclass(frozen=True)
class Report(Score):
    """The score of a network at run time.

    Attributes:
        samples: Number of samples.
        bytes: Size of the network's file.
    """

    samples: int
    bytes: int

    def to_json(self) -> dict[str, Any]:
        return super().to_json() | {"samples": self.samples, "bytes": self.bytes}


def evaluate(
    model: SmokeModel,
    data: Pool | DatasetSettings | None = None,
    *,
    device: str = "cpu",
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
    half: bool = True,
) -> Report:
    """Scores a network as it runs: one image at a time through its `Decoder`.

    Args:
        model: The network.
        data: Samples with guiding maps of its kind; or settings, of which the test set is simulated, which no network
            was trained on or selected by; None: the settings that it was trained with.
        device: "cpu", "cuda" or "cuda:N".
        progress: Called about twice a second.
        file_bytes: Size of the network's file; None: `model.file_bytes()`.
        half: Whether a GPU computes in half floats.

    Raises:
        WlmError: No such device, the file lacks its settings, the memory isn't enough, or no frame has smoke.
        ValueError: The samples don't fit the network.
    """
    device = check_device(device)
    if not isinstance(data, Pool):
        settings = _with_guide(data or model.dataset, model.settings.guide)
        data = make_validation(settings, device, test=True, progress=progress)
        if not len(data):
            raise WlmError("test set: expected frames with smoke, found none")
    pool = data.to(device)
    scores = score(_at_run_time(model, device, pool, half), pool, progress=progress)
    return Report(**vars(scores), samples=len(pool), bytes=model.file_bytes() if file_bytes is None else file_bytes)


def of_network(network: torch.nn.Module) -> Method:
    """A network in float32, several images at once, as training validates it."""

    def method(pool: Pool, part: slice) -> torch.Tensor:
        guides = pool.guides[part]
        return network(guides.flatten(0, 1).float()).unflatten(0, guides.shape[:2])

    return method


def of_decoder(decoder: Decoder) -> Method:
    """A network at run time."""

    def method(pool: Pool, part: slice) -> torch.Tensor:
        guides = pool.guides[part]
        # Copied, since the next call overwrites them.
        planes = [decoder(guide).clone() for guide in guides.flatten(0, 1).float()]
        return torch.stack(planes).unflatten(0, guides.shape[:2])

    return method


@torch.no_grad()
def score(method: Method, pool: Pool, *, batch: int = _BATCH, progress: OnProgress | None = None) -> Score:
    """Scores a method on both frames of all samples; its planes are clamped as `decode_lightmaps` does.

    Args:
        method: The method.
        pool: The samples, with what the method reads.
        batch: Samples at once.
        progress: Called about twice a second.

    Raises:
        ValueError: The pool is empty, or the method's planes have another shape.
    """
    if len(pool) == 0:
        raise ValueError("pool: expected samples, got none")
    meter = Meter(progress, "evaluate", len(pool))
    lights = len(DIRECTIONS)
    squares, changes = [], []
    for begin in range(0, len(pool), batch):
        part = slice(begin, begin + batch)
        target = pool.targets[part].float()
        predicted = method(pool, part).float()
        if predicted.shape != target.shape:
            raise ValueError(f"planes: expected {list(target.shape)}, got {list(predicted.shape)}")
        predicted = torch.cat([predicted[:, :, :lights].clamp(min=0.0), predicted[:, :, lights:].clamp(0.0, 1.0)], 2)
        squares.append((predicted - target).square().mean((3, 4)).flatten(0, 1))
        motion, opacity = pool.motion[part].float(), target[:, 1, OPACITY_PLANE]
        flicker, count = residual(predicted[:, :, :lights], motion, opacity)
        target_flicker, _ = residual(target[:, :, :lights], motion, opacity)
        changes.append(torch.stack([flicker, target_flicker, count]).double())
        if meter.due(done := min(begin + batch, len(pool))):
            meter.report(done)
    errors = torch.cat(squares).double().cpu()
    images = [psnr_from_mse(value, 1.0) for value in errors[:, :lights].mean(1).tolist()]
    planes = tuple(psnr_from_mse(value, 1.0) for value in errors.mean(0).tolist())
    flicker, target_flicker, count = torch.stack(changes).sum(0).tolist()
    means = (flicker / count, target_flicker / count) if count else (math.nan, math.nan)
    return Score(sum(images) / len(images), min(images), max(images), planes, *means, tuple(images))


@dataclass(frozen=True, eq=False)
class HeldOut:
    """Held-out samples of one smoke: all frame pairs, each from all views.

    Attributes:
        whole: All samples, ordered by frame pair and then by view; the views turn about the box's centre.
        keep: bool [N], the samples that count: those that aren't almost empty.
        settings: How they were made.
        make: Makes them anew with other settings.
    """

    whole: Pool
    keep: torch.Tensor
    settings: DatasetSettings
    make: Callable[[DatasetSettings], Pool]

    def pool(self, guide: str) -> Pool:
        """The samples that count, with guiding maps of a kind; nothing else depends on that."""
        same = guide == self.settings.guide
        return (self.whole if same else self.make(_with_guide(self.settings, guide))).take(self.keep)

    @property
    def kept(self) -> torch.Tensor:
        """int [n], the numbers of the samples that count."""
        return self.keep.nonzero().flatten()


class Entry(NamedTuple):
    """A method, with what it is scored on.

    Attributes:
        numbers: int [n], which of all held-out samples; maybe none.
        pool: These samples, with what the method reads.
        method: The method.
    """

    numbers: torch.Tensor
    pool: Pool
    method: Method


Contender = Callable[[HeldOut], Entry]
"""Enters a method for held-out samples."""


@dataclass(frozen=True, eq=False)
class Example:
    """An image on which the network does badly.

    Attributes:
        frame, view: Its place in `Comparison.images`.
        planes: float16 [8, H, W] on the CPU, encoded lightmaps of `REFERENCE` and of each method that has this image.
    """

    frame: int
    view: int
    planes: dict[str, torch.Tensor]


@dataclass(frozen=True, eq=False)
class Comparison:
    """Methods on one held-out set.

    Attributes:
        name: What the samples show.
        samples: Number of frame pairs and views.
        methods: Scores by name.
        turns: float [views], degrees by which each view is turned about the smoke.
        images: PSNR of each image by the method's name, [frames, views]; NaN where the method has no such image. Both
            frames of a pair follow each other; those of a volume are alike.
        worst: The samples on which the network does worst, each by its worse frame, the worst first.
    """

    name: str
    samples: int
    methods: dict[str, Score]
    turns: np.ndarray
    images: dict[str, np.ndarray]
    worst: tuple[Example, ...]

    @property
    def half_loss(self) -> float | None:
        """Decibels lost by half floats; None where they weren't tried."""
        half = self.methods.get(HALF)
        return None if half is None else self.methods[NETWORK].psnr - half.psnr

    def to_json(self) -> dict[str, Any]:
        """As JSON's own types."""
        methods = {name: scores.to_json() for name, scores in self.methods.items()}
        return {"name": self.name, "samples": self.samples, "half_loss": self.half_loss, "methods": methods}


def compare(
    model: SmokeModel,
    settings: DatasetSettings | None = None,
    volumes: Sequence[str | os.PathLike[str]] = (),
    *,
    rivals: Mapping[str, Contender] | None = None,
    densities: Sequence[float] = DENSITIES,
    device: str = "cpu",
    progress: OnProgress | None = None,
) -> list[Comparison]:
    """Scores a network and its rivals on the test set at several densities, and on volumes.

    Args:
        model: The network.
        settings: Of the test set; None: those that it was trained with.
        volumes: Files for `pool_of_volume`.
        rivals: Other methods, by name.
        densities: Factors on the test set's extinction.
        device: "cpu", "cuda" or "cuda:N".
        progress: Called after each set, with the network's "PSNR dB".

    Returns:
        A comparison for each density, then for each volume.

    Raises:
        WlmError: No such device, the file lacks its settings, the memory isn't enough, a volume can't be read, or no
            frame has smoke.
    """
    device, guide = check_device(device), model.settings.guide
    settings = _with_guide(settings or model.dataset, guide)
    network = copy.deepcopy(model.network).to(device)

    def at_run_time(held_out: HeldOut) -> Entry:
        pool = held_out.pool(guide)
        return Entry(held_out.kept, pool, _at_run_time(model, device, pool))

    contenders: dict[str, Contender] = {
        NETWORK: lambda held_out: Entry(held_out.kept, held_out.pool(guide), of_network(network))
    }
    if device != "cpu":
        contenders[HALF] = at_run_time
    contenders |= rivals or {}
    # All frames are made, so that each has its first view; almost empty ones don't count, but in volumes all do.
    complete = settings.model_copy(update={"kept_empty": 1.0})
    sets = {
        f"density x {scale:g}": (
            partial(make_validation, device=device, test=True, scale=scale),
            settings.least_coverage,
        )
        for scale in densities
    }
    sets |= {os.fspath(path): (partial(pool_of_volume, path, device=device), -1.0) for path in volumes}
    meter = Meter(progress, "evaluate", len(sets))
    comparisons = []
    for name, (make, least_coverage) in sets.items():
        whole = make(complete)
        held_out = HeldOut(whole, whole.covered() > least_coverage, complete, make)
        if not len(held_out.kept):
            raise WlmError(f"{name}: expected frames with smoke, found none")
        comparisons.append(_compare(name, held_out, contenders))
        meter.report(len(comparisons), PSNR_dB=comparisons[-1].methods[NETWORK].psnr)
    return comparisons


@torch.no_grad()
def _compare(name: str, held_out: HeldOut, contenders: Mapping[str, Contender]) -> Comparison:
    """Scores methods on one smoke; the first is the network, whose worst images all show."""
    views = held_out.settings.views
    scores: dict[str, Score] = {}
    images: dict[str, np.ndarray] = {}
    worst: list[tuple[int, int]] = []  # a sample and its worse frame
    planes: list[dict[str, torch.Tensor]] = []
    for method_name, contender in contenders.items():
        # One after the other: each pool is a copy.
        numbers, pool, method = contender(held_out)
        if not len(pool):
            continue
        scores[method_name] = score(method, pool)
        found = np.full((len(held_out.whole), 2), np.nan)
        found[numbers.cpu().numpy()] = np.reshape(scores[method_name].images, (-1, 2))
        images[method_name] = found.reshape(-1, views, 2).swapaxes(1, 2).reshape(-1, views)
        if not worst:
            order = np.argsort(np.nan_to_num(found.min(1), nan=np.inf))[: min(len(pool), _EXAMPLES)]
            worst = [(int(sample), int(found[sample].argmin())) for sample in order]
            planes = [{REFERENCE: held_out.whole.targets[place].cpu()} for place in worst]
        for (sample, frame), shown in zip(worst, planes, strict=True):
            for i in (numbers == sample).nonzero().flatten().tolist():
                shown[method_name] = method(pool, slice(i, i + 1))[0, frame].half().cpu()
    examples = tuple(
        Example(2 * (sample // views) + frame, sample % views, shown)
        for (sample, frame), shown in zip(worst, planes, strict=True)
    )
    turns = held_out.settings.arc / views * np.arange(views)
    return Comparison(name, len(held_out.kept), scores, turns, images, examples)


def _at_run_time(model: SmokeModel, device: str, pool: Pool, half: bool = True) -> Method:
    """The network's decoder, for images of the pool's size."""
    height, width = pool.guides.shape[-2:]
    return of_decoder(Decoder(model, device, height=height, width=width, half=half))


def _with_guide(settings: DatasetSettings, kind: str) -> DatasetSettings:
    return settings.model_copy(update={"guide": kind})
