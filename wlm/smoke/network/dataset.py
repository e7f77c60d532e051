"""Samples that are simulated on the device during a training (neural-six-way-lightmaps, sections 4.4 and 5).

The paper stores 25,200 images of 14 sequences. Here nothing is stored: the samples of a round depend only on
settings, seed and round. Scenes are drawn at random, simulated, and rendered from several sides. A sample has two
successive frames, each with its guiding map and its lightmaps, and the motion between the frames. Images show only
smoke: obstacles shape the smoke but are not rendered (section 5).

Lengths are shares of the box's edge, so that a smaller grid gives the same images. The guiding maps of a trained
network must be made with `DatasetSettings.look` of the settings that it was trained with.
"""

from collections.abc import Sequence
from dataclasses import fields, replace
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from wlm.dispatch import Place, Task, Whole, gathered
from wlm.errors import WlmError
from wlm.fluid.solver import Solver
from wlm.interop import check_device, stream
from wlm.smoke.camera import Camera
from wlm.smoke.march.motion import motion
from wlm.smoke.march.six_way import bake
from wlm.smoke.network.planes import GUIDES, PLANES, Pool, encode_lightmaps, render_guide
from wlm.smoke.network.scenes import draw_scene, generator
from wlm.smoke.network.settings import EDGE, PERIOD, DatasetSettings
from wlm.smoke.scene import CameraSettings, Scene, make_camera
from wlm.smoke.simulation import make_solver, sources_at, volume_of
from wlm.system import Meter, OnProgress

ATTEMPTS = 8
"""Number of scenes drawn for a sequence before an error."""

_EXTENT = 1.1  # image edge of a fixed view over the box's edge
_EARLY = 0.35  # factor of the warmup for sources that stop early


def make_pool(
    settings: DatasetSettings,
    *,
    seed: int,
    round: int = 0,
    device: str = "cpu",
    place: Place | None = None,
    progress: OnProgress | None = None,
) -> Pool:
    """Makes the samples of one training round, from sequences that no other round uses.

    Args:
        settings: Settings of the samples.
        seed: Seed of all rounds, at least 0.
        round: Number of the round, from 0.
        device: "cpu", "cuda" or "cuda:N".
        place: Where sequences are made side by side, with the same result; None: one after another on the device.
        progress: Called after each sequence.

    Returns:
        At most sequences x frames x views_a_frame samples, on the device. The same arguments give the same bits on one
        device.
    """
    numbers = range(round * settings.sequences, (round + 1) * settings.sequences)
    return _pool((settings, seed, False), numbers, device, place, progress)


def make_validation(
    settings: DatasetSettings,
    device: str = "cpu",
    *,
    test: bool = False,
    place: Place | None = None,
    progress: OnProgress | None = None,
) -> Pool:
    """Makes the samples of the validation or, with `test_seed`, the test set; each pair of frames is rendered from all
    fixed views. No training round uses the sequences of these sets."""
    seed = settings.test_seed if test else settings.validation_seed
    return _pool((settings, seed, True), range(settings.validation_sequences), device, place, progress)


def _pool(arguments: tuple, numbers: range, device: str, place: Place | None, progress: OnProgress | None) -> Pool:
    """Makes sequences by `SequenceMaker`, which takes the arguments; returns the samples of all in one pool."""
    meter = Meter(progress, "dataset", len(numbers), every=0.0)
    tasks = [Task((each,), 1, partial(int, each)) for each in numbers]
    made = gathered((SequenceMaker, *arguments), tasks, meter, place or Place(device))
    parts = ([getattr(made[each], name.name) for each in numbers] for name in fields(Pool))
    return Pool(*map(torch.cat, parts)).to(check_device(device))


def fixed_cameras(settings: DatasetSettings, origin: Sequence[float] | np.ndarray, size: np.ndarray) -> list[Camera]:
    """Returns the cameras of the fixed views of a box with corner `origin` [3] and edges `size` [3] in the world."""
    first = CameraSettings(extent=_EXTENT * float(np.max(size)), resolution=settings.resolution)
    turns = settings.arc / settings.views * np.arange(settings.views)
    return [make_camera(first.turned(float(turn)), origin, size) for turn in turns]


class _Shot(NamedTuple):
    """A view of a pair of frames: camera, factor of the extinction, and seed of the jitter in the first frame."""

    camera: Camera
    scale: float
    seed: int


