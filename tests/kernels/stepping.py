"""Small trainers on synthetic targets: the fused step as it is used, and all that a reference needs of it."""

from dataclasses import dataclass, field

import numpy as np
import torch
import warp as wp
from reference import temporal as reference

from benchmarks import plain
from wlm import interop
from wlm.lightmap.profile import Profile, TimeAxis, encode_time
from wlm.lightmap.tiles import TileCut
from wlm.lightmap.trainer import Targets, Trainer

TILE = 128


@dataclass(frozen=True)
class Case:
    """The settings and targets of a trainer.

    Attributes:
        hidden, gelu, samples: As in `Profile`.
        shape: Resolution and slices of F_uvt, columns and rows of the planes.
        periodic: A periodic axis of evenly spaced frames, or a clamped one from 0 to 1 in uneven steps.
        emphasis: See `wlm_kernels.lightmap.features.Batch`; the weights are random where it isn't 0.
        numbers: Of the tiles in their grid.
        texels: How many texels of each tile are valid.
        settings: Other fields of `Profile`.
    """

    hidden: int = 16
    gelu: str = "tanh"
    samples: int = 256
    shape: tuple[int, int, int, int] = (12, 3, 7, 4)
    periodic: bool = True
    emphasis: float = 0.0
    numbers: tuple[int, ...] = (4, 9)
    texels: tuple[int, ...] = (TILE * TILE, 700)
    settings: dict = field(default_factory=dict)

    def profile(self) -> Profile:
        """The settings; ten steps unless `settings` has others."""
        resolution, slices, columns, rows = self.shape
        return Profile(
            name="test",
            hidden=self.hidden,
            gelu=self.gelu,
            samples=self.samples,
            uvt_resolution=resolution,
            uvt_slices=slices,
            plane_columns=columns,
            plane_rows=rows,
            time_axis="frames" if self.periodic else "paper",
            **{"steps": 10} | self.settings,
        )

    def axis(self) -> TimeAxis:
        """Five times; the clamped axis also reads its features at exactly 0 and 1."""
        times = np.array([0.0, 3.0, 8.0, 13.0, 20.0])
        return TimeAxis(times, 24.0, "frames") if self.periodic else TimeAxis(times, None, "paper")

    def targets(self) -> Targets:
        """Random light on random masks; those of a tile depend on its number alone."""
        times = len(self.axis().times)
        colour, mask, scale, affine, weight = [], [], [], [], []
        for number, count in zip(self.numbers, self.texels, strict=True):
            random = np.random.default_rng(number)
            colour.append(random.uniform(0.2, 2.0, (times, TILE, TILE, 3)))
            chosen = np.zeros(TILE * TILE, bool)
            chosen[random.permutation(TILE * TILE)[:count]] = True
            mask.append(chosen.reshape(TILE, TILE))
            scale.append(random.uniform(0.5, 1.5, (times, 3)))
            affine.append([random.uniform(0.7, 1.0, 3), random.uniform(0.3, 0.6, 3)])
            weight.append(random.uniform(0.5, 2.0, (times, 3)))
        f32 = [np.array(values, np.float32) for values in (colour, scale, affine, weight)]
        settings = {name: getattr(self.profile(), name) for name in ("gamma", "metric_weight", "peak")}
        cut = TileCut(np.array(self.numbers), list(f32[0]), mask)
        result = Targets(cut, f32[1], f32[2], **settings)
        if self.emphasis != 0.0:
            result.weight, result.emphasis = f32[3], self.emphasis
        return result


def trainer(case: Case, device: str, seed: int = 3, spread: bool = True) -> Trainer:
    """A trainer; with `spread` its maps and networks are random, not the initial ones."""
    result = Trainer(case.profile(), case.axis(), case.targets(), seed, device)
    if spread:
        for key, values in _clear_values(result).items():
            result.views[key].copy_(torch.from_numpy(values))
        random = np.random.default_rng(8)
        for values in (result.hidden, result.output):
            noise = random.uniform(-0.3, 0.3, tuple(values.shape)).astype(np.float32)
            values += torch.from_numpy(noise).to(values.device)
    return result


def _clear_values(trainer: Trainer) -> dict[str, np.ndarray]:
    """Random maps near levels that can be stored, so that float32 and float64 round to the same level.

    A value half-way between two levels may be rounded either way, and one such value would be an error of a whole
    level against the reference. Some values are 0 or 1.
    """
    random = np.random.default_rng(7)
    result = {}
    for key, view in trainer.views.items():
        shape = tuple(view.shape)
        levels = 15 if key.endswith("weights") else 255
        base = random.integers(0, levels + 1, shape)
        if key.endswith("endpoints"):
            base = base // 2 * 2 + random.integers(0, 2, (*shape[:-1], 1))  # one lowest bit for four channels
        result[key] = ((base + random.uniform(-0.3, 0.3, shape)) / levels).clip(0.0, 1.0).astype(np.float32)
    return result


