"""One step of a network's training, and in which order steps take their samples (section 4.4)."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import BaseModel, ConfigDict, Field

from wlm.interop import StepGraph
from wlm.smoke.learn.losses import Losses, LossSettings
from wlm.smoke.model import NetworkSettings, SixWayNetwork
from wlm.smoke.planes import GUIDES, OPACITY_PLANE, PLANES, VISIBLE, Pool

__all__ = ["Plan", "TrainSettings", "Trainer", "plan_round"]

_GRID = 16  # pixels along the edge of the squares of which each has smoke or none

# Planes after a mirror across the vertical, then across the horizontal axis.
_MIRRORED = ({"right": "left", "left": "right"}, {"top": "bottom", "bottom": "top"})


class TrainSettings(BaseModel):
    """How a network is trained.

    Attributes:
        rounds: Pools in all.
        steps: In a round.
        batch: Frames in a step; with a temporal loss these are half as many pairs.
        rate: Adam's highest learning rate; the paper's is 1e-3.
        floor: Share of it at the end, on half a cosine.
        warmup: Steps over which it rises from 0.
        average: Decay of the running mean of the weights, which is what is validated and kept.
        mirror: Whether samples are turned over at random: left to right, and upside down too. With the light's planes
            exchanged, both are exact.
        half: Whether CUDA computes in bfloat16 where that is safe; the CPU always uses float32.
        graph: Whether CUDA replays a step from a graph.
        crop: Pixels along the edges of the part of a sample that a step learns from, which has some of its smoke; None:
            all of it.
        validate_every: Rounds from one validation to the next; the last is always validated.
        losses: Weights of the loss's parts.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    rounds: int = Field(20, ge=1)
    steps: int = Field(1000, ge=1)
    batch: int = Field(12, ge=2, multiple_of=2)
    rate: float = Field(1e-3, gt=0.0, le=1.0)
    floor: float = Field(0.01, ge=0.0, le=1.0)
    warmup: int = Field(100, ge=0)
    average: float = Field(0.999, ge=0.0, lt=1.0)
    mirror: Literal["none", "sides", "both"] = "sides"
    half: bool = True
    graph: bool = True
    crop: int | None = Field(None, ge=16, multiple_of=16)
    validate_every: int = Field(1, ge=1)
    losses: LossSettings = LossSettings()

    @property
    def total(self) -> int:
        """Steps in all."""
        return self.rounds * self.steps

    def rate_at(self, step: int) -> float:
        """The learning rate of a step, from 0."""
        rise = min(1.0, (step + 1) / (self.warmup + 1))
        return rise * self.rate * (self.floor + (1 - self.floor) * 0.5 * (1 + math.cos(math.pi * step / self.total)))


