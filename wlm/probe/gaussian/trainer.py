"""Trains Gaussians and a network on a device (gaussian-probe-compression, sections 3.2 and 3.3)."""

import math
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree

from wlm import interop
from wlm.errors import WlmError
from wlm.formats.parts import Part, all_finite, check_part, check_parts
from wlm.probe.gaussian.model import (
    CENTRE,
    CUT,
    LATENT,
    ROTATION,
    SCALE,
    Gaussians,
    gaussian_count,
    layer_shapes,
    split_layers,
)
from wlm.probe.gaussian.pictures import PictureLoss, Pixels
from wlm.probe.model import Profile
from wlm.probe.morton import morton_order
from wlm.probe.relative import magnitudes, with_magnitude
from wlm_kernels.probe import network as probe_network
from wlm_kernels.probe import step as probe_step
from wlm_kernels.probe.gaussians import SHAPE_NUMBERS, Shape
from wlm_kernels.probe.network import CPU_LANES
from wlm_kernels.probe.step import GROUP, Optimiser

CODE_BITS, CENTRE_BITS = 10, 16
"""Bits of a code in training: of scales, rotations and latents, and of centres."""

FINAL_RATE = 1e-3
"""Final learning rate as a share of the initial one; it falls along half a cosine."""

_QUANTISE_FROM, _FREEZE_FROM = 5 / 6, 11 / 12  # share of the steps at which the second and the third stage begin
_PICTURES_FROM = 1 / 2  # share of the steps from which on the error of pictures is minimised too
_FIRST_LATENT = 0.1  # standard deviation of the first latents
_PRUNE = 1e-4  # largest change by dropped Gaussians, as a share of the range of the decoded numbers
_STATE = ("rows", "net", "moments", "net_moments", "bounds", "control", "loss")
_NEIGHBOURS = 9  # probes over which the local spread of a probe is taken, itself included
_PIECE = 4096  # probes per piece
_ROUNDS = 4  # rounds of k-means if centres are denser where light varies; more rounds would undo that
_PLAIN_ROUNDS = 20  # rounds of k-means if the initial centres are drawn uniformly
_FLOOR = 0.05  # smallest local spread, as a share of the mean
_SMALLEST = 1e-4  # smallest first scale, as a share of the box
_BOX_MARGIN = 1e-6  # of the unit cube, so that rounding does not lose a probe at the edge of its group's box