def draw(trainer: Trainer, quantised: bool) -> tuple[np.ndarray, np.ndarray]:
    """The samples of the coming step: places int [N, B, 3] as (y, x, time) and features float32 [N, B, 16]."""
    kernels, samples = trainer._kernels, trainer._samples
    shape = (trainer.tiles, samples)
    with interop.stream(trainer.device):
        trainer.batch.quantised = int(quantised)
        trainer._round()
        place = wp.zeros(shape, dtype=wp.vec3i, device=trainer.device)
        features = wp.zeros(shape, dtype=kernels.net.vec_in, device=trainer.device)
        inputs, outputs = [trainer._maps[quantised], trainer.batch, samples], [place, features]
        wp.launch(kernels.draw, shape, inputs=inputs, outputs=outputs, device=trainer.device)
    return place.numpy(), features.numpy()


def drawn_noise(trainer: Trainer, quantised: bool) -> np.ndarray:
    """The noise of the coming step, centred as the features are: the features where all maps are 1/2."""
    maps = trainer.maps.clone()
    trainer.maps.fill_(0.5)
    noise = draw(trainer, False)[1]
    trainer.maps.copy_(maps)
    noise[..., 12:] = 0.0  # the encoded time, which has none
    return np.zeros_like(noise) if quantised else noise


@dataclass
class Step:
    """One step's loss [N] and gradients, by the name of the parameter."""

    loss: np.ndarray
    grads: dict[str, np.ndarray]


def fused_step(trainer: Trainer, quantised: bool) -> Step:
    """Does one step; its gradients are the sums that its second half takes."""
    before = trainer.losses().astype(np.float64)
    with interop.stream(trainer.device):
        trainer._round()
        trainer._add_gradients(int(quantised))
        sums = (trainer._acc, trainer._partial, trainer._partial_out)
        flat, hidden, output = (values.sum(0).cpu().numpy() for values in sums)
        trainer._update(int(quantised))
    flat = flat if trainer.device == "cpu" else (flat * 2.0**-40).astype(np.float32)
    grads, at = {}, 0
    for key, view in trainer.views.items():
        grads[key] = flat[at : at + view.numel()].reshape(tuple(view.shape)).copy()
        at += view.numel()
    grads |= {"hidden": hidden, "output": output}
    # A running mean that takes a fiftieth of each step.
    return Step((trainer.losses() - before) * 50.0 + before, grads)


@dataclass
class Problem:
    """A step's samples and parameters in float64, taken before the step."""

    maps: dict[str, torch.Tensor]
    hidden: torch.Tensor
    output: torch.Tensor
    place: torch.Tensor  # [N, B, 3]
    noise: torch.Tensor  # [N, B, 16]
    tau: torch.Tensor  # [N, B]
    encoding: torch.Tensor  # [N, B, 4]
    target: torch.Tensor  # [N, B, 3]
    weight: torch.Tensor  # [N, B, 3]
    quantised: bool
    periodic: bool
    gelu: str

    @property
    def tile(self) -> torch.Tensor:
        """The tile of each sample, [N * B]."""
        return torch.arange(len(self.place)).repeat_interleave(self.place.shape[1])

    def features(self) -> torch.Tensor:
        """The network's inputs, centred and with the noise, [N, B, 16]."""
        flat = self.place.reshape(-1, 3)
        coded = (self.tau.flatten(), self.encoding.reshape(-1, 4), self.periodic, self.quantised)
        features = reference.train_features(self.maps, self.tile, flat[:, :2], *coded)
        return reference.centre(features).reshape(self.noise.shape) + self.noise

    def losses(self) -> torch.Tensor:
        """Each tile's loss."""
        answer = plain.mlp(self.features(), self.hidden, self.output, gelu=self.gelu)
        return reference.losses(answer, self.target, self.weight)

    def step(self) -> Step:
        """The loss and all gradients, by autograd."""
        loss = self.losses()
        loss.sum().backward()
        named = self.maps | {"hidden": self.hidden, "output": self.output}
        return Step(loss.detach().numpy(), {key: value.grad.numpy() for key, value in named.items()})


def tolerance(trainer: Trainer) -> float:
    """What a fused step may differ by, of the largest number of an array.

    float32 gives 1e-6. On a GPU's matrix units operands are half floats, which gives 1e-3.
    """
    return 2e-5 if trainer.device == "cpu" else 5e-3


def problem(trainer: Trainer, case: Case, quantised: bool) -> Problem:
    """The coming step of a trainer as a `Problem`."""
    place, features = draw(trainer, quantised)
    place = torch.from_numpy(place).long()
    targets = case.targets()
    tau, encoding = (torch.from_numpy(values).double() for values in encode_time(trainer.axis))
    k = place[..., 2]
    n = torch.arange(trainer.tiles)[:, None]
    shift, spread = (torch.from_numpy(v).double()[:, None] for v in (targets.shift, targets.spread))
    target = torch.from_numpy(targets.colour).double()[n, k, place[..., 0] * TILE + place[..., 1]]
    weight = torch.from_numpy(targets.weight).double()[n, k]

    def leaf(values: torch.Tensor) -> torch.Tensor:
        return values.detach().cpu().double().clone().requires_grad_()

    return Problem(
        maps={key: leaf(view) for key, view in trainer.views.items()},
        hidden=leaf(trainer.hidden),
        output=leaf(trainer.output),
        place=place,
        noise=torch.from_numpy(drawn_noise(trainer, quantised)).double(),
        tau=tau[k],
        encoding=encoding[k],
        target=target,
        weight=reference.emphasised(weight, shift, spread, target, targets.emphasis),
        quantised=quantised,
        periodic=case.periodic,
        gelu=case.gelu,
    )
