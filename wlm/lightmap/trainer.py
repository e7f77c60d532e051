"""Trains one batch of tiles on a device, from normalised colours and their weights in the loss."""

import math
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
import warp as wp

from wlm import interop
from wlm.dispatch import CPU_LANES, Advance
from wlm.errors import WlmError
from wlm.formats.bc7 import pack_mode6
from wlm.formats.parts import Part, check_part, check_parts
from wlm.lightmap.profile import Profile, TimeAxis, encode_time
from wlm.lightmap.tiles import TILE, TileCut
from wlm.workers import each
from wlm_kernels.lightmap import blocks, features, gather, levels
from wlm_kernels.lightmap import step as lightmap_step
from wlm_kernels.lightmap.features import INPUTS

# The parts of a state, besides Adam's moments: attributes of a trainer.
_STATE = ("maps", "hidden", "output", "loss", "control")

_MOMENTUM = 0.9  # Adam's decay of gradients
_ADAM_EPSILON = 1e-8  # the loss is a mean over the samples and channels of a tile
_CHUNK = {"cpu": 5, "cuda": 200}  # steps between two looks at the clock
_REPEATS = 50  # steps in one CUDA graph, so that the GPU does not wait for the host between them


class Targets:
    """The training data of N tiles, on the host.

    Attributes:
        number: int [N], numbers of the tiles in their grid.
        colour: float32 [N, T, 128 * 128, 3], (colour / scale - shift) / spread of the valid texels; 0 elsewhere.
        texels: int32 [N, K], flat indices of valid texels, padded to the largest count K.
        count: int32 [N], number of valid texels.
        weight, emphasis: Loss weights, float32 [N, T, 3], and a number, see `wlm_kernels.lightmap.features.Batch`.
        shift, spread: float32 [N, 3], mean and standard deviation of colour / scale.
        scale: float32 [N, T, 3], mean of each channel at each time.
        range: float32 [N, T], range of the radiance that errors are relative to, or `peak` if it is given.
    """

    def __init__(
        self,
        tiles: TileCut,
        scale: np.ndarray,
        affine: np.ndarray,
        *,
        gamma: float,
        metric_weight: float,
        peak: float | None = None,
    ) -> None:
        """Converts the valid texels of N tiles to gamma space, normalises and weights them.

        `scale` [N, T, 3] and `affine` [N, 2, 3], which holds shift and spread, are float32, as rounded for the file.
        """
        n, times = scale.shape[:2]
        self.number = tiles.index.astype(np.int32)
        self.scale = scale
        self.shift = affine[:, 0].astype(np.float32)
        self.spread = affine[:, 1].astype(np.float32)
        factor = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
        self.colour = np.zeros((n, times, TILE * TILE, 3), np.float32)
        self.count = np.array([np.count_nonzero(mask) for mask in tiles.mask], np.int32)
        self.texels = np.zeros((n, max(int(self.count.max()), 1)), np.int32)
        self.weight = np.ones((n, times, 3), np.float32)
        self.range = np.zeros((n, times), np.float32)

        def fill(i: int) -> None:
            rows, columns = np.nonzero(tiles.mask[i])
            at = self.texels[i, : self.count[i]] = rows * TILE + columns
            values = tiles.light[i][:, tiles.mask[i]]  # [T, K, 3], a copy
            if gamma != 1.0:
                np.power(values, np.float32(1.0 / gamma), out=values)
            span = values.max(1).max(1) ** gamma - values.min(1).min(1) ** gamma  # [T] of linear radiance
            values *= factor[i, :, None]
            values -= self.shift[i]
            values /= self.spread[i]
            self.colour[i][:, at] = values
            if peak is not None:
                span = np.full_like(span, peak)
            self.range[i] = span
            if metric_weight > 0:
                # d radiance / d y = gamma (colour / scale)^(gamma - 1) scale^gamma spread; the middle factor is the
                # texel's emphasis. A tile without a range is not scored and gets no weight.
                slope = gamma * scale[i] ** gamma * self.spread[i] / np.where(span > 0, span, 1.0)[:, None]
                self.weight[i] = np.where(span[:, None] > 0, slope, 0.0) ** (2.0 * metric_weight)

        list(each(fill, range(n)))
        # A black channel has scale 0: it decodes to 0 whatever the network's output is.
        self.weight *= scale > 0
        self.emphasis = 2.0 * (gamma - 1.0) * metric_weight


