"""Fits the mix of `orders` to path-traced light by least squares.

References may be noisy, as long as they have no bias: the least of a square error is the mean.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from wlm.interop import device_name, stream
from wlm.smoke.planes import to_srgb
from wlm.smoke.transport.features import Inputs, make_inputs, orders_march
from wlm.smoke.transport.orders import OrdersModel
from wlm.smoke.transport.samples import ALBEDOS, Sample, draw_lesson, traced
from wlm_kernels.smoke.orders import FEATURES, MIXES

FAINT = 0.03
"""Light below which an error counts the same."""

_RIDGE = 1e-5
_RARE, _NARROWEST = 0.02, 0.1  # share of depths at either end that aren't known, and the least range
_CLEAR = 1e-3  # opacity below which there is nothing to be learned: light is bounded by it
_CURVE = 1.16  # twice the power of light that sRGB's slope falls with


@dataclass(frozen=True, eq=False)
class Lesson:
    """One light of a sample: what is known, and all its light at each of `ALBEDOS`, [A, H, W]."""

    inputs: Inputs
    light: torch.Tensor

    def multiple(self) -> torch.Tensor:
        """R, light scattered more than once over the albedo's square, [A, H, W]."""
        albedo = torch.tensor(ALBEDOS).to(self.light)[:, None, None]
        return (self.light - albedo * self.inputs.single[0]) / albedo**2

    def weights(self) -> torch.Tensor:
        """Of square errors of R, such that they are about those of pictures in sRGB, [A, H, W]."""
        albedo = torch.tensor(ALBEDOS).to(self.light)[:, None, None]
        seen = self.inputs.transparency < 1.0 - _CLEAR
        near = F.avg_pool2d(self.light[None], 3, 1, 1, count_include_pad=False)[0]
        return seen * albedo**4 / (near.clamp(min=0.0) + FAINT) ** _CURVE


def make_lessons(sample: Sample) -> list[Lesson]:
    """The lights of a sample, marched and spread."""
    volume = sample.volume
    with stream(device_name(volume.device)):
        _, inputs = make_inputs(volume, sample.camera, sample.lights, ALBEDOS, orders_march(volume))
    return [Lesson(inputs.of(n), light) for n, light in enumerate(sample.light)]


def fit_orders(lessons: Sequence[Lesson], *, pixels: int = 1024, seed: int = 0) -> OrdersModel:
    """Fits the mix.

    Args:
        lessons: At least one.
        pixels: Of each lesson that are used, drawn at random.
        seed: Of these.
    """
    device, size = lessons[0].light.device, FEATURES * MIXES
    depths = torch.tensor([float(lesson.inputs.depth) for lesson in lessons], dtype=torch.float64)
    low, high = (float(torch.quantile(depths, share)) for share in (_RARE, 1.0 - _RARE))
    known = torch.tensor([low, max(high, low + _NARROWEST)], device=device)
    model = OrdersModel(torch.zeros(len(ALBEDOS), MIXES, FEATURES, device=device), known)
    left = torch.zeros(len(ALBEDOS), MIXES, FEATURES, MIXES, FEATURES, dtype=torch.float64, device=device)
    right = torch.zeros(len(ALBEDOS), MIXES, FEATURES, dtype=torch.float64, device=device)
    random = torch.Generator().manual_seed(seed)
    for lesson in lessons:
        features = lesson.inputs.features(0).flatten(2).double()
        chosen = torch.randperm(features.shape[2], generator=random)[:pixels].to(device)
        features = features[..., chosen]
        target, weights = (part.flatten(1)[:, chosen].double() for part in (lesson.multiple(), lesson.weights()))
        # All of a lesson's pixels have one mix: its square times that of the features is the whole's.
        mix = model.mixes(lesson.inputs)[0].double()
        weighed = features * weights[:, None]
        squares = weighed @ features.transpose(1, 2)
        left += (mix[:, None] * mix)[None, :, None, :, None] * squares[:, None, :, None, :]
        right += mix[None, :, None] * (weighed @ target[..., None])[:, None, :, 0]
    left, right = left.reshape(len(ALBEDOS), size, size), right.reshape(len(ALBEDOS), size)
    diagonal = left.diagonal(dim1=1, dim2=2)
    left += _RIDGE * torch.diag_embed(diagonal + 1e-3 * diagonal.mean(1, keepdim=True))
    weights = torch.linalg.solve(left, right).reshape(len(ALBEDOS), MIXES, FEATURES)
    return OrdersModel(weights.float(), known)


def learn(
    views: int,
    *,
    samples: int = 512,
    seed: int = 0,
    device: str = "cpu",
    report: Callable[[int], None] | None = None,
) -> OrdersModel:
    """Draws smoke, traces its light and fits the mix to it: what comes with wlm has learned from 2000.

    Args:
        views: How many, of four lights each.
        samples: Paths a pixel.
        seed: Of the views and their paths.
        device: "cpu" or "cuda:N".
        report: Called with the number of each view.
    """
    lessons = []
    for number in range(views):
        if report is not None:
            report(number)
        lessons += make_lessons(traced(draw_lesson(seed, number), samples=samples, seed=number, device=device))
    return fit_orders(lessons)


def psnr(light: torch.Tensor, reference: torch.Tensor) -> float:
    """Of pictures in sRGB with a peak of 1, dB."""
    error = (to_srgb(light) - to_srgb(reference)).double().square().mean()
    return -10.0 * math.log10(max(float(error), 1e-12))