class Trainer:
    """A network under training: its weights, their running mean, and Adam.

    Attributes:
        network: What is trained, on the device.
        average: The running mean of its weights, what is validated and kept.
        losses: The loss.
        step: Steps done, those that were left out too.
    """

    def __init__(self, network: NetworkSettings, settings: TrainSettings, *, seed: int, device: str) -> None:
        """Begins anew; one seed gives one start on all devices.

        Raises:
            WlmError: A part of the loss needs a package that isn't installed.
        """
        self.settings, self.device, self.step = settings, device, 0
        self._cuda = device != "cpu"
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            made = SixWayNetwork(network)
        self.network = made.to(device, memory_format=torch.channels_last if self._cuda else torch.contiguous_format)
        self.average = copy.deepcopy(self.network).requires_grad_(False).eval()
        self.losses = Losses(settings.losses, emission=network.emission).to(device)
        self._weights = list(self.network.parameters())
        self._means = list(self.average.parameters())
        rate = torch.zeros((), device=device)
        self._adam = torch.optim.Adam(self._weights, lr=rate, fused=True, capturable=self._cuda)
        self._rate = self._adam.param_groups[0]["lr"]
        # Fused Adam leaves its weights alone where this is 1.
        self._adam.found_inf = torch.zeros((), device=device)
        self._blend = torch.zeros((), device=device)
        self._sums = torch.zeros(1 + len(settings.losses.parts), device=device)
        self._skipped = torch.zeros((), device=device)
        # In memory of the device, where an index costs no wait.
        self._swaps = _mirrored(PLANES, device)
        self._guide_swaps = _mirrored(GUIDES[network.guide], device)
        self._signs = [torch.tensor(sign, device=device)[:, None, None] for sign in ((-1.0, 1.0), (1.0, -1.0))]
        self._batch: tuple[torch.Tensor, ...] | None = None
        replayed = self._cuda and settings.graph
        self._run = StepGraph(self._work, device) if replayed else self._work

    @property
    def skipped(self) -> int:
        """Steps left out; waits for the device."""
        return int(self._skipped)

    def take_losses(self) -> list[float]:
        """Sums of the loss and its parts over the steps since the last `clear_losses`; waits for the device."""
        return self._sums.tolist()

    def clear_losses(self) -> None:
        """Begins new sums."""
        self._sums.zero_()

    def run(self, pool: Pool, plan: Plan) -> None:
        """Does steps.

        Args:
            pool: Where the samples are from, on any device.
            plan: Rows of `plan_round`, one a step.
        """
        # Where kernels could add in any order, those that don't: a seed gives one curve.
        flags = {"enabled": True, "benchmark": False, "deterministic": True, "allow_tf32": self.settings.half}
        with torch.backends.cudnn.flags(**flags):
            for i in range(len(plan.samples)):
                batch = self._gather(pool, plan, i)
                if self._batch is None:
                    self._batch = tuple(part.clone() for part in batch)
                for held, part in zip(self._batch, batch, strict=True):
                    held.copy_(part)
                self._rate.fill_(self.settings.rate_at(self.step))
                # A mean over few steps at first: it shall forget the start.
                decay = min(self.settings.average, (1 + self.step) / (10 + self.step))
                self._blend.fill_(1 - decay)
                self._run()
                self.step += 1

    def _gather(self, pool: Pool, plan: Plan, i: int) -> tuple[torch.Tensor, ...]:
        """The batch of a step: guides [N, K, C, H, W], targets [N, K, 8, H, W] and motion [N, 2, H, W], float32."""
        samples, turns = plan.samples[i], plan.turns[i].to(self.device)
        frames = [slice(None)] * len(samples)
        if not self.settings.losses.pairs:
            frames = [slice(frame, frame + 1) for frame in plan.frames[i].tolist()]
        windows = [(slice(None), slice(None))] * len(samples)
        if plan.corners is not None:
            size = self.settings.crop
            windows = [tuple(slice(at, at + size) for at in corner) for corner in plan.corners[i].tolist()]
        parts = [
            (pool.guides[n, k, :, y, x], pool.targets[n, k, :, y, x], pool.motion[n, :, y, x])
            for n, k, (y, x) in zip(samples.tolist(), frames, windows, strict=True)
        ]
        guides, targets, motion = (torch.stack(part).to(self.device).float() for part in zip(*parts, strict=True))
        # Left to right is the last axis, and turns a motion's x; up to down the one before it, and its y.
        ways = zip(turns.unbind(1), (-1, -2), self._swaps, self._guide_swaps, self._signs, strict=True)
        for turned, axis, swap, guide_swap, sign in ways:
            turned = turned[:, None, None, None]
            guides = torch.where(turned[..., None], guides[:, :, guide_swap].flip(axis), guides)
            targets = torch.where(turned[..., None], targets[:, :, swap].flip(axis), targets)
            motion = torch.where(turned, sign * motion.flip(axis), motion)
        return guides, targets, motion

    def _work(self) -> None:
        """One step on the batch that is held, with no wait for the device."""
        guides, targets, motion = self._batch
        for weight in self._weights:
            weight.grad = None
        with torch.autocast(self.device.split(":")[0], torch.bfloat16, enabled=self._cuda and self.settings.half):
            planes = self.network(guides.flatten(0, 1))
            parts = self.losses(planes.unflatten(0, guides.shape[:2]), targets, motion)
        parts["loss"].backward()
        with torch.no_grad():
            norms = torch.stack(torch._foreach_norm([weight.grad for weight in self._weights]))
            # What isn't finite stays so in a sum.
            fine = torch.isfinite(norms.sum() + parts["loss"])
            self._adam.found_inf.copy_(~fine)
            self._adam.step()
            moved = torch._foreach_sub(self._weights, self._means)
            torch._foreach_mul_(moved, self._blend)
            torch._foreach_add_(self._means, moved)
            found = torch.stack([part.detach() for part in parts.values()])
            self._sums.add_(torch.where(fine, found, torch.zeros_like(found)))
            self._skipped.add_(~fine)

    def state(self) -> dict[str, np.ndarray]:
        """All that the next step depends on."""
        found = {"step": torch.tensor(self.step), "sums": self._sums, "skipped": self._skipped}
        for kind, network in (("network", self.network), ("average", self.average)):
            found |= {f"{kind}.{name}": value for name, value in network.state_dict().items()}
        for name, weight in self.network.named_parameters():
            found |= {f"adam.{key}.{name}": value for key, value in self._adam.state[weight].items()}
        # Copies: on the CPU a tensor's array is the tensor's own memory.
        return {name: np.array(value.detach().cpu().numpy(), order="C") for name, value in found.items()}

    @torch.no_grad()
    def load(self, state: dict[str, np.ndarray]) -> None:
        """Goes on from a `state`.

        Raises:
            ValueError: A part is missing or has another shape.
        """
        values = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
        try:
            self.step = int(values["step"])
            self._sums.copy_(values["sums"])
            self._skipped.copy_(values["skipped"])
            for kind, network in (("network", self.network), ("average", self.average)):
                for name, value in network.state_dict().items():
                    value.copy_(values[f"{kind}.{name}"])
            for name, weight in self.network.named_parameters():
                keys = [key for key in ("step", "exp_avg", "exp_avg_sq") if f"adam.{key}.{name}" in values]
                self._adam.state[weight] = {key: values[f"adam.{key}.{name}"].to(self.device) for key in keys}
                for key in keys[1:]:
                    held = torch.empty_like(weight)  # in the order of the weight's memory
                    self._adam.state[weight][key] = held.copy_(self._adam.state[weight][key])
        except (KeyError, RuntimeError) as error:
            raise ValueError(f"the state is of another network: {error}") from error


