"""How near planes come to their reference, and how much they flicker: of a network, and of what it is compared with.

All figures are of encoded planes, that is in sRGB, as the paper's PSNR is (section 5). A method is any function that
makes planes of a pool's samples; those here are the network itself, a `Predictor`, the coarse march of all six lights,
which needs no network, and a flip book that was baked from one side and is shown from all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from wlm.errors import WlmError
from wlm.metrics.error import psnr_from_mse
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.decode import Predictor
from wlm.smoke.learn.dataset import DatasetSettings, covered, load_probe_volume, make_validation
from wlm.smoke.learn.losses import residual
from wlm.smoke.model import SixWayNetwork
from wlm.smoke.planes import GUIDES, OPACITY_PLANE, PLANES, Pool

__all__ = [
    "COARSE",
    "DENSITIES",
    "FLIP_BOOK",
    "HALF",
    "NETWORK",
    "Comparison",
    "Evaluation",
    "Method",
    "coarse",
    "compare",
    "evaluate",
    "evaluate_all",
    "flip_book",
    "of_network",
    "of_predictor",
]

Method = Callable[[Pool, slice], torch.Tensor]
"""Planes [n, 2, 8, H, W] for both frames of the samples that a slice takes from a pool; they needn't be clamped."""

NETWORK, HALF, COARSE, FLIP_BOOK = "network", "network, half floats", "coarse march", "flip book"
"""Names of methods in a `Comparison`."""

DENSITIES = (0.5, 1.0, 2.0)
"""Factors on the density, those of the paper's ablation (figure 5)."""

_BATCH = 8
_STILL = 1e-4  # a fortieth of what a byte can show
_BESIDE = GUIDES["six"]


@dataclass(frozen=True)
class Evaluation:
    """How well planes fit a pool; decibels in sRGB, of 1 as the peak, over whole images.

    Attributes:
        psnr: Mean over the images, each over its six lightmaps, as in the paper.
        lowest, highest: Of the images.
        planes: Of each of `samples.PLANES`, from the mean square over all images.
        flicker: Mean change of the six lightmaps from a frame to the next where smoke is seen, after the earlier one
            has been moved as the smoke has: what is left of it is shadows that move otherwise, smoke that is new, and
            flicker. NaN where no smoke is seen.
        reference_flicker: The same of the reference, in which nothing flickers.
    """

    psnr: float
    lowest: float
    highest: float
    planes: tuple[float, ...]
    flicker: float
    reference_flicker: float

    @property
    def flicker_ratio(self) -> float:
        """Flicker over that of the reference: 1 is as steady as it; NaN where that doesn't change, but by rounding."""
        return self.flicker / self.reference_flicker if self.reference_flicker > _STILL else math.nan

    def to_json(self) -> dict[str, object]:
        """For a file, with null for NaN."""
        values = {name: getattr(self, name) for name in ("psnr", "lowest", "highest", "flicker", "reference_flicker")}
        values["flicker_ratio"] = self.flicker_ratio
        known = {name: None if math.isnan(value) else value for name, value in values.items()}
        return {**known, "planes": dict(zip(PLANES, self.planes, strict=True))}


def of_network(network: torch.nn.Module) -> Method:
    """A network as it is, in float32, many images at once."""

    def method(pool: Pool, part: slice) -> torch.Tensor:
        guides = pool.guides[part]
        return network(guides.flatten(0, 1).float()).unflatten(0, guides.shape[:2])

    return method


def of_predictor(predictor: Predictor) -> Method:
    """A network as it is used: folded, one image at a time, on a GPU in half floats if the predictor is."""

    def method(pool: Pool, part: slice) -> torch.Tensor:
        guides = pool.guides[part]
        # A copy each: the next call overwrites them.
        made = [predictor(guide).clone() for guide in guides.flatten(0, 1).float()]
        return torch.stack(made).unflatten(0, guides.shape[:2])

    return method


def coarse(pool: Pool, part: slice) -> torch.Tensor:
    """The march in large steps that is the guide of kind "six", as it is: what the network has to be better than.

    Raises:
        ValueError: The pool's guides are of another kind.
    """
    if pool.guides.shape[2] != len(_BESIDE):
        raise ValueError(f"pool: expected guides of kind six, [N, 2, {len(_BESIDE)}, H, W]")
    return pool.guides[part][:, :, [_BESIDE.index(name) for name in PLANES]].float()


def flip_book(pool: Pool, views: int, keep: torch.Tensor | None = None) -> tuple[Pool, Method]:
    """What a flip book that was baked from the first view shows in the others.

    A billboard that turns with the camera shows the same from all sides (`baselines.billboard`), so that these are the
    first view's own planes.

    Args:
        pool: Of a validation or a volume, of which nothing was left out: pairs of frames one after the other, each
            from all views, which turn about the box's centre.
        views: So many.
        keep: bool [N], the samples to be looked at; None: all.

    Returns:
        The samples of the other views, and the method for them; no samples where there is no other view.

    Raises:
        ValueError: The pool isn't whole.
    """
    if views < 1 or len(pool) % views:
        raise ValueError(f"pool: expected whole sets of {views} views, got {len(pool)} samples")
    number = torch.arange(len(pool), device=pool.device)
    others = number % views > 0
    if keep is not None:
        others &= keep
    others = number[others]
    baked = pool.targets[others - others % views]
    return pool.take(others), lambda _, part: baked[part].float()


