"""Fits the filter and trains the network of `filtering` to path-traced light: least squares, then steps of AdamW.

References may be noisy, as long as they have no bias: both parts minimise a square error, whose minimum is the mean.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from wlm.smoke.planes import to_srgb
from wlm.smoke.transport.features import FEATURES, Inputs, ambient, blur, make_inputs, orders_march
from wlm.smoke.transport.filtering import (
    CONDITIONS,
    HIDDEN,
    MIXES,
    OrdersModel,
    all_light,
    mixes,
)
from wlm.smoke.transport.gating import FAINT, FIT, GAINS, facts, fit_gate
from wlm.smoke.transport.lighting import light_smoke
from wlm.smoke.transport.samples import ALBEDOS, Sample

_RIDGE = 1e-5
_RARE, _NARROWEST = 0.02, 0.1  # share of depths at either end that aren't known, and the least range
_CLEAR = 1e-3  # opacity below which there is nothing to be learned: light is bounded by it
_CURVE = 1.16  # twice the power of light that sRGB's slope falls with
_DECAY = 0.02  # of weights


@dataclass(frozen=True, eq=False)
class Lesson:
    """One light of a sample: what is known, and all its light at each of `ALBEDOS`, [A, H, W]."""

    inputs: Inputs
    light: torch.Tensor

    def multiple(self) -> torch.Tensor:
        """R, light scattered more than once over the albedo's square, [A, H, W]."""
        albedo = torch.tensor(ALBEDOS).to(self.light)[:, None, None]
        return (self.light - albedo * self.inputs.single) / albedo**2

    def weights(self) -> torch.Tensor:
        """Of square errors of R, such that they are about those of pictures in sRGB, [A, H, W]."""
        albedo = torch.tensor(ALBEDOS).to(self.light)[:, None, None]
        seen = self.inputs.opacity > _CLEAR
        return seen * albedo**4 / (blur(self.light, 1.0).clamp(min=0.0) + FAINT) ** _CURVE


def make_lessons(sample: Sample) -> list[Lesson]:
    """The lights of a sample, marched."""
    lit = light_smoke(sample.volume, sample.camera, sample.lights, orders_march(sample.volume))
    made = make_inputs(sample.volume, lit, ambient(sample.volume, sample.camera))
    return [Lesson(inputs, light) for inputs, light in zip(made, sample.light, strict=True)]


def fit_filter(lessons: Sequence[Lesson], *, pixels: int = 1024, seed: int = 0) -> OrdersModel:
    """The filter, with a network that adds nothing.

    Args:
        lessons: At least one.
        pixels: Of each lesson that are used, drawn at random.
        seed: Of these, and of the network's first weights.
    """
    device = lessons[0].light.device
    size, nodes = FEATURES * MIXES, range(len(ALBEDOS))
    depths = torch.tensor([float(lesson.inputs.depth) for lesson in lessons], dtype=torch.float64)
    low, high = (float(torch.quantile(depths, share)) for share in (_RARE, 1.0 - _RARE))
    known = torch.tensor([low, max(high, low + _NARROWEST)], device=device)
    left = torch.zeros(len(ALBEDOS), MIXES, FEATURES, MIXES, FEATURES, dtype=torch.float64, device=device)
    right = torch.zeros(len(ALBEDOS), MIXES, FEATURES, dtype=torch.float64, device=device)
    random = torch.Generator().manual_seed(seed)
    moments = torch.zeros(2, FEATURES, dtype=torch.float64, device=device)
    for lesson in lessons:
        features = lesson.inputs.features.flatten(1).double()
        chosen = torch.randperm(features.shape[1], generator=random)[:pixels].to(device)
        features = features[:, chosen]
        moments += torch.stack([features.mean(1), features.square().mean(1)]) / len(lessons)
        target, weights = (part.flatten(1)[:, chosen].double() for part in (lesson.multiple(), lesson.weights()))
        # All of a lesson's pixels have one mix: its square times that of the features is the whole's.
        mix = mixes(lesson.inputs, known).double()
        squares = torch.stack([(features * weights[node]) @ features.T for node in nodes])
        left += (mix[:, None] * mix)[None, :, None, :, None] * squares[:, None, :, None, :]
        right += mix[None, :, None] * ((weights * target) @ features.T)[:, None]
    left, right = left.reshape(len(ALBEDOS), size, size), right.reshape(len(ALBEDOS), size)
    diagonal = left.diagonal(dim1=1, dim2=2)
    left += _RIDGE * torch.diag_embed(diagonal + 1e-3 * diagonal.mean(1, keepdim=True))
    spread = (moments[1] - moments[0].square()).clamp(min=1e-8).sqrt()
    first, second = (torch.randn(HIDDEN, n, generator=random) / math.sqrt(n) for n in (FEATURES + CONDITIONS, HIDDEN))
    arrays = {
        "weights": torch.linalg.solve(left, right),
        "mean": moments[0],
        "spread": spread,
        **{name: torch.ones(shape) for name, shape in FIT.items()},
        "range": known,
        "first": first,
        "first_bias": torch.zeros(HIDDEN),
        "second": second,
        "second_bias": torch.zeros(HIDDEN),
        "last": torch.zeros(HIDDEN),
    }
    return OrdersModel({name: array.float().to(device) for name, array in arrays.items()})