def _mirrored(planes: tuple[str, ...], device: str) -> list[torch.Tensor]:
    """Where planes are found after each of the mirrors."""
    return [torch.tensor([planes.index(way.get(n, n)) for n in planes], device=device) for way in _MIRRORED]


@dataclass(frozen=True)
class Plan:
    """What steps learn from, a row each.

    Attributes:
        samples: int [steps, B], of the pool.
        frames: int [steps, B], which of their two, where a step learns from single frames.
        turns: bool [steps, B, 2], which ways they are turned over.
        corners: int [steps, B, 2], row and column at which the part that is learned from begins; None: all is.
    """

    samples: torch.Tensor
    frames: torch.Tensor
    turns: torch.Tensor
    corners: torch.Tensor | None

    def part(self, begin: int, end: int) -> Plan:
        """Some of the steps."""
        corners = None if self.corners is None else self.corners[begin:end]
        return Plan(self.samples[begin:end], self.frames[begin:end], self.turns[begin:end], corners)


def plan_round(settings: TrainSettings, pool: Pool, *, seed: int, round: int) -> Plan:
    """Which samples the steps of a round take: all once before any twice, in an order of its own.

    Args:
        settings: Of the training.
        pool: The samples.
        seed, round: What the order follows from.

    Raises:
        ValueError: The samples are smaller than the parts that are to be taken from them.
    """
    count, size = len(pool), settings.batch // 2 if settings.losses.pairs else settings.batch
    random = np.random.default_rng([seed, round])
    wanted = settings.steps * size
    order = np.concatenate([random.permutation(count) for _ in range(-(-wanted // count))])[:wanted]
    order = order.reshape(settings.steps, size)
    frames = random.integers(0, 2, (settings.steps, size))
    turns = random.random((settings.steps, size, 2)) < 0.5
    turns &= np.array([settings.mirror != "none", settings.mirror == "both"])
    corners = None
    if settings.crop is not None:
        whole = np.array(pool.targets.shape[-2:])
        if (whole < settings.crop).any():
            raise ValueError(f"crop: expected at most {min(whole)} pixels, which the samples have, got {settings.crop}")
        share = random.random((settings.steps, size, 3))
        corners = torch.from_numpy(_Smoke(pool).corners(order, share, whole, settings.crop))
    return Plan(torch.from_numpy(order), torch.from_numpy(frames), torch.from_numpy(turns), corners)


class _Smoke:
    """Squares of `_GRID` pixels that have smoke, of each of a pool's samples.

    Attributes:
        first: int [N + 1], where each sample's begin in `places`.
        places: int [M, 2], their rows and columns, in squares.
    """

    def __init__(self, pool: Pool) -> None:
        found = []
        for targets in pool.targets:
            seen = targets[:, OPACITY_PLANE].amax(0, keepdim=True).float()
            there = F.max_pool2d(seen[None], _GRID, ceil_mode=True)[0, 0] > VISIBLE
            # Where there is none, all are alike.
            found.append((there if there.any() else ~there).nonzero().cpu().numpy())
        self.first = np.cumsum([0, *map(len, found)])
        self.places = np.concatenate(found)

    def corners(self, samples: np.ndarray, share: np.ndarray, size: np.ndarray, crop: int) -> np.ndarray:
        """Corners int [..., 2] of parts with one of the squares each, every square as likely as another.

        Args:
            samples: int [...].
            share: [..., 3], random numbers within 0 and 1: which square, and where in the part it is.
            size: [2], of the samples.
            crop: Of the parts.
        """
        begin, end = self.first[samples], self.first[samples + 1]
        square = self.places[begin + np.floor(share[..., 0] * (end - begin)).astype(np.int64)]
        within = np.floor(share[..., 1:] * (crop // _GRID)).astype(np.int64)
        # Within the sample, up to its very end.
        return np.clip(_GRID * (square - within), 0, size - crop)