def evaluate(
    network: SixWayNetwork, pool: Pool, predictor: Predictor | None = None, *, batch: int = _BATCH
) -> Evaluation:
    """Runs a network over both frames of all samples, its outputs clamped as `decode_lightmaps` does.

    Args:
        network: On the pool's device; it runs in float32.
        pool: With guides of its kind.
        predictor: What is run instead, if given: of the pool's size, on its device.
        batch: Samples at once.

    Raises:
        ValueError: The pool is empty, or doesn't fit.
    """
    method = of_network(network) if predictor is None else of_predictor(predictor)
    return _evaluate(method, pool, batch)


def compare(methods: Mapping[str, Method], pool: Pool, *, batch: int = _BATCH) -> dict[str, Evaluation]:
    """Runs several methods over the same samples.

    Args:
        methods: By the names that the result has.
        pool: With what they read.
        batch: Samples at once.

    Raises:
        ValueError: The pool is empty, or a method gives planes of another shape.
    """
    return {name: _evaluate(method, pool, batch) for name, method in methods.items()}


@torch.no_grad()
def _evaluate(method: Method, pool: Pool, batch: int) -> Evaluation:
    if len(pool) == 0:
        raise ValueError("pool: expected samples, got none")
    lights = len(DIRECTIONS)
    squares, changes = [], []
    for begin in range(0, len(pool), batch):
        part = slice(begin, begin + batch)
        wanted = pool.targets[part].float()
        made = method(pool, part).float()
        if made.shape != wanted.shape:
            raise ValueError(f"planes: expected {list(wanted.shape)}, got {list(made.shape)}")
        made = torch.cat([made[:, :, :lights].clamp(min=0.0), made[:, :, lights:].clamp(0.0, 1.0)], 2)
        squares.append((made - wanted).square().mean((3, 4)).flatten(0, 1))
        motion, opacity = pool.motion[part].float(), wanted[:, 1, OPACITY_PLANE]
        found = [residual(frames[:, :, :lights], motion, opacity) for frames in (made, wanted)]
        (own, count), (known, _) = found
        changes.append(torch.stack([own, known, count]).double())
    error = torch.cat(squares).double().cpu()
    images = [psnr_from_mse(value, 1.0) for value in error[:, :lights].mean(1).tolist()]
    planes = tuple(psnr_from_mse(value, 1.0) for value in error.mean(0).tolist())
    own, known, count = torch.stack(changes).sum(0).tolist()
    flicker = (own / count, known / count) if count else (math.nan, math.nan)
    return Evaluation(sum(images) / len(images), min(images), max(images), planes, *flicker)


@dataclass(frozen=True)
class Comparison:
    """Methods on one set of images.

    Attributes:
        name: What the images are of.
        samples: Pairs of frames.
        methods: By name; the flip book's own view isn't among its images.
    """

    name: str
    samples: int
    methods: dict[str, Evaluation]

    @property
    def half_loss(self) -> float | None:
        """Decibels by which half floats are worse; None where they weren't tried."""
        half = self.methods.get(HALF)
        return None if half is None else self.methods[NETWORK].psnr - half.psnr

    def to_json(self) -> dict[str, object]:
        """For a file."""
        methods = {name: found.to_json() for name, found in self.methods.items()}
        return {"name": self.name, "samples": self.samples, "half_loss": self.half_loss, "methods": methods}


def evaluate_all(
    network: SixWayNetwork,
    settings: DatasetSettings,
    volumes: Sequence[Path] = (),
    *,
    densities: Sequence[float] = DENSITIES,
    device: str = "cpu",
    progress: Callable[[int, int, str], None] | None = None,
) -> list[Comparison]:
    """Evaluates a network on sequences that it hasn't learned from nor was chosen by, and what needs no network.

    Args:
        network: On the device.
        settings: Those that it was trained with, but for sizes.
        volumes: Files for `load_probe_volume`, each seen from all fixed views.
        densities: Factors on the density of the sequences' smoke.
        device: As `check_device` returns it.
        progress: Called after each set with how many are done, how many there are, and which this was.

    Returns:
        A comparison for each density, then for each volume.

    Raises:
        WlmError: The memory isn't enough, a volume can't be read, or there is no smoke in the sequences.
    """
    own, six = (settings.model_copy(update={"guide": kind}) for kind in (network.settings.guide, "six"))

    def sequences(scale: float) -> Callable[[DatasetSettings], Pool]:
        # Of all frames, so that each has its first view; those almost empty are left out below.
        return lambda made: make_validation(made.model_copy(update={"kept_empty": 1.0}), device, test=True, scale=scale)

    def volume(path: Path) -> Callable[[DatasetSettings], Pool]:
        return lambda made: load_probe_volume(path, made, device=device)

    sets = {f"density x {scale:g}": sequences(scale) for scale in densities}
    sets |= {str(path): volume(path) for path in volumes}
    found = []
    for done, (name, make) in enumerate(sets.items(), 1):
        whole = make(own)
        keep = torch.ones(len(whole), dtype=torch.bool, device=whole.device)
        if done <= len(densities):
            keep = covered(whole.targets) > settings.least_coverage
        pool = whole.take(keep)
        if not len(pool):
            raise WlmError(f"{name}: expected frames with smoke, found none")
        methods = compare({NETWORK: of_network(network)}, pool)
        if device != "cpu":
            predictor = Predictor(network, *pool.guides.shape[-2:], device=device)
            methods |= compare({HALF: of_predictor(predictor)}, pool)
        # The same smoke and views: the kind of guide changes nothing else.
        methods |= compare({COARSE: coarse}, pool if own == six else make(six).take(keep))
        others, shown = flip_book(whole, settings.views, keep)
        if len(others):
            methods |= compare({FLIP_BOOK: shown}, others)
        found.append(Comparison(name, len(pool), methods))
        if progress is not None:
            progress(done, len(sets), name)
    return found
