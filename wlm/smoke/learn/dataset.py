"""Samples to learn from, made on the device while a network trains (neural-six-way-lightmaps, sections 4.4 and 5).

The paper stores 25,200 images of 14 sequences. Here a pool of samples is a function of its settings and its number: a
scene is drawn, simulated and looked at from several sides, and nothing is stored. A sample is two frames that follow
each other, with the guiding map and the lightmaps of each, and the motion between them. Only smoke is seen: obstacles
shape it and are left out of the picture (section 5).

The paper's sizes, 400^3 voxels, 512^2 pixels and steps of 10 voxels, are far more than learning needs. Lengths are
shares of the box, so that a smaller grid shows the same: the guiding map's step is 1/40 of its edge, and so is the
density from which on smoke has a surface. Who uses a network trained so makes its guiding maps with
`DatasetSettings.look`.

=======================================  =============================================================
a scene that blows up, or ends in NaN    left out and counted; another is drawn in its place
one that blows up each time              error after `ATTEMPTS`
a frame with almost no smoke             a small share of these is kept
a sample with NaN or infinity            never: its scene counts as one that blew up
=======================================  =============================================================
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Annotated, Any, Literal

import numpy as np
import torch
import warp as wp
from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from wlm.errors import WlmError
from wlm.fluid.solver import Solver
from wlm.fluid.volume import load_volume
from wlm.interop import check_device, no_collection, stream
from wlm.smoke.baking import bake
from wlm.smoke.camera import Camera
from wlm.smoke.learn.scenes import EDGE, LATTICE_SPEED, draw_scene, generator
from wlm.smoke.motion import motion
from wlm.smoke.planes import GUIDES, OPACITY_PLANE, PLANES, VISIBLE, Pool, encode_lightmaps, render_guide
from wlm.smoke.scene import CameraSettings, Scene, make_camera
from wlm.smoke.simulation import make_solver, volume_of
from wlm_kernels.smoke.settings import March

__all__ = [
    "ATTEMPTS",
    "STAGES",
    "DatasetSettings",
    "covered",
    "draw_scene",
    "load_probe_volume",
    "make_pool",
    "make_validation",
]

ATTEMPTS = 8
"""Scenes drawn for one place in a pool, before it is given up."""

STAGES = ("simulate", "guide", "reference", "motion")
"""What the time of a pool goes to."""

_EXTENT = 1.1  # of the image over the box's edge, in views that are fixed
# Steps of the solver after which its buffers are where they were: what a graph holds.
_PERIOD = 2
_BRIGHT = 0.99  # quantile of a volume's voxels that hold smoke, which stands for its density

_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Positive = Annotated[float, Field(gt=0.0)]
_Range = tuple[_Positive, _Positive]


class DatasetSettings(BaseModel):
    """What a pool is made of; lengths are shares of the box's edge, times of that in which air crosses it.

    Attributes:
        cells: Of the velocity along each edge of the box.
        least_cells: If given, a sequence to learn from has from so many up to ``cells``, drawn evenly in their
            logarithm: smoother smoke, of which a guiding map's steps miss less. The validation has ``cells``.
        refine: Voxels of density along an edge of a cell.
        substeps: Steps of the air in one of the smoke; even, as graphs need it.
        resolution: Pixels along an image's edges.
        frames: Pairs of frames taken from a sequence.
        views, arc: Fixed views, evenly spread over so many degrees from the first; the paper's are 9 over 90.
        views_a_frame: Samples made of each pair, each from another view at random.
        elevation: Degrees by which such a view may look from above or below.
        zoom: The image's edge, least and most.
        guide: Of which kind guiding maps are, one of `samples.GUIDES`.
        guide_step: h of the guiding map; the paper's 10 of 400 voxels.
        guide_spacing: Between the nodes at which its way to the lights is known, where these are kept apart; None: as
            the step.
        jitter: Share of such a step by which a pixel's samples are shifted.
        surface: Optical depth, over the box's edge, from which on smoke has a surface.
        reference_step: Of the lightmaps, in voxels.
        extinction: Of density 1, over the box's edge.
        density_scales: What that is multiplied by at random, least and most.
        sequences: In a round.
        hot: Share of these that glow.
        moving: Share of those with obstacles that have a moving one. It costs a sync with the device at each step.
        warmup: Time before a sequence's first pair, on average.
        interval: Time between the two frames of a pair, rounded to whole steps.
        apart: Time between two pairs.
        least_coverage: Share of the image up to which a frame counts as almost empty.
        kept_empty: Share of such frames that are kept.
        validation_sequences, validation_seed: Of the validation, by which the best of a training's networks is chosen.
        test_seed: Another than that, of as many sequences by which none is.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    cells: int = Field(50, ge=16, le=512)
    least_cells: int | None = Field(None, ge=16, le=512)
    refine: int = Field(4, ge=1, le=16)
    substeps: int = Field(4, ge=2, le=16, multiple_of=2)
    resolution: int = Field(256, ge=8, le=4096)
    frames: int = Field(8, ge=1, le=1000)
    views: int = Field(9, ge=1, le=360)
    arc: float = Field(90.0, gt=0.0, le=360.0)
    views_a_frame: int = Field(3, ge=1, le=64)
    elevation: float = Field(20.0, ge=0.0, le=89.0)
    zoom: _Range = (0.65, 1.2)
    guide: Literal["paper", "front", "sides", "six"] = "paper"
    guide_step: _Positive = 1.0 / 40.0
    guide_spacing: _Positive | None = None
    jitter: _Share = 1.0
    surface: float = Field(4.0, ge=0.0)
    reference_step: _Positive = 1.0
    extinction: _Positive = 25.0
    density_scales: _Range = (0.5, 2.0)
    sequences: int = Field(14, ge=1, le=10000)
    hot: _Share = 0.25
    moving: _Share = 0.1
    warmup: float = Field(1.3, ge=0.0, le=100.0)
    interval: _Positive = 0.01
    apart: float = Field(0.12, ge=0.0, le=100.0)
    least_coverage: _Share = 0.02
    kept_empty: _Share = 0.05
    validation_sequences: int = Field(4, ge=1, le=1000)
    validation_seed: int = Field(2026, ge=0)
    test_seed: int = Field(2027, ge=0)

    @model_validator(mode="after")
    def _order(self) -> DatasetSettings:
        if self.least_cells is not None and self.least_cells > self.cells:
            raise PydanticCustomError("range", "least_cells: expected at most cells")
        for name in ("zoom", "density_scales"):
            low, high = getattr(self, name)
            if low > high:
                raise PydanticCustomError("range", "{name}: expected the least before the most", {"name": name})
        if self.test_seed == self.validation_seed:
            raise PydanticCustomError("seed", "test_seed: expected another than validation_seed")
        if self.guide == "paper" and self.guide_spacing is not None:
            raise PydanticCustomError("spacing", "guide_spacing: expected none with the paper's guide, found one")
        return self

    @property
    def steps(self) -> int:
        """Steps of the air between the two frames of a pair: a multiple of what a graph holds."""
        return max(self.lattice_steps(self.interval), _PERIOD * self.substeps)

    @property
    def pixels(self) -> tuple[float, float]:
        """Along the box's edge, in the images to learn from: fewest and most."""
        low, high = self.zoom
        return self.resolution / high, self.resolution / low

    def lattice_steps(self, crossings: float) -> int:
        """A time in steps of the air, rounded to a multiple of what a graph holds."""
        whole = _PERIOD * self.substeps
        return round(crossings * self.cells / (LATTICE_SPEED * whole)) * whole

    def look(self, shape: Sequence[int], seed: int = 0) -> March:
        """The march of a guiding map through so many voxels."""
        longest = max(shape)
        spacing = None if self.guide_spacing is None else self.guide_spacing * longest
        threshold = self.surface / longest
        return March(self.guide_step * longest, spacing, jitter=self.jitter, seed=seed, threshold=threshold)