def train_network(
    model: OrdersModel,
    lessons: Sequence[Lesson],
    held_out: Sequence[Lesson],
    *,
    steps: int = 2000,
    pixels: int = 2048,
    rate: float = 3e-3,
    seed: int = 0,
    report: Callable[[int, float], None] | None = None,
) -> OrdersModel:
    """Trains the network of a fitted model, and fits its gate on lessons that it hasn't learned from.

    Args:
        model: Of `fit_filter`.
        lessons: At least one.
        held_out: For the gate, of other smoke; at least one.
        steps: Each of one lesson.
        pixels: Of the lesson in a step.
        rate: The largest step size, which falls to 0.
        seed: Of the order.
        report: Called with the step and its error every hundred steps.
    """
    names = ("first", "first_bias", "second", "second_bias", "last")
    trained = {name: model.arrays[name].clone().requires_grad_() for name in names}
    network = OrdersModel(model.arrays | trained)
    optimiser = torch.optim.AdamW(trained.values(), lr=rate, weight_decay=_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=max(steps, 1))
    random = torch.Generator().manual_seed(seed)
    error = 0.0
    for step in range(steps):
        lesson = lessons[int(torch.randint(len(lessons), (1,), generator=random))]
        node = int(torch.randint(len(ALBEDOS), (1,), generator=random))
        features = lesson.inputs.features.flatten(1)
        chosen = torch.randperm(features.shape[1], generator=random)[:pixels].to(features.device)
        part = Inputs(
            lesson.inputs.single.flatten()[chosen, None],
            features[:, chosen, None],
            lesson.inputs.opacity.flatten()[chosen, None],
            lesson.inputs.cosine,
            lesson.inputs.depth,
        )
        filtered = network.filtered(part, [node])
        target, weights = (p[node].flatten()[chosen].reshape(1, -1, 1) for p in (lesson.multiple(), lesson.weights()))
        off = filtered + network.correction(part, filtered, [node]) - target
        loss = (weights * off.square()).mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained.values(), 1.0)
        optimiser.step()
        schedule.step()
        error = 0.99 * error + 0.01 * float(loss.detach()) if step else float(loss.detach())
        if report is not None and step % 100 == 0:
            report(step, error)
    final = {name: array.detach() for name, array in trained.items()}
    return with_gate(OrdersModel(model.arrays | final), held_out)


def with_gate(model: OrdersModel, held_out: Sequence[Lesson]) -> OrdersModel:
    """The model with the gate that `gating.fit_gate` finds on lessons; a lesson's own noise is a part of each error."""
    told, gains = [], []
    for lesson in held_out:
        filtered = model.filtered(lesson.inputs)
        correction = model.correction(lesson.inputs, filtered, range(len(ALBEDOS)))
        told.append(facts(lesson.inputs, filtered, correction, ALBEDOS))
        for node, albedo in enumerate(ALBEDOS):
            found = []
            for share in GAINS:
                more = (filtered[node] + share * correction[node]).clamp(min=0.0)
                found.append(psnr(all_light(lesson.inputs, albedo, more), lesson.light[node]))
            gains.append([each - found[0] for each in found])
    told = torch.cat(told)
    return OrdersModel(model.arrays | fit_gate(told, torch.tensor(gains, device=told.device)))


def psnr(light: torch.Tensor, reference: torch.Tensor) -> float:
    """Of pictures in sRGB with a peak of 1, dB."""
    error = (to_srgb(light) - to_srgb(reference)).double().square().mean()
    return -10.0 * math.log10(max(float(error), 1e-12))