class SequenceMaker(Whole):
    """Simulates and renders sequences of a training, validation or test set, by their numbers."""

    def __init__(self, device: str, settings: DatasetSettings, seed: int, validation: bool) -> None:
        self._settings, self._seed, self._validation = settings, seed, validation
        self._device = check_device(device)

    def run(self, job: int) -> Pool:
        """Simulates a random scene, or the next one if it is unstable; returns its samples in the host's memory."""
        for attempt in range(ATTEMPTS):
            index = job * ATTEMPTS + attempt
            settings = self._sequence_settings(index)
            scene = draw_scene(settings, self._seed, index, validation=self._validation)
            random = generator(self._validation, self._seed, index, 1)
            solver = make_solver(scene, device=self._device)
            try:
                with stream(self._device):
                    guides, targets, moved = self._render(settings, scene, solver, random)
                solver.check()
            except WlmError as error:
                # `make_solver` has checked the memory, so the flow is unstable.
                problem = str(error)  # the error's traceback would keep the solver in memory
                continue
            if not all(bool(torch.isfinite(part).all()) for part in (guides, targets, moved)):
                problem = "NaN or infinity in its images"
                continue
            # Negative in validation and test, unlike numbers of training sequences.
            label = -1 - index if self._validation else index
            sequence = torch.full((len(guides),), label, dtype=torch.int64, device=guides.device)
            pool = Pool(guides, targets, moved, sequence)
            covered = pool.covered().cpu().numpy()
            kept_at_random = random.random(len(covered)) < self._settings.kept_empty
            keep = np.flatnonzero((covered > self._settings.least_coverage) | kept_at_random)
            return pool.take(torch.from_numpy(keep).to(pool.device)).to("cpu")
        raise WlmError(f"{ATTEMPTS} random scenes in a row were unstable, the last with the problem: {problem}")

    def _sequence_settings(self, index: int) -> DatasetSettings:
        settings = self._settings
        if settings.least_cells is None or self._validation:
            return settings
        low, high = np.log(settings.least_cells), np.log(settings.cells)
        cells = np.exp(generator(self._validation, self._seed, index, 2).uniform(low, high))
        return settings.model_copy(update={"cells": round(float(cells))})

    def _render(
        self, settings: DatasetSettings, scene: Scene, solver: Solver, random: np.random.Generator
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Simulates a scene and renders its pairs of frames; returns the guides, targets and motion of a `Pool`."""
        simulation = _Simulation(scene, solver)
        views = settings.views if self._validation else settings.views_a_frame
        size = (settings.frames * views, 2)
        pixels = (settings.resolution, settings.resolution)
        half = {"dtype": torch.float16, "device": self._device}
        guides = torch.empty((*size, len(GUIDES[settings.guide]), *pixels), **half)
        targets = torch.empty((*size, len(PLANES), *pixels), **half)
        moved = torch.empty((*size, *pixels), **half)
        early = _EARLY if any(source.stop is not None for source in scene.sources) else 1.0
        simulation.advance(settings.lattice_steps(early * settings.warmup * random.uniform(0.6, 1.6)))
        for pair in range(settings.frames):
            shots = self._shots(scene, random)
            for frame in range(2):
                if pair or frame:
                    simulation.advance(settings.steps if frame else settings.lattice_steps(settings.apart))
                smoke = volume_of(scene, solver)
                for number, shot in enumerate(shots, pair * views):
                    volume = replace(smoke, extinction=smoke.extinction * shot.scale)
                    march = settings.look(volume.shape, shot.seed + frame)
                    guides[number, frame] = render_guide(volume, shot.camera, settings.guide, march)
                    six = bake(volume, shot.camera, step=settings.reference_step, estimate=False)
                    targets[number, frame] = encode_lightmaps(six)
                    if frame:
                        reach = scene.grid.cell * settings.steps
                        moved[number] = motion(volume, solver.velocity, shot.camera, reach=reach)
        return guides, targets, moved

    def _shots(self, scene: Scene, random: np.random.Generator) -> list[_Shot]:
        """Returns the views of a pair of frames: in validation all fixed views, in training random views."""
        settings = self._settings
        if self._validation:
            seeds = random.integers(2**30, size=settings.views)
            cameras = fixed_cameras(settings, scene.grid.origin, scene.grid.size)
            return [_Shot(camera, 1.0, int(seed)) for camera, seed in zip(cameras, seeds, strict=True)]
        shots = []
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


class _Simulation:
    """Advances a solver and switches the scene's sources on and off."""

    def __init__(self, scene: Scene, solver: Solver) -> None:
        self._solver, self._period = solver, PERIOD * scene.smoke.substeps
        self._scene, self._done = scene, 0

    def advance(self, steps: int) -> None:
        """Advances the smoke by `steps` air steps, which must be a multiple of the steps in one CUDA graph."""
        for _ in range(steps // self._period):
            self._solver.sources = tuple(sources_at(self._scene, self._done * self._scene.step))
            self._solver.step(PERIOD)
            self._done += self._period