@dataclass(frozen=True)
class _Shot:
    """How a pair of frames is seen: camera, factor on the extinction, the first frame's seed of the jitter."""

    camera: Camera
    scale: float
    seed: int


def make_pool(
    settings: DatasetSettings,
    *,
    seed: int,
    round: int = 0,
    device: str = "cpu",
    progress: Callable[[int, dict[str, float]], None] | None = None,
) -> Pool:
    """Makes the samples of one round, all of scenes that no other round has.

    Args:
        settings: Of what kind they are.
        seed: Of all rounds, at least 0.
        round: Its number, from 0.
        device: As `wlm.interop.check_device` returns it.
        progress: Called after each sequence with how many are done and `samples` so far, `skipped` scenes that blew up,
            `dropped` samples without smoke, and the seconds of each of `STAGES`.

    Returns:
        The samples, on the device: at most sequences x frames x views_a_frame. The same arguments give the same bits on
        one device.

    Raises:
        WlmError: The memory isn't enough, or scenes keep blowing up.
    """
    return _Maker(settings, seed, False, device, progress).pool(round * settings.sequences, settings.sequences)


def make_validation(
    settings: DatasetSettings,
    device: str = "cpu",
    *,
    test: bool = False,
    scale: float = 1.0,
    progress: Callable[[int, dict[str, float]], None] | None = None,
) -> Pool:
    """Makes samples that no round has: other sequences, each of whose pairs is seen from every fixed view.

    Args:
        settings: As for `make_pool`.
        device: Likewise.
        test: Whether of the seed by which no network is chosen.
        scale: Factor on the extinction, as in the paper's ablation of 0.5 and 2; its smoke is the same.
        progress: As for `make_pool`.

    Raises:
        WlmError: As `make_pool`.
    """
    seed = settings.test_seed if test else settings.validation_seed
    maker = _Maker(settings, seed, True, device, progress, scale)
    return maker.pool(0, settings.validation_sequences)