@dataclass(frozen=True, eq=False)
class TileJob:
    """A batch of N tiles, sent to a worker, which computes the training data from it: light and masks of the tiles,
    `scale` and `affine` (see `Targets`), the settings and the time axis."""

    tiles: TileCut
    scale: np.ndarray
    affine: np.ndarray
    profile: Profile
    axis: TimeAxis

    def targets(self) -> Targets:
        """Computes the training data."""
        settings = self.profile
        options = {"gamma": settings.gamma, "metric_weight": settings.metric_weight, "peak": settings.peak}
        return Targets(self.tiles, self.scale, self.affine, **options)


class Trainer:
    """Trains N tiles together; see `stage` for the stages of the training.

    `state` holds everything that a later step depends on, so that a resumed fit continues exactly.

    Attributes:
        axis, device: The time axis, and the device, as `interop.check_device` returns it.
        steps, frozen: Number of steps of the fit, and the first at which only the network is trained.
        numbers, tiles: int32 [N], numbers of the tiles in their grid, and N.
        views: The maps by name, as `wlm_kernels.lightmap.features.Maps` has them: views of `maps`.
        maps: float32 [M], all M parameters of the maps.
        hidden, output: The networks, see `wlm_kernels.mlp`.
        loss, control: float32 [N], running mean of each tile's loss over about 50 steps; int32 [1], steps done.
        batch: The training data in the form that the kernels read.
    """

    def __init__(
        self,
        profile: Profile,
        axis: TimeAxis,
        targets: Targets,
        seed: int,
        device: str,
        track: bool = False,
    ):
        """Uploads the targets and draws the initial parameters.

        The seed determines the initial parameters and all samples; `track` collects the errors that `psnr` needs.
        """
        self._track = track
        self.axis, self.device = axis, device
        self.steps, self.frozen = profile.steps, round(profile.freeze_from * profile.steps)
        self._quantised_from = round(profile.quantise_from * profile.steps)
        self._samples, self._integers, self._name = profile.samples, profile.net_bits == 8, profile.name
        self._turned = profile.hidden if profile.muon else 0
        self._first_rates, self._decay = (profile.map_rate, profile.net_rate), profile.adam_decay
        self.numbers, self.tiles = targets.number, len(targets.number)
        n, r, slices = self.tiles, profile.uvt_resolution, profile.uvt_slices
        plane = n, profile.plane_rows, profile.plane_columns, 2
        shapes: dict[str, tuple[int, ...]] = {"uv_endpoints": (n, 32, 32, 2, 4), "uv_weights": (n, TILE, TILE)}
        shapes |= {"uvt_endpoints": (n * slices, r // 4, r // 4, 2, 4), "uvt_weights": (n * slices, r, r)}
        shapes |= {"ut": plane, "vt": plane}
        self._cuda = device != "cpu"
        self._pool = None if self._cuda else ThreadPoolExecutor(CPU_LANES)
        # Two threads that launch kernels at once would compile them twice into one file.
        with interop.alone:
            self._kernels = lightmap_step.step_kernels(profile.hidden, profile.gelu, "cuda" if self._cuda else "cpu")
            self._kernels.load(device)
            gather.load(device, self._turned)
        with interop.stream(device):
            self._allocate(shapes, profile)
            self._upload(targets, seed, profile.gamma)
            self.batch.schedule = self._rates_over_steps(profile.final_rate)
            self._draw(seed)
        repeated = (partial(self._step, stage, _REPEATS) for stage in range(3))
        self._repeated = [interop.LaunchGraph(steps, device, warmup=1) for steps in repeated]
        with interop.alone, interop.stream(device):
            self._round()  # loads the kernels of later stages, too
            if self._integers:
                levels.put_on_levels(*self._levels_args)
            for graph in self._repeated:
                graph.capture()

    def _allocate(self, shapes: dict[str, tuple[int, ...]], profile: Profile) -> None:
        """Allocates maps of these shapes, networks, and all arrays that a training step writes."""
        device, n, hidden = self.device, self.tiles, profile.hidden
        sizes = {"slices": profile.uvt_slices, "side": profile.uvt_resolution}
        sizes |= {"rows": profile.plane_rows, "columns": profile.plane_columns}
        lengths = {key: math.prod(shape) for key, shape in shapes.items()}
        total = sum(lengths.values())

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        self.maps = zeros(total)
        self.hidden, self.output = zeros(n, INPUTS + hidden + 2, hidden), zeros(n, hidden + 1, 3)
        self._rounded = zeros(total)  # the maps on the levels of the file, which a step reads once they are quantised
        self._maps = [features.Maps() for _ in range(2)]
        for maps, values in zip(self._maps, (self.maps, self._rounded), strict=True):
            maps.values = interop.to_warp(values)
            for key, size in sizes.items():
                setattr(maps, key, size)
        self.views, at = {}, 0
        for key, shape in shapes.items():
            self.views[key] = self.maps[at : at + lengths[key]].view(shape)
            for maps in self._maps:
                setattr(maps, key, at)
            at += lengths[key]

        self._lanes = lanes = 1 if self._cuda else CPU_LANES
        parts = self._samples // lightmap_step.BLOCK if self._cuda else lanes
        self._acc = zeros(lanes, total, dtype=torch.int64 if self._cuda else torch.float32)
        self._partial = zeros(parts, *self.hidden.shape)
        self._partial_out = zeros(parts, *self.output.shape)
        self._loss_parts = zeros(parts, n)
        self.loss = zeros(n)
        self.control = zeros(1, dtype=torch.int32)
        self._tracked = zeros(lanes if self._track else 0, n, len(self.axis.times), 2)
        self._rates, self._moments = zeros(4), {}
        self._wrapped_rates = interop.to_warp(self._rates.view(1, 4), wp.vec4)
        adams = [self._moments_of(key, getattr(self, key)) for key in ("maps", "hidden", "output")]

        vec, wrap = self._kernels.net.vec_hidden, interop.to_warp
        # CUDA stores whole tiles of scalars; the CPU adds whole columns.
        shaped = (
            (wrap(self._partial.view(-1, hidden)), wrap(self._partial_out.view(-1, 3)), wrap(self._loss_parts.view(-1)))
            if self._cuda
            else (wrap(self._partial, vec), wrap(self._partial_out, wp.vec3), wrap(self._loss_parts))
        )
        # Kernels read the networks, or the networks on 8-bit levels.
        nets = self.hidden, self.output
        self._on_levels = tuple(torch.empty_like(values) for values in nets)
        self._nets = [(wrap(values[0], vec), wrap(values[1], wp.vec3)) for values in (nets, self._on_levels)]
        self._levels_args = tuple(wrap(values) for values in (*nets, *self._on_levels))
        self._launch_sums = (wrap(self._acc), *shaped)
        self._update_args: list = [self._wrapped_rates, self._launch_sums[0], adams[0], self._maps[0]]
        self._turned_args = adams[1].first, wrap(self.hidden.view(-1))
        for sums, moments, values in zip((self._partial, self._partial_out), adams[1:], nets, strict=True):
            self._update_args += [wrap(sums.view(parts, -1)), moments, wrap(values.view(-1))]
        self._update_args += [wrap(self._loss_parts), wrap(self.loss), wrap(self.control), self._maps[1].values]

    def _moments_of(self, name: str, values: torch.Tensor) -> gather.Adam:
        """Returns the state of the optimiser (Adam) for one array of parameters, with all moments 0."""
        adam = gather.Adam()
        adam.decay = wp.vec2(_MOMENTUM, self._decay)
        adam.epsilon = _ADAM_EPSILON
        for key, field in (("exp_avg", "first"), ("exp_avg_sq", "second")):
            moments = torch.zeros(values.numel(), device=self.device)
            self._moments[f"adam_{name}.{key}"] = moments
            setattr(adam, field, interop.to_warp(moments))
        return adam

    def _upload(self, targets: Targets, seed: int, gamma: float) -> None:
        tau, encoding = encode_time(self.axis)

        def put(values: np.ndarray, dtype: type) -> wp.array:
            return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

        batch = features.Batch()
        batch.targets = put(targets.colour, wp.vec3)
        batch.texels = put(targets.texels, wp.int32)
        batch.texel_count = put(targets.count, wp.int32)
        batch.tau = put(tau, wp.float32)
        batch.encoding = put(encoding, wp.vec4)
        batch.weight = put(targets.weight, wp.vec3)
        batch.number = put(targets.number, wp.int32)
        batch.shift = put(targets.shift, wp.vec3)
        batch.spread = put(targets.spread, wp.vec3)
        batch.scale = put(targets.scale, wp.vec3)
        batch.gamma = gamma
        squared = np.square(targets.range, dtype=np.float32)
        batch.inverse_range = put(np.divide(1.0, squared, out=np.zeros_like(squared), where=squared > 0), wp.float32)
        self._scored = torch.from_numpy(targets.range > 0)
        batch.tracked = interop.to_warp(self._tracked)
        batch.control = interop.to_warp(self.control)
        batch.seed = seed
        batch.emphasis = targets.emphasis
        batch.periodic = int(self.axis.periodic)
        batch.quantised = batch.frozen = 0
        batch.rates = self._wrapped_rates
        self.batch = batch

    def _rates_over_steps(self, final_rate: float) -> wp.array:
        """Returns the rates of maps and networks and Adam's two bias corrections at each step, vec4 [steps]."""
        share = np.linspace(0.0, 1.0, self.steps)
        values = final_rate + (1.0 - final_rate) * 0.5 * (1.0 + np.cos(np.pi * share))
        done = np.arange(1, self.steps + 1)
        corrections = 1.0 / (1.0 - _MOMENTUM**done), 1.0 / np.sqrt(1.0 - self._decay**done)
        rates = (np.float32(rate) * values.astype(np.float32) for rate in self._first_rates)
        return wp.array(np.stack([*rates, *corrections], 1).astype(np.float32), dtype=wp.vec4, device=self.device)

    def _draw(self, seed: int) -> None:
        """Draws random initial parameters. Each tile has its own generator, so that batching does not change them."""
        hidden = self.hidden.shape[-1]
        maps = {key: np.empty(view.shape, np.float32) for key, view in self.views.items()}
        w = np.zeros(tuple(self.hidden.shape), np.float32)
        o = np.zeros(tuple(self.output.shape), np.float32)
        for i, tile in enumerate(self.numbers):
            random = np.random.default_rng([seed, int(tile)])
            for values in maps.values():
                part = values.reshape(self.tiles, -1)
                part[i] = random.uniform(0.25, 0.75, part.shape[1])
            w[i, :INPUTS] = random.uniform(-1, 1, (INPUTS, hidden)) / math.sqrt(INPUTS)
            w[i, INPUTS + 1 : INPUTS + 1 + hidden] = random.uniform(-1, 1, (hidden, hidden)) / math.sqrt(hidden)
            o[i, :hidden] = random.uniform(-1, 1, (hidden, 3)) / math.sqrt(hidden)
        for key, values in maps.items():
            self.views[key].copy_(torch.from_numpy(values))
        self.hidden.copy_(torch.from_numpy(w))
        self.output.copy_(torch.from_numpy(o))

    @property
    def step(self) -> int:
        """Number of steps done."""
        return int(self.control.item())

    def stage(self, step: int) -> int:
        """Returns the stage of a step: 0 continuous maps with noise, 1 quantised maps, 2 frozen maps."""
        return int(step >= self._quantised_from) + int(step >= self.frozen)

    def run(self, steps: int) -> None:
        """Runs the given number of training steps; on a GPU it only queues them."""
        step = self.step
        end, first_quantised = step + steps, max(step, self._quantised_from)
        # A second thread of torch would spin between its calls, on the core that a lane needs.
        with interop.one_thread(self.device), interop.stream(self.device):
            while step < end:
                stage, last = self.stage(step), step + _REPEATS
                if step == first_quantised:
                    self._round()  # each step of quantised maps does it for the next one
                if self._cuda and last <= end and self.stage(last - 1) == stage:
                    self._repeated[stage]()
                    step = last
                else:
                    self._step(stage)
                    step += 1

    def _step(self, stage: int, count: int = 1) -> None:
        for _ in range(count):
            self._add_gradients(stage)
            self._update(stage)

    def _round(self) -> None:
        """Puts the maps on the levels of the file, for steps of quantised maps."""
        with interop.alone:
            gather.put_on_levels(*self._maps)

    def _add_gradients(self, stage: int) -> None:
        quantised = stage > 0
        self.batch.quantised, self.batch.frozen = int(quantised), int(stage == 2)
        on_levels = quantised and self._integers
        if on_levels:
            levels.put_on_levels(*self._levels_args)
        args = (self._maps[quantised], *self._nets[on_levels], self.batch, self._samples, *self._launch_sums)
        span = self._samples // self._lanes
        self._share(lambda lane: self._kernels.launch(*args, lane * span, span))

    def _update(self, stage: int) -> None:
        options = {"frozen": stage == 2, "levels": stage == 1, "clear": not self._cuda, "lanes": self._lanes}
        options["turned"] = self._turned
        self._share(lambda lane: gather.update(*self._update_args, **options, lane=lane))
        if self._turned:
            gather.turn(self._turned, self._wrapped_rates, *self._turned_args)

    def _share(self, work: Callable[[int], None]) -> None:
        """Runs `work(i)` for each lane i, each in its own thread; kernel launches release Python's lock."""
        if self._pool is None:
            work(0)
        else:
            list(self._pool.map(work, range(self._lanes)))

    def losses(self) -> np.ndarray:
        """Returns the running mean of each tile's loss over about 50 steps, float32 [N]."""
        return self.loss.cpu().numpy()

    def psnr(self) -> float:
        """Returns the mean PSNR in dB over tiles and times, for samples since the last call; NaN without `track`."""
        with interop.stream(self.device):
            sums = self._tracked.sum(0).cpu()
            self._tracked.zero_()
        sampled = (sums[..., 1] > 0) & self._scored
        mean = sums[..., 0][sampled] / sums[..., 1][sampled]
        return float((-10.0 * torch.log10(mean.clamp_min(1e-12))).mean())

    def quantised(self) -> dict[str, np.ndarray]:
        """Returns maps and networks as the file stores them, by their names in `SheetModel`."""
        nets = self.hidden, self.output
        if self._integers:
            nets = self._on_levels
            with interop.alone, interop.stream(self.device):
                levels.put_on_levels(*self._levels_args)
        net = torch.cat([values.flatten(1) for values in nets], 1)
        uvt = self._blocks("uvt")
        result = {"net": net.cpu().numpy().astype(np.float16), "uv": self._blocks("uv")}
        result["uvt"] = uvt.reshape(self.tiles, -1, *uvt.shape[1:])
        for key in ("ut", "vt"):
            plane = np.clip(self.views[key].cpu().numpy(), 0.0, 1.0)
            result[key] = np.floor(plane * np.float32(255.0) + np.float32(0.5)).astype(np.uint8)
        return result

    def _blocks(self, name: str) -> np.ndarray:
        """Returns a map as BC7 blocks, uint8 [S, H/4, W/4, 16]: S images of H x W texels, one per tile or slice."""
        endpoints = interop.to_warp(self.views[f"{name}_endpoints"], wp.vec4)
        weights = interop.to_warp(self.views[f"{name}_weights"])
        with interop.alone, interop.stream(self.device):
            levels = wp.empty(endpoints.shape, dtype=wp.vec4ub, device=self.device)
            index = wp.empty(weights.shape, dtype=wp.uint8, device=self.device)
            blocks.quantise(endpoints, weights, levels, index)
        s, h, w = index.shape
        # Texels [S, H, W] -> blocks [S, H/4, W/4, 16], row-major in the block.
        index = index.numpy().reshape(s, h // 4, 4, w // 4, 4).swapaxes(2, 3).reshape(s, h // 4, w // 4, 16)
        return pack_mode6(levels.numpy(), index)

    def check(self) -> None:
        """Checks that the fit has not diverged."""
        broken = ~torch.isfinite(self.loss)
        for values in (*self.views.values(), self.hidden.half(), self.output.half()):
            broken |= ~torch.isfinite(values.reshape(self.tiles, -1)).all(1)
        if bool(broken.any()):
            tile = self.numbers[broken.cpu().numpy()][0]
            raise WlmError(
                f"tile {tile}: the fit diverged; take a smaller map_rate or net_rate than in profile {self._name}"
            )

    def state(self) -> dict[str, np.ndarray]:
        """Returns all arrays that later steps depend on, by name."""
        self.check()
        result = {key: getattr(self, key) for key in _STATE} | self._moments
        # Copies.
        return {key: np.array(value.cpu().numpy()) for key, value in result.items()}

    def table(self, step: int) -> dict[str, Part]:
        """Returns the types and shapes of the arrays that `state` returns after `step` steps, by name."""
        table = {key: Part(np.float32, tuple(getattr(self, key).shape)) for key in _STATE}
        table["control"] = Part(np.int32, (1,), least=step, most=step)
        for key, values in self._moments.items():
            table[key] = Part(np.float32, tuple(values.shape), least=0.0 if key.endswith("_sq") else None)
        return table

    def load(self, state: dict[str, np.ndarray]) -> None:
        """Restores what `state` returned.

        Raises:
            ValueError: An array is missing, has another shape or is out of range; the trainer is then unchanged.
        """
        done = check_part(state, "control", Part(np.int32, (1,), least=0, most=self.steps))
        parts = check_parts(state, self.table(int(done[0])))
        values = {name: torch.tensor(part, device=self.device) for name, part in parts.items()}
        with interop.stream(self.device):
            for key in _STATE:
                getattr(self, key).copy_(values[key])
            self.maps.clamp_(0.0, 1.0)  # as steps do; maps of version 0.2 may lie outside
            for key, moments in self._moments.items():
                moments.copy_(values[key])

    def close(self) -> None:
        """Ends the trainer's threads and frees its graphs, which hold references to it."""
        self._repeated = []
        if self._pool is not None:
            self._pool.shutdown()


class Fitter:
    """Fits batches of tiles one after another, in this process or in another one (`wlm.dispatch`)."""

    threads = True

    def __init__(self, device: str, seed: int, track: bool) -> None:
        """Takes settings for all batches: the device, the seed, and whether to report the PSNR (`track`)."""
        self._seed, self._track, self._device = seed, track, interop.check_device(device)
        with interop.stream(self._device):
            pass  # creates the device's context and stream, which threads must not do at once
        self._trainer: Trainer | None = None

    def start(self, job: TileJob, states: list[dict[str, np.ndarray] | None]) -> Advance:
        """Starts a batch, or continues it from its saved state; raises ValueError if it is another batch's."""
        self.close()
        self._trainer = Trainer(job.profile, job.axis, job.targets(), self._seed, self._device, self._track)
        if states[0] is not None:
            self._trainer.load(states[0])
        return Advance(self._trainer.step)

    def advance(self, seconds: float) -> Advance:
        """Trains the batch for about `seconds`, at least a few steps, or to its end; returns the progress.

        Its figures are means over the batch's tiles, from the latest samples; after the last step they describe the
        maps as the file holds them. The result are the maps and networks as the file holds them.
        """
        trainer = self._trainer
        chunk, frozen, steps = _CHUNK["cpu" if self._device == "cpu" else "cuda"], trainer.frozen, trainer.steps
        step, end = trainer.step, time.monotonic() + seconds
        while step < steps:
            count = min(chunk, steps - step)
            trainer.run(count)
            step += count
            if time.monotonic() >= end:
                break
            if self._track and step - count < frozen <= step < steps:
                trainer.psnr()  # samples before the maps were frozen do not count
        figures = {"loss": float(trainer.losses().mean()), "PSNR_dB": trainer.psnr()} if self._track else {}
        if step < steps:
            return Advance(step, figures)
        trainer.check()
        parts = trainer.quantised()
        self.close()
        return Advance(step, figures, True, parts)

    def state(self) -> list[dict[str, np.ndarray]]:
        """Returns all arrays that later steps of the batch depend on, by name."""
        return [self._trainer.state()]

    def close(self) -> None:
        """Drops the batch and frees its memory."""
        if self._trainer is not None:
            self._trainer.close()
            self._trainer = None