class Trainer:
    """A running fit of Gaussians and a network.

    A step runs over all probes (eq. 8); for a relative error, the loss is of the numbers of `with_magnitude`, one more
    than a probe has. There are three stages: first the Gaussians are trained freely; then their numbers are rounded to
    codes in each step (section 3.3); then the Gaussians are fixed, and only the network is trained. With pixels of
    pictures, half of the loss is their error in the second half of the steps.

    Attributes:
        device: "cpu" or "cuda:N".
        relative: Whether the error is relative.
        steps: Number of steps of the whole fit.
        count: K, number of Gaussians.
        needed: bool [K], false where a Gaussian is dropped; all true before the last stage.
        dropped_change: Largest change of a number of a probe that results from dropping Gaussians.
        peers: Other fits of as many steps, which take their steps with this one; on CUDA they overlap.
    """

    def __init__(
        self,
        x: np.ndarray,
        values: np.ndarray,
        profile: Profile,
        seed: int,
        device: str,
        hours: int = 1,
        pixels: Pixels | None = None,
    ) -> None:
        """Starts a fit.

        Args:
            x: float32 [N, 3], positions of the live probes relative to their box, in [0, 1].
            values: float32 [N, T D], the numbers of these probes at T hours.
            profile: The settings.
            seed: Seed of the fit; the same seed gives the same result on one device.
            device: "cpu" or "cuda:N".
            hours: T.
            pixels: Pixels whose error is minimised, too; None: only that of the probes is.
        """
        light = values
        self.device, self._cuda = device, device != "cpu"
        self.steps, self._name, self._support = profile.steps, profile.name, profile.support
        self._hours = hours
        self.relative, self._gain = profile.error == "relative", float(magnitudes(values, hours).max())
        if self.relative:
            values = with_magnitude(values, hours)
        self._probes, self._outputs = values.shape
        self._latent, self._hidden = profile.latent, profile.hidden
        self._layers = layer_shapes(self._latent, self._hidden, probe_network.padded(self._outputs))
        kind = "cuda" if self._cuda else "cpu"
        self._step_kernels = probe_step.step_kernels(self._latent, kind)
        self._network = probe_network.network_kernels(self._latent, self._hidden, self._outputs, kind)
        order = morton_order(x)
        x, values = x[order], values[order]
        self._upload(x, values)
        self._pictures = None
        if pixels is not None:
            self._pictures = PictureLoss(pixels.of(order), light[order], self.relative, hours, self._unit, device)
        self._allocate(*_first_numbers(x, values, profile, np.random.default_rng(seed)))
        rates = np.empty(LATENT.start + self._latent)
        rates[CENTRE], rates[SCALE], rates[ROTATION] = profile.centre_rate, profile.scale_rate, profile.rotation_rate
        rates[LATENT] = profile.latent_rate
        share = np.linspace(0.0, 1.0, self.steps)
        self._optimiser = Optimiser()
        self._optimiser.control = self._arrays["control"]
        self._optimiser.schedule = self._put(FINAL_RATE + (1 - FINAL_RATE) * 0.5 * (1 + np.cos(np.pi * share)), float)
        self._optimiser.rates = self._put(rates, float)
        self._optimiser.net_rate = profile.net_rate
        self._optimiser.bounds = self._arrays["bounds"]
        self._optimiser.adan = int(profile.optimiser == "adan")
        self.needed = np.ones(self.count, bool)
        self.dropped_change = 0.0
        self.peers: list[Trainer] = []
        self._pool = None if self._cuda else ThreadPoolExecutor(CPU_LANES)
        stages = [partial(self._step_all, stage, pictured) for pictured in (False, True) for stage in range(3)]
        self._stages = [interop.StepGraph(step, device, warmup=1) for step in stages]
        self._entered = 0
        # Loaded before two threads launch kernels, since two threads must not load a module at once.
        self._step_kernels.load(device)
        self._network.load(device)

    def _upload(self, x: np.ndarray, values: np.ndarray) -> None:
        n, d = values.shape
        padded = -(-n // GROUP) * GROUP
        boxes = np.concatenate([x, np.repeat(x[-1:], padded - n, 0)]).astype(np.float32)
        groups = boxes.reshape(-1, GROUP, 3)
        low, high = groups.min(1), groups.max(1)
        self._groups = probe_step.Groups()
        self._groups.x = self._put(boxes, wp.vec3)
        self._groups.middle = self._put((low + high) / 2, wp.vec3)
        self._groups.half = self._put((high - low) / 2 + _BOX_MARGIN, wp.vec3)
        self._groups.count = n
        exact = values.astype(np.float64)
        self.mean, self.spread = exact.mean(0), exact.std(0)
        spread = self.spread
        target = np.zeros((d, padded), np.float32)
        # A channel that never changes equals its mean, and the network's output for it has no effect.
        target[:, :n] = np.divide(exact - self.mean, spread, out=np.zeros_like(exact), where=spread > 0).T
        self._target = self._put(target, float)
        # Squared errors are measured in units of the largest variance of a channel.
        self._unit = float(max(spread.max() ** 2, np.finfo(np.float64).tiny))
        self._weight = self._put(spread**2 / self._unit / (n * d), float)
        self._scaling = self._put(self.mean, float), self._put(spread, float)

    def _allocate(self, rows: np.ndarray, net: np.ndarray) -> None:
        count, channels = rows.shape
        padded = self._groups.x.shape[0]
        groups, parts = padded // GROUP, self._network.parts(padded)
        latent = self._latent

        def zeros(*shape: int) -> torch.Tensor:
            return torch.zeros(shape, device=self.device)

        self.count = count
        self._tensors = {
            "rows": torch.from_numpy(rows).to(self.device),
            "net": torch.from_numpy(net).to(self.device),
            "moments": zeros(4, count, channels),
            "net_moments": zeros(2, len(net)),
            "bounds": zeros(2, channels),
            "control": torch.zeros(1, dtype=torch.int32, device=self.device),
            "used": zeros(count, channels),
            "f": zeros(probe_step.SPLITS if self._cuda else 1, latent, padded),
            "grad_f": zeros(latent, padded),
            "sums": zeros(count * (probe_step.PARTS if self._cuda else 1), SHAPE_NUMBERS + latent),
            "partial": zeros(parts, len(net)),
            "loss": zeros(parts),
        }
        self._arrays = {key: interop.to_warp(value) for key, value in self._tensors.items()}
        self._shapes = wp.zeros(count, dtype=Shape, device=self.device)
        self._by_group = wp.zeros((groups, -(-count // 32)), dtype=wp.uint32, device=self.device)
        self._by_gaussian = wp.zeros((count, -(-groups // 32)), dtype=wp.uint32, device=self.device)
        self._codes = 2 ** np.array([CENTRE_BITS] * 3 + [CODE_BITS] * (7 + latent)) - 1
        self._levels = self._put(self._codes, float)

    def _put(self, values: np.ndarray, dtype) -> wp.array:
        return wp.array(np.ascontiguousarray(values, np.float32), dtype=dtype, device=self.device)

    @property
    def step(self) -> int:
        """The number of finished steps."""
        return int(self._tensors["control"].item())

    def stage(self, step: int) -> int:
        """Returns the stage of a step: 0 with free Gaussians, 1 with rounded ones, 2 with fixed ones."""
        return int(step >= round(_QUANTISE_FROM * self.steps)) + int(step >= round(_FREEZE_FROM * self.steps))

    def run(self, steps: int) -> None:
        """Runs the next steps; on CUDA they are queued, not awaited."""
        first = self.step
        with interop.stream(self.device):
            for step in range(first, first + steps):
                stage = self.stage(step)
                while self._entered < stage:
                    for each in (self, *self.peers):
                        each._enter(each._entered + 1)
                pictured = self._pictures is not None and step >= round(_PICTURES_FROM * self.steps)
                self._stages[stage + 3 * pictured]()

    def _enter(self, stage: int) -> None:
        """Starts stage 1 (sets the codes' range) or 2 (freezes the Gaussians; drops those that hardly matter)."""
        t = self._tensors
        if stage == 1:
            t["bounds"].copy_(torch.stack([t["rows"].amin(0), t["rows"].amax(0)]))
        else:
            self._make_shapes(quantised=True)
            self._prune()
        self._entered = stage

    def finish(self) -> None:
        """Starts the stages that a short fit did not reach, so that the Gaussians are rounded to codes."""
        with interop.stream(self.device):
            while self._entered < 2:
                self._enter(self._entered + 1)

    def _make_shapes(self, quantised: bool) -> None:
        a = self._arrays
        sphere, used = int(self._support == "sphere"), (a["used"], self._shapes)
        self._step_kernels.shapes(a["rows"], a["bounds"], int(quantised), self._levels, CUT, sphere, *used)
        probe_step.touch(self._groups, self._shapes, self._by_group, self._by_gaussian)

    def _step_all(self, stage: int, pictured: bool) -> None:
        interop.fork(self.device, [partial(each._step, stage, pictured) for each in (self, *self.peers)])

    def _step(self, stage: int, pictured: bool) -> None:
        a, t = self._arrays, self._tensors
        move = stage < 2
        t["control"].add_(1)
        if move:
            self._make_shapes(quantised=stage > 0)
            self._features()
        if not self._cuda:
            # The two threads on the CPU add to these arrays.
            t["partial"].zero_()
            t["loss"].zero_()
        if pictured:
            self._network_and_pictures()
        else:
            network = (self._groups, a["f"], self._target, self._weight, a["net"], a["grad_f"], a["partial"], a["loss"])
            self._share(self._groups.x.shape[0], lambda *lane: self._network.launch(*network, *lane))
        if move:
            self._collect()
        self._optimiser.keep, self._optimiser.move = int(stage > 0), int(move)
        moving = [a[name] for name in ("sums", "moments", "net", "net_moments", "partial")]
        self._step_kernels.update(self._optimiser, a["rows"], a["used"], self._shapes, *moving)

    def _network_and_pictures(self) -> None:
        """Computes the gradients of half the error of the probes and half that of the pictures."""
        t, n = self._tensors, self._probes
        f, net = (tensor.detach().requires_grad_() for tensor in (t["f"].sum(0)[:, :n], t["net"]))
        outputs = self._outputs_of(f, net)
        target, weight, mean, spread = (wp.to_torch(a) for a in (self._target, self._weight, *self._scaling))
        loss = (weight * (outputs - target[:, :n].T).square()).sum()
        total = 0.5 * (loss + self._pictures(mean + spread * outputs))
        grad_f, grad_net = torch.autograd.grad(total, (f, net))
        t["grad_f"][:, :n].copy_(grad_f)
        t["partial"].zero_()[0].copy_(grad_net)
        t["loss"].zero_()[0].copy_(loss.detach())

    def _collect(self) -> None:
        a = self._arrays
        args = (self._groups, self._shapes, a["used"], self._by_gaussian, a["grad_f"], CUT, a["sums"])
        self._share(self.count, lambda *lane: self._step_kernels.collect(*args, *lane))

    def _features(self) -> None:
        a = self._arrays
        args = (self._groups, self._shapes, a["used"], self._by_group, CUT, a["f"])
        self._share(self._groups.x.shape[0], lambda *lane: self._step_kernels.features(*args, *lane))

    def _share(self, total: int, work) -> None:
        """Calls `work` for all `total` items: once on CUDA, for two halves on two threads on the CPU."""
        if self._cuda:
            work()
            return
        half = total // 2
        lanes = [(base, count) for base, count in ((0, half), (half, total - half)) if count]
        list(self._pool.map(lambda lane: work(*lane), lanes))

    def _prune(self) -> None:
        """Drops as many Gaussians as possible while no decoded number changes by more than `_PRUNE` of the range of all
        numbers. The Gaussians with the least influence on the probes go first; at least one is kept."""
        t, latent = self._tensors, self._tensors["used"][:, LATENT]
        # With a gradient of one in one channel, the first sum of the latent is the sum of the Gaussian's weights.
        t["grad_f"].zero_()
        t["grad_f"][0, : self._probes] = 1.0
        self._collect()
        influence = t["sums"][:, SHAPE_NUMBERS].view(self.count, -1).sum(1) * latent.norm(dim=1)
        order = influence.argsort(stable=True)
        stored = latent.clone()
        self._features()
        whole = self._decoded()
        scale = torch.from_numpy(self.spread).to(whole)
        exact = torch.from_numpy(self.mean).to(whole) + whole * scale
        allowed = _PRUNE * float(exact.max() - exact.min())

        def change(count: int) -> float:
            latent.copy_(stored)
            latent[order[:count]] = 0.0
            self._features()
            return float(((self._decoded() - whole) * scale).abs().max())

        low, high = 0, self.count - 1
        while low < high:
            middle = (low + high + 1) // 2
            if change(middle) <= allowed:
                low = middle
            else:
                high = middle - 1
        self.dropped_change = change(low)
        self.needed = np.ones(self.count, bool)
        self.needed[order[:low].cpu().numpy()] = False

    def _decoded(self) -> torch.Tensor:
        """Returns the network's output at all probes before it is scaled to the probes' numbers, float32 [N, D]."""
        return self._outputs_of(self._tensors["f"].sum(0)[:, : self._probes], self._tensors["net"])

    def _outputs_of(self, f: torch.Tensor, net: torch.Tensor) -> torch.Tensor:
        first, second, third = split_layers(net, self._layers)
        x = wp.to_torch(self._groups.x)[: self._probes]
        h = torch.sigmoid(torch.cat([f.T, x], 1) @ first[:-1] + first[-1])
        h = torch.sigmoid(h @ second[:-1] + second[-1])
        return (h @ third[:-1] + third[-1])[:, : self._outputs]

    def mse(self) -> float:
        """Returns the mean squared error of the network's outputs at the last step; NaN before the first."""
        return float(self._tensors["loss"].sum()) * self._unit if self.step else math.nan

    def quantised(self) -> Gaussians:
        """Returns the fit with 16-bit codes, but without the integers for a file. The network's last layer yields the
        probes' numbers divided by `gain`, the largest weight of this layer. Where the error is relative, it yields the
        numbers of `with_magnitude`, and `gain` is the magnitude of the brightest probe."""
        d = self._outputs
        t = {key: self._tensors[key].cpu().numpy().astype(np.float64) for key in ("used", "bounds", "net")}
        low, high = t["bounds"]
        span = np.where(high > low, high - low, 1.0)
        code = np.rint((t["used"][self.needed] - low) / span * self._levels.numpy())
        code = np.where(high > low, code, 0).astype(np.uint16)
        first, second, third = split_layers(t["net"], self._layers)
        third = third[:, :d] * self.spread
        third[-1] += self.mean
        gain = self._gain
        if not self.relative:
            gain = float(np.abs(third).max()) or 1.0
            third = third / gain
        net = np.concatenate([first.ravel(), second.ravel(), third.ravel()])
        return Gaussians(
            latent=self._latent,
            hidden=self._hidden,
            outputs=d // self._hours - self.relative,
            support=self._support,
            relative=self.relative,
            gain=gain,
            code=code,
            levels=self._codes,
            bounds=t["bounds"].astype(np.float32),
            net=np.clip(net, -65504, 65504).astype(np.float16),
            dropped=int((~self.needed).sum()),
            hours=self._hours,
        )

    def state(self) -> dict[str, np.ndarray]:
        """Returns the arrays on which later steps depend, by name. Raises a WlmError if the fit diverged: a number is
        not finite."""
        result = {key: self._tensors[key].cpu().numpy().copy() for key in _STATE}
        if not all(map(all_finite, result.values())):
            raise WlmError(f"the fit diverged; use smaller learning rates than profile {self._name}")
        return result | {"kept": self.needed.copy(), "entered": np.array(self._entered)}

    def table(self, step: int) -> dict[str, Part]:
        """Returns the types and shapes of the arrays of `state` after `step` steps."""
        entered = self.stage(step - 1) if step else 0
        table = {key: Part(np.float32, tuple(self._tensors[key].shape)) for key in _STATE}
        return table | {
            "control": Part(np.int32, (1,), least=step, most=step),
            "kept": Part(np.bool_, (self.count,)),
            "entered": Part(np.int64, (), least=entered, most=entered),
        }

    def load(self, state: dict[str, np.ndarray]) -> None:
        """Continues from the arrays that `state` of a trainer with the same arguments returned, exactly as that one.
        Raises a ValueError if an array is missing, has another type or shape, or a number is out of its range; the
        trainer is unchanged."""
        done = check_part(state, "control", Part(np.int32, (1,), least=0, most=self.steps))
        state = check_parts(state, self.table(int(done[0])))
        if not state["kept"].any() or (state["bounds"][0] > state["bounds"][1]).any():
            raise ValueError(
                "parts kept, bounds: expected at least one Gaussian to be kept, and lower bounds up to the upper ones"
            )
        for key in _STATE:
            self._tensors[key].copy_(torch.from_numpy(np.array(state[key])))
        self.needed, self._entered = np.array(state["kept"]), int(state["entered"])
        if self._entered == 2:
            with interop.stream(self.device):
                self._make_shapes(quantised=True)
                self._tensors["used"][torch.from_numpy(~self.needed).to(self.device), LATENT] = 0.0
                self._features()

    def close(self) -> None:
        """Ends the CPU's threads and frees the CUDA graphs, which hold references to the trainer."""
        self._stages, self.peers = [], []
        if self._pool is not None:
            self._pool.shutdown()


def _first_numbers(
    x: np.ndarray, values: np.ndarray, profile: Profile, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Returns the initial Gaussians, float32 [K, 10 + L], and the initial weights of the network, float32 [P]."""
    latent, hidden, outputs = profile.latent, profile.hidden, values.shape[1]
    count = gaussian_count(profile.ratio, len(x))
    centre, scale = first_gaussians(x, values, count, profile.detail, profile.first_scale, random)
    rows = np.zeros((len(centre), LATENT.start + latent), np.float32)
    rows[:, CENTRE] = centre
    rows[:, SCALE] = np.log(scale)[:, None]
    rows[:, ROTATION.start] = 1.0
    rows[:, LATENT] = random.normal(size=(len(centre), latent)) * _FIRST_LATENT
    inputs, gain = latent + 3, profile.gain
    first = random.uniform(-1, 1, (inputs + 1, hidden)) * gain / math.sqrt(inputs)
    first[inputs] /= gain
    first[inputs] -= x.mean(0) @ first[latent:inputs]
    second = np.zeros((hidden + 1, hidden))
    second[:hidden] = random.uniform(-1, 1, (hidden, hidden)) * gain / math.sqrt(hidden)
    third = np.zeros((hidden + 1, probe_network.padded(outputs)))
    third[:hidden, :outputs] = random.uniform(-1, 1, (hidden, outputs)) / math.sqrt(hidden)
    # A sigmoid is 1/2 on average; the biases make each layer's inputs 0 on average.
    second[hidden] = -0.5 * second[:hidden].sum(0)
    third[hidden] = -0.5 * third[:hidden].sum(0)
    return rows, np.concatenate([first.ravel(), second.ravel(), third.ravel()]).astype(np.float32)


def local_spread(x: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Returns how much the light varies around each probe. `x` are positions of probes, [N, 3], and `values` their
    numbers, [N, D]. The result is float64 [N], positive: the standard deviation over each probe and its eight nearest,
    plus a small floor."""
    near = cKDTree(x).query(x, k=min(_NEIGHBOURS, len(x)), workers=-1)[1].reshape(len(x), -1)
    # In pieces: all neighbours' numbers at once would be nine times the set.
    pieces = (near[start : start + _PIECE] for start in range(0, len(near), _PIECE))
    spread = np.concatenate([np.sqrt(values[piece].astype(np.float64).var(1).sum(1)) for piece in pieces])
    floor = _FLOOR * spread.mean()
    return spread + (floor if floor > 0 else 1.0)


def first_gaussians(
    x: np.ndarray, values: np.ndarray, count: int, detail: float, first_scale: float, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Places the initial Gaussians by k-means, with more centres where the light varies (gaussian-probe-compression,
    section 3.2).

    Args:
        x: float32 [N, 3], positions of the probes relative to their box, in [0, 1].
        values: float32 [N, D], the numbers of these probes.
        count: Number of Gaussians; reduced to the number of distinct positions.
        detail, first_scale: See `wlm.probe.model.Profile`.
        random: Source of random numbers.

    Returns:
        Centres, float64 [K, 3], and scales, float64 [K], which follow from the distance to the nearest other centre.
    """
    distinct, index = np.unique(x, axis=0, return_index=True)
    count = min(count, len(distinct))
    if count == len(distinct):
        centre = distinct.astype(np.float64)
    else:
        weight = local_spread(x, values)[index] ** detail
        centre = distinct[random.choice(len(distinct), count, replace=False, p=weight / weight.sum())]
        centre = _kmeans(x.astype(np.float64), centre.astype(np.float64), _ROUNDS if detail > 0 else _PLAIN_ROUNDS)
    if count == 1:
        return centre, np.array([max(np.linalg.norm(x - centre, axis=1).max(), _SMALLEST)])
    nearest = cKDTree(centre).query(centre, k=2)[0][:, 1]
    return centre, np.maximum(first_scale * nearest, _SMALLEST)


def _kmeans(x: np.ndarray, centre: np.ndarray, rounds: int) -> np.ndarray:
    for _ in range(rounds):
        label = cKDTree(centre).query(x, workers=-1)[1]
        size = np.bincount(label, minlength=len(centre))
        total = np.stack([np.bincount(label, x[:, axis], len(centre)) for axis in range(3)], 1)
        # A centre that is nearest to no probe keeps its position.
        centre = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], centre)
    return centre