class _Maker:
    """Makes pools of one split."""

    def __init__(
        self,
        settings: DatasetSettings,
        seed: int,
        validation: bool,
        device: str,
        progress: Callable[[int, dict[str, float]], None] | None,
        scale: float = 1.0,
    ) -> None:
        self._settings, self._seed, self._validation, self._device = settings, seed, validation, check_device(device)
        self._progress, self._scale, self._clock = progress, scale, _Clock(self._device)

    def pool(self, first: int, count: int) -> Pool:
        """The samples of some sequences that follow each other."""
        made: list[Pool] = []
        figures = dict.fromkeys(("samples", "skipped", "dropped"), 0.0)
        for place in range(first, first + count):
            pool, skipped, dropped = self._sequence(place)
            made.append(pool)
            for name, more in (("samples", len(pool)), ("skipped", skipped), ("dropped", dropped)):
                figures[name] += more
            if self._progress is not None:
                self._progress(place - first + 1, figures | self._clock.seconds())
        return Pool(*(torch.cat([getattr(pool, field.name) for pool in made]) for field in fields(Pool)))

    def _sequence(self, place: int) -> tuple[Pool, int, int]:
        """The samples of the first scene of a place that doesn't blow up, how many did, and samples left out."""
        for attempt in range(ATTEMPTS):
            index = place * ATTEMPTS + attempt
            settings = self._of_sequence(index)
            scene = draw_scene(settings, self._seed, index, validation=self._validation)
            random = generator(self._validation, self._seed, index, 1)
            solver = make_solver(scene, device=self._device)
            try:
                with stream(self._device):
                    guides, targets, moved = self._run(settings, scene, solver, random)
                solver.check()
            except WlmError as error:
                # The memory was had before; what the air does is all that can go wrong by now.
                trouble = str(error)  # its traceback would hold the solver
                continue
            if not all(bool(torch.isfinite(part).all()) for part in (guides, targets, moved)):
                trouble = "NaN or infinity in its pictures"
                continue
            share = covered(targets).cpu().numpy()
            lucky = random.random(len(share)) < self._settings.kept_empty
            keep = torch.from_numpy(np.flatnonzero((share > self._settings.least_coverage) | lucky))
            keep = keep.to(guides.device)
            # Below 0 in the validation: no number is in both.
            number = -1 - index if self._validation else index
            sequence = torch.full((len(keep),), number, dtype=torch.int64, device=guides.device)
            return Pool(guides[keep], targets[keep], moved[keep], sequence), attempt, len(share) - len(keep)
        raise WlmError(f"{ATTEMPTS} scenes one after the other blew up, the last with: {trouble}")

    def _of_sequence(self, index: int) -> DatasetSettings:
        """The settings with a sequence's own number of cells."""
        settings = self._settings
        if settings.least_cells is None or self._validation:
            return settings
        low, high = np.log(settings.least_cells), np.log(settings.cells)
        drawn = np.exp(generator(self._validation, self._seed, index, 2).uniform(low, high))
        return settings.model_copy(update={"cells": round(float(drawn))})

    def _run(
        self, settings: DatasetSettings, scene: Scene, solver: Solver, random: np.random.Generator
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Simulates a scene and takes its pairs: encoded guides, lightmaps and motion, half, one row a sample."""
        clock = self._clock
        air = _Air(scene, solver)
        views = settings.views if self._validation else settings.views_a_frame
        size = (settings.frames * views, 2)
        pixels = (settings.resolution, settings.resolution)
        half = {"dtype": torch.float16, "device": self._device}
        guides = torch.empty((*size, len(GUIDES[settings.guide]), *pixels), **half)
        targets = torch.empty((*size, len(PLANES), *pixels), **half)
        moved = torch.empty((*size, *pixels), **half)
        # What ends soon is looked at soon.
        early = 0.35 if any(source.stop is not None for source in scene.sources) else 1.0
        with clock("simulate"):
            air.advance(settings.lattice_steps(early * settings.warmup * random.uniform(0.6, 1.6)))
        for pair in range(settings.frames):
            shots = self._shots(scene, random)
            for frame in range(2):
                if pair or frame:
                    with clock("simulate"):
                        air.advance(settings.steps if frame else settings.lattice_steps(settings.apart))
                smoke = volume_of(scene, solver)
                for number, shot in enumerate(shots, pair * views):
                    seen = replace(smoke, extinction=smoke.extinction * shot.scale)
                    with clock("guide"):
                        look = settings.look(smoke.shape, shot.seed + frame)
                        guides[number, frame] = render_guide(seen, shot.camera, settings.guide, look)
                    with clock("reference"):
                        found = bake(seen, shot.camera, step=settings.reference_step, estimate=False)
                        targets[number, frame] = encode_lightmaps(found)
                    if frame:
                        with clock("motion"):
                            reach = scene.grid.cell * settings.steps
                            moved[number] = motion(seen, solver.velocity, shot.camera, reach=reach)
        return guides, targets, moved

    def _shots(self, scene: Scene, random: np.random.Generator) -> list[_Shot]:
        settings = self._settings
        if self._validation:
            seeds = random.integers(2**30, size=settings.views)
            cameras = _fixed_cameras(settings, scene.grid.origin, scene.grid.size)
            return [_Shot(camera, self._scale, int(seed)) for camera, seed in zip(cameras, seeds, strict=True)]
        shots = []
        # Spread round the smoke, which is drawn with no side of its own.
        turn = random.uniform(0.0, 360.0)
        for number in range(settings.views_a_frame):
            rise = np.tan(np.radians(settings.elevation * random.uniform(-1.0, 1.0)))
            extent = EDGE * random.uniform(*settings.zoom)
            view = CameraSettings(toward=(0.0, float(rise), 1.0), extent=extent, resolution=settings.resolution)
            view = view.turned(turn + 360.0 * number / settings.views_a_frame + random.uniform(-20.0, 20.0))
            low, high = np.log(settings.density_scales)
            scale = float(np.exp(random.uniform(low, high)))
            camera = make_camera(view, scene.grid.origin, scene.grid.size)
            shots.append(_Shot(camera, scale, int(random.integers(2**30))))
        return shots


class _Air:
    """A solver that goes on, on a GPU by replays of a graph, with a scene's sources on and off in time."""

    def __init__(self, scene: Scene, solver: Solver) -> None:
        self._solver, self._period = solver, _PERIOD * scene.smoke.substeps
        # In the order in which the solver was given them.
        always: list[Callable[[float], bool]] = [lambda time: True] * len(scene.inlets)
        self._sources = list(zip(solver.sources, [*always, *(s.active for s in scene.sources)], strict=True))
        self._seconds, self._done = scene.step, 0
        moving = any(obstacle.path.moves for obstacle in solver.obstacles)
        self._graphs = solver.device.is_cuda and not moving
        self._graph: wp.Graph | None = None

    def advance(self, steps: int) -> None:
        """Goes on by steps of the air, a multiple of what a graph holds."""
        for _ in range(steps // self._period):
            now = self._done * self._seconds
            active = tuple(source for source, works in self._sources if works(now))
            if active != self._solver.sources:
                self._solver.sources, self._graph = active, None
            self._step()
            self._done += self._period

    def _step(self) -> None:
        # The first steps load the kernels' modules, which a capture must not.
        if not self._graphs or not self._done:
            self._solver.step(_PERIOD)
            return
        if self._graph is None:
            with no_collection(), wp.ScopedCapture(self._solver.device) as capture:
                self._solver.step(_PERIOD)
            self._graph = capture.graph
        wp.capture_launch(self._graph)


class _Clock:
    """Seconds of stages that take turns; on a GPU they are told by the stream itself, without waiting for it."""

    def __init__(self, device: str) -> None:
        self._cuda = device != "cpu"
        self._spans: list[tuple[str, Any, Any]] = []
        self._total = dict.fromkeys(STAGES, 0.0)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begin = self._now()
        yield
        self._spans.append((stage, begin, self._now()))

    def seconds(self) -> dict[str, float]:
        """In all, by stage; waits for the device."""
        for stage, begin, end in self._spans:
            if self._cuda:
                end.synchronize()
            self._total[stage] += begin.elapsed_time(end) / 1000.0 if self._cuda else end - begin
        self._spans.clear()
        return dict(self._total)

    def _now(self) -> Any:
        if not self._cuda:
            return time.perf_counter()
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        return event


def covered(targets: torch.Tensor) -> torch.Tensor:
    """Share of the image with smoke in it, of the emptier of two frames: [N] of a pool's targets."""
    return (targets[:, :, OPACITY_PLANE] > VISIBLE).float().mean((-2, -1)).amin(1)


def load_probe_volume(
    path: str | os.PathLike[str],
    settings: DatasetSettings,
    *,
    device: str = "cpu",
    extinction: float | None = None,
    emission: float = 1.0,
) -> Pool:
    """Makes samples of a volume from anywhere, as a test of what a network has never seen: one for each fixed view.

    Args:
        path: A `.npz` or `.nvdb` volume, as `load_volume` reads it.
        settings: Views and the way of looking are used; the volume's longest edge counts as the box's.
        device: As `wlm.interop.check_device` returns it.
        extinction: Per length of the world, of density 1; None: such that its dense smoke is as thick as a scene's.
        emission: Light given off per length of the world at temperature 1.

    Returns:
        The samples, of a single frame each: the earlier is the later, nothing moves, and the sequence is 0.

    Raises:
        WlmError: As `load_volume`; or the volume holds no smoke and no extinction is given.
    """
    volume = load_volume(path, extinction=1.0, emission=emission, device=check_device(device))
    edge = volume.voxel * max(volume.shape)
    if extinction is None:
        density = volume.density[volume.density > 0]
        if not len(density):
            raise WlmError(f"{path}: density: expected smoke to choose an extinction by, found none")
        extinction = settings.extinction / (edge * float(np.quantile(density.float().cpu().numpy(), _BRIGHT)))
    volume = replace(volume, extinction=extinction)
    cameras = _fixed_cameras(settings, volume.origin, volume.voxel * np.asarray(volume.shape))
    guides, targets = [], []
    for number, camera in enumerate(cameras):
        guides.append(render_guide(volume, camera, settings.guide, settings.look(volume.shape, number)).half())
        targets.append(encode_lightmaps(bake(volume, camera, step=settings.reference_step, estimate=False)).half())
    pairs = [torch.stack([torch.stack(parts)] * 2, 1) for parts in (guides, targets)]
    still = torch.zeros((len(cameras), *pairs[0].shape[1:2], *pairs[0].shape[-2:]), dtype=torch.float16)
    return Pool(*pairs, still.to(device), torch.zeros(len(cameras), dtype=torch.int64, device=device))


def _fixed_cameras(settings: DatasetSettings, origin: Sequence[float] | np.ndarray, size: np.ndarray) -> list[Camera]:
    """The fixed views of a box, all of one extent."""
    extent = _EXTENT * float(np.max(size))
    first = CameraSettings(extent=extent, resolution=settings.resolution)
    turns = settings.arc / settings.views * np.arange(settings.views)
    return [make_camera(first.turned(float(turn)), origin, size) for turn in turns]
