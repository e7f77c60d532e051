"""Training steps, and the order in which they use the samples (neural-six-way-lightmaps, section 4.4)."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from wlm.formats.parts import Part, check_part, check_parts
from wlm.interop import StepGraph
from wlm.smoke.network.losses import losses
from wlm.smoke.network.planes import GUIDES, OPACITY_PLANE, PLANES, VISIBLE, Pool
from wlm.smoke.network.settings import NetworkSettings, TrainSettings
from wlm.smoke.network.unet import SixWayNetwork

_BLOCK = 16  # edge in pixels of the blocks that crops search for smoke
_MIRRORED = {"right": "left", "left": "right"}  # planes that a mirror exchanges


class Trainer:
    """A network in training, on the device, with its Adam optimiser and the number of steps done, including those whose
    update was skipped. `average` has the running mean of the weights; it is validated and saved."""

    def __init__(self, network: NetworkSettings, settings: TrainSettings, *, seed: int, device: str) -> None:
        """Makes an untrained network; a seed gives the same initial weights on all devices."""
        self.settings, self.device, self.step = settings, device, 0
        self._cuda = device != "cpu"
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            untrained = SixWayNetwork(network)
        layout = torch.channels_last if self._cuda else torch.contiguous_format
        self.network = untrained.to(device, memory_format=layout)
        self.average = copy.deepcopy(self.network).requires_grad_(False).eval()
        self._weights = list(self.network.parameters())
        self._means = list(self.average.parameters())
        rate = torch.zeros((), device=device)
        self._adam = torch.optim.Adam(self._weights, lr=rate, fused=True, capturable=self._cuda)
        self._rate = self._adam.param_groups[0]["lr"]
        # Fused Adam skips its update where this is 1.
        self._adam.found_inf = torch.zeros((), device=device)
        self._blend = torch.zeros((), device=device)
        self._sums = torch.zeros(1 + len(settings.losses), device=device)
        self._skipped = torch.zeros((), device=device)
        # On the device: indexing by them then does not wait for the host.
        self._swap = _mirrored(PLANES, device)
        self._guide_swap = _mirrored(GUIDES[network.guide], device)
        self._sign = torch.tensor((-1.0, 1.0), device=device)[:, None, None]
        self._batch: tuple[torch.Tensor, ...] | None = None
        self._run = StepGraph(self._work, device)

    @property
    def skipped(self) -> int:
        """Number of steps without an update because their gradient was not finite; reading it waits for the GPU."""
        return int(self._skipped)

    def take_losses(self) -> list[float]:
        """Returns the sums of the loss and of its parts over the steps since `clear_losses`; waits for the GPU."""
        return self._sums.tolist()

    def clear_losses(self) -> None:
        """Resets the sums of the losses to 0."""
        self._sums.zero_()

    def run(self, pool: Pool, plan: Plan) -> None:
        """Runs the training steps of a plan. `pool` has the samples, on any device. `plan` is a part of the result of
        `plan_round`: the samples of each step."""
        # Deterministic kernels, so that a seed gives one result.
        flags = {"enabled": True, "benchmark": False, "deterministic": True, "allow_tf32": self.settings.half}
        with torch.backends.cudnn.flags(**flags):
            for i in range(len(plan.samples)):
                batch = self._gather(pool, plan, i)
                if self._batch is None:
                    self._batch = tuple(part.clone() for part in batch)
                for buffer, part in zip(self._batch, batch, strict=True):
                    buffer.copy_(part)
                self._rate.fill_(self.settings.rate_at(self.step))
                # At first the mean is over few steps, so that it forgets the initial weights.
                decay = min(self.settings.average, (1 + self.step) / (10 + self.step))
                self._blend.fill_(1 - decay)
                self._run()
                self.step += 1

    def _gather(self, pool: Pool, plan: Plan, i: int) -> tuple[torch.Tensor, ...]:
        """Returns step i's batch, float32: guides [N, K, C, H, W], targets [N, K, 8, H, W] and motion [N, 2, H, W]."""
        samples, flips = plan.samples[i], plan.flips[i].to(self.device)
        frames = [slice(None)] * len(samples)
        if not self.settings.temporal:
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
        # A mirror exchanges the planes of opposite lights and negates the motion's x, which is exact.
        flip = flips[:, None, None, None]
        guides = torch.where(flip[..., None], guides[:, :, self._guide_swap].flip(-1), guides)
        targets = torch.where(flip[..., None], targets[:, :, self._swap].flip(-1), targets)
        return guides, targets, torch.where(flip, self._sign * motion.flip(-1), motion)

    def _work(self) -> None:
        guides, targets, motion = self._batch
        for weight in self._weights:
            weight.grad = None
        with torch.autocast(self.device.split(":")[0], torch.bfloat16, enabled=self._cuda and self.settings.half):
            planes = self.network(guides.flatten(0, 1))
            parts = losses(planes.unflatten(0, guides.shape[:2]), targets, motion, self.settings.temporal)
        parts["loss"].backward()
        with torch.no_grad():
            norms = torch.stack(torch._foreach_norm([weight.grad for weight in self._weights]))
            # NaN and infinity survive a sum.
            finite = torch.isfinite(norms.sum() + parts["loss"])
            self._adam.found_inf.copy_(~finite)
            self._adam.step()
            change = torch._foreach_sub(self._weights, self._means)
            torch._foreach_mul_(change, self._blend)
            torch._foreach_add_(self._means, change)
            values = torch.stack([part.detach() for part in parts.values()])
            self._sums.add_(torch.where(finite, values, torch.zeros_like(values)))
            self._skipped.add_(~finite)

    def state(self) -> dict[str, np.ndarray]:
        """Returns everything that the next step depends on, as arrays by name, for a checkpoint."""
        tensors = {"step": torch.tensor(self.step), "sums": self._sums, "skipped": self._skipped}
        for kind, network in (("network", self.network), ("average", self.average)):
            tensors |= {f"{kind}.{name}": value for name, value in network.state_dict().items()}
        for name, weight in self.network.named_parameters():
            tensors |= {f"adam.{key}.{name}": value for key, value in self._adam.state[weight].items()}
        # Copied: on the CPU a tensor's array shares the tensor's memory.
        return {name: np.array(value.detach().cpu().numpy(), order="C") for name, value in tensors.items()}

    def table(self, step: int) -> dict[str, Part]:
        """Returns the expected type, shape and range of each array of `state` after `step` steps."""
        table = {
            "step": Part(np.int64, (), least=step, most=step),
            "sums": Part(np.float32, tuple(self._sums.shape)),
            "skipped": Part(np.float32, (), least=0, most=step),
        }
        for kind, network in (("network", self.network), ("average", self.average)):
            table |= {f"{kind}.{name}": Part(np.float32, tuple(v.shape)) for name, v in network.state_dict().items()}
        for name, weight in self.network.named_parameters() if step else ():
            shape = tuple(weight.shape)
            table |= {
                f"adam.step.{name}": Part(np.float32, (), least=0, most=step),
                f"adam.exp_avg.{name}": Part(np.float32, shape),
                f"adam.exp_avg_sq.{name}": Part(np.float32, shape, least=0.0),
            }
        return table

    @torch.no_grad()
    def load(self, state: dict[str, np.ndarray]) -> None:
        """Restores what `state` returned. Raises a ValueError if an array is missing, has a wrong shape or is out of
        its range; the trainer is unchanged."""
        done = check_part(state, "step", Part(np.int64, (), least=0, most=self.settings.total))
        state = check_parts(state, self.table(int(done)))
        values = {name: torch.from_numpy(np.array(value)) for name, value in state.items()}
        self.step = int(done)
        self._sums.copy_(values["sums"])
        self._skipped.copy_(values["skipped"])
        for kind, network in (("network", self.network), ("average", self.average)):
            for name, value in network.state_dict().items():
                value.copy_(values[f"{kind}.{name}"])
        for name, weight in self.network.named_parameters() if self.step else ():
            moments = {"step": values[f"adam.step.{name}"].to(self.device)}
            # In the weight's memory layout.
            for key in ("exp_avg", "exp_avg_sq"):
                moments[key] = torch.empty_like(weight).copy_(values[f"adam.{key}.{name}"])
            self._adam.state[weight] = moments


