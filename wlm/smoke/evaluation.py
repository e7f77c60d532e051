"""Scores of the lightmaps that a network or another method predicts for test samples.

All errors are measured in sRGB, as encoded for the network, like the paper's PSNR (section 5).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from wlm import system
from wlm.errors import WlmError
from wlm.interop import check_device
from wlm.metrics import psnr_from_mse
from wlm.smoke.camera import DIRECTIONS
from wlm.smoke.decode import Decoder
from wlm.smoke.model import SmokeModel
from wlm.smoke.network.dataset import make_validation
from wlm.smoke.network.losses import residual
from wlm.smoke.network.planes import GUIDES, OPACITY_PLANE, PLANES, Pool
from wlm.smoke.network.settings import DatasetSettings
from wlm.system import Meter, OnProgress

Method = Callable[[Pool, slice], torch.Tensor]
"""Function that predicts planes [n, 2, 8, H, W] of both frames of a slice of a pool; `score` clamps them."""

_BATCH = 8  # samples
_STILL = 1e-4  # a flicker up to this, a fortieth of a level of 8 bits, counts as none


@dataclass(frozen=True)
class Score(system.Report):
    """Scores of predicted lightmaps on samples; each PSNR is in dB, in sRGB with a peak of 1, over whole images.

    Attributes:
        psnr: Mean over the images of the PSNR of their six lightmaps, as in the paper.
        lowest, highest: Lowest and highest PSNR of an image.
        planes: PSNR of each plane (lightmap, opacity, emission) of `PLANES`, from the mean square error of all images.
        flicker: Mean absolute change of the six lightmaps from frame to frame where smoke is visible, after warping the
            earlier frame by the smoke's motion. Shadows that move differently and new smoke count as flicker too.
        reference_flicker: Flicker of the reference lightmaps.
        images: PSNR of each image: both frames of the first sample, then of the second.
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
        """Flicker divided by the flicker of the reference lightmaps; NaN if the reference does not change."""
        return self.flicker / self.reference_flicker if self.reference_flicker > _STILL else math.nan

    def to_json(self) -> dict[str, Any]:
        """Returns the scores and the flicker ratio as JSON values, with the PSNRs of planes by name."""
        names = ("psnr", "lowest", "highest", "flicker", "reference_flicker", "flicker_ratio")
        planes = dict(zip(PLANES, self.planes, strict=True))
        return system.plain({name: getattr(self, name) for name in names} | {"planes": planes})


@dataclass(frozen=True)
class Report(Score):
    """The score of a network as it runs in use: through its `Decoder`, one image at a time.

    Attributes:
        guide_psnr: PSNR of the guiding maps alone, if they are lightmaps by a coarse march; NaN for the paper's kind.
        samples: Number of samples.
        bytes: Size of the network's file in bytes.
    """

    guide_psnr: float
    samples: int
    bytes: int

    def to_json(self) -> dict[str, Any]:
        own = {"guide_psnr": self.guide_psnr, "samples": self.samples, "bytes": self.bytes}
        return super().to_json() | system.plain(own)


def evaluate(
    model: SmokeModel,
    data: Pool | DatasetSettings | None = None,
    *,
    device: str = "cpu",
    progress: OnProgress | None = None,
    file_bytes: int | None = None,
    half: bool = True,
) -> Report:
    """Scores a network as it runs in use: through its `Decoder`, one image at a time.

    Args:
        model: The network.
        data: Samples with guiding maps of the network's kind; or settings by which a test set is simulated, of scenes
            that were not used in training or for choosing a network. None: the settings of the network's training.
        device: "cpu", "cuda" or "cuda:N".
        progress: Called about twice a second.
        file_bytes: Size of the network's file in bytes; None: `model.file_bytes()`.
        half: Whether a GPU computes in half floats.

    Raises:
        WlmError: The device does not exist, the model lacks its settings, there is not enough memory, or no frame has
            smoke.
        ValueError: The samples do not fit the network.
    """
    device = check_device(device)
    if not isinstance(data, Pool):
        settings = (data or model.dataset).model_copy(update={"guide": model.settings.guide})
        data = make_validation(settings, device, test=True, progress=progress)
        if not len(data):
            raise WlmError("test set: expected frames with smoke, found only frames without")
    pool = data.to(device)
    height, width = pool.guides.shape[-2:]
    scores = score(of_decoder(Decoder(model, device, height=height, width=width, half=half)), pool, progress=progress)
    guide = score(coarse, pool).psnr if model.settings.guide == "six" else math.nan
    size = model.file_bytes() if file_bytes is None else file_bytes
    return Report(**vars(scores), guide_psnr=guide, samples=len(pool), bytes=size)


def of_network(network: torch.nn.Module) -> Method:
    """Returns the function for `score` that runs a network in float32 on several images at once."""

    def method(pool: Pool, part: slice) -> torch.Tensor:
        guides = pool.guides[part]
        return network(guides.flatten(0, 1).float()).unflatten(0, guides.shape[:2])

    return method


def of_decoder(decoder: Decoder) -> Method:
    """Returns the function for `score` that runs a decoder on one image at a time."""

    def method(pool: Pool, part: slice) -> torch.Tensor:
        guides = pool.guides[part]
        # Copied: the next call overwrites the result.
        planes = [decoder(guide).clone() for guide in guides.flatten(0, 1).float()]
        return torch.stack(planes).unflatten(0, guides.shape[:2])

    return method


@torch.no_grad()
def score(method: Method, pool: Pool, *, batch: int = _BATCH, progress: OnProgress | None = None) -> Score:
    """Scores a method on both frames of all samples, after its planes are clamped as by `decode_lightmaps`.

    Args:
        method: Function of a pool and a slice that predicts encoded lightmaps for these samples.
        pool: The samples, with the guiding maps that the method reads.
        batch: Number of samples per call of the method.
        progress: Called about twice a second.

    Raises:
        ValueError: The pool is empty, or the planes have a wrong shape.
    """
    if len(pool) == 0:
        raise ValueError("pool: expected at least one sample, got none")
    meter = Meter(progress, "evaluate", len(pool))
    lights = len(DIRECTIONS)
    squares, changes = [], []
    for begin in range(0, len(pool), batch):
        part = slice(begin, begin + batch)
        target = pool.targets[part].float()
        predicted = method(pool, part).float()
        if predicted.shape != target.shape:
            raise ValueError(f"predicted planes: expected shape {list(target.shape)}, got {list(predicted.shape)}")
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


def coarse(pool: Pool, part: slice) -> torch.Tensor:
    """Predicts the guiding maps themselves, for `score`; they must be of kind "six", a coarse march of six lights."""
    six = GUIDES["six"]
    if pool.guides.shape[2] != len(six):
        raise ValueError(f"pool: expected guiding maps of kind six with {len(six)} planes, got {pool.guides.shape[2]}")
    return pool.guides[part][:, :, [six.index(name) for name in PLANES]].float()