def _mirrored(planes: tuple[str, ...], device: str) -> torch.Tensor:
    return torch.tensor([planes.index(_MIRRORED.get(name, name)) for name in planes], device=device)


@dataclass(frozen=True)
class Plan:
    """The samples that some training steps use: indices in a pool, int [steps, B], which of a sample's two frames is
    used, 0 or 1, ignored with a temporal loss; whether it is mirrored left to right; and `corners`, int [steps, B, 2],
    row and column of the top left pixel of the crop; None: whole images."""

    samples: torch.Tensor
    frames: torch.Tensor
    flips: torch.Tensor
    corners: torch.Tensor | None

    def part(self, begin: int, end: int) -> Plan:
        """Returns the plan of the steps from `begin` up to, but not including, `end`."""
        corners = None if self.corners is None else self.corners[begin:end]
        return Plan(self.samples[begin:end], self.frames[begin:end], self.flips[begin:end], corners)


def plan_round(settings: TrainSettings, pool: Pool, *, seed: int, round: int) -> Plan:
    """Draws the samples of all steps of a round in a random order of `seed` and `round`; each is used once before any
    is used again. Raises a ValueError if the samples are smaller than the crops."""
    count, size = len(pool), settings.batch // 2 if settings.temporal else settings.batch
    random = np.random.default_rng([seed, round])
    total = settings.steps * size
    order = np.concatenate([random.permutation(count) for _ in range(-(-total // count))])[:total]
    order = order.reshape(settings.steps, size)
    frames = random.integers(0, 2, (settings.steps, size))
    flips = random.random((settings.steps, size, 2))[..., 0] < 0.5
    corners = None
    if settings.crop is not None:
        image = np.array(pool.targets.shape[-2:])
        if (image < settings.crop).any():
            raise ValueError(f"crop: expected at most the samples' {min(image)} pixels, got {settings.crop}")
        draws = random.random((settings.steps, size, 3))
        corners = torch.from_numpy(_corners(pool, order, draws, image, settings.crop))
    return Plan(torch.from_numpy(order), torch.from_numpy(frames), torch.from_numpy(flips), corners)


def _corners(pool: Pool, samples: np.ndarray, draws: np.ndarray, image: np.ndarray, crop: int) -> np.ndarray:
    """Returns the corners, int [..., 2], of crops with smoke, chosen by random numbers `draws` [..., 3] in [0, 1)."""
    blocks = []
    for targets in pool.targets:
        opacity = targets[:, OPACITY_PLANE].amax(0, keepdim=True).float()
        smoke = F.max_pool2d(opacity[None], _BLOCK, ceil_mode=True)[0, 0] > VISIBLE
        # Without smoke any block is used.
        blocks.append((smoke if smoke.any() else ~smoke).nonzero().cpu().numpy())
    first = np.cumsum([0, *map(len, blocks)])
    begin, end = first[samples], first[samples + 1]
    block = np.concatenate(blocks)[begin + np.floor(draws[..., 0] * (end - begin)).astype(np.int64)]
    offset = np.floor(draws[..., 1:] * (crop // _BLOCK)).astype(np.int64)
    # Inside the image, up to its last row and column.
    return np.clip(_BLOCK * (block - offset), 0, image - crop)
