"""Shared code of bakes: reading the scene, and computing the hours in order with a checkpoint."""

import hashlib
import math
import os
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bake.backend import start
from wlm.bake.geometry import Geometry
from wlm.bake.settings import BakeScene
from wlm.config import load_settings
from wlm.dispatch import Place, Task, Whole, gathered
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.light import read_light
from wlm.formats.limits import MESH_BYTES
from wlm.formats.parts import Part
from wlm.formats.reading import named_file, read_file
from wlm.system import Meter, OnProgress

_REPORTS = 100  # progress reports per hour


@dataclass(frozen=True, eq=False)
class Bake:
    """A scene file and the files that it refers to: the settings, the YAML file, the glTF file, and the environment
    map, float32 [H, W, 3] or None. `source` is a hash of geometry and map, 32 hexadecimal digits of BLAKE2b; `trust`
    tells whether the files may refer to files outside their folder."""

    scene: BakeScene
    path: Path
    geometry: Path
    sky: np.ndarray | None
    source: str
    trust: bool


def open_task(path: str | os.PathLike[str], trust: bool = False) -> Bake:
    """Reads a scene file and its environment map.

    With `trust` the file may refer to files outside its folder.

    Raises:
        WlmError: A file can't be read, a setting is wrong, or the image isn't an environment map.
    """
    scene = load_settings(BakeScene, path)
    geometry = named_file(path, scene.geometry, f"{path}: geometry", trust)
    digest = hashlib.blake2b(read_file(geometry, MESH_BYTES, "the glTF file"), digest_size=16)
    sky = None
    if scene.sky is not None and scene.sky.file is not None:
        picture = named_file(path, scene.sky.file, f"{path}: sky.file", trust)
        sky = np.ascontiguousarray(read_light(picture)[0][..., :3])
        if not np.isfinite(sky).all() or (sky < 0).any():
            raise WlmError(f"{picture}: expected finite light of at least 0, found negative, infinite or NaN pixels")
        if sky.shape[1] != 2 * sky.shape[0]:
            raise WlmError(f"{picture}: expected an image twice as wide as high, found {sky.shape[1]}x{sky.shape[0]}")
        digest.update(sky)
    return Bake(scene, Path(path), geometry, sky, digest.hexdigest(), trust)


def open_checkpoint(
    output: str | os.PathLike[str], task: Bake, what: str, device: str, *, resume: bool = False
) -> Checkpoint:
    """Opens the file beside `output` that stores a bake's finished hours; `what` is "lightmaps" or "probes".

    Raises:
        WlmError: With `resume`, the file is damaged or belongs to another bake.
    """
    # Settings of the other kind of bake don't affect the result.
    settings = task.scene.model_dump(mode="json", exclude={"probes" if what == "lightmaps" else "lightmap"})
    fit = {"input": task.source, "scene": settings, "device": device}
    path = os.path.realpath(output)
    return Checkpoint(path, f"bake-{what}", fit, task.source, resume=resume)


def noise_share(values: np.ndarray, noise: np.ndarray) -> float:
    """Returns the RMS of the noise divided by the RMS of the values; 0 if all values are 0."""
    power, error = (float(np.square(each, dtype=np.float64).sum()) for each in (values, noise))
    return math.sqrt(error / power) if power else 0.0


class HourBaker(Whole):
    """Bakes hours of a scene at points: `gather` is the function of `wlm.bake.paths` that takes them, and `world` the
    arguments of `wlm.bake.world.make_hour`."""

    def __init__(self, device: str, gather: str, points: Any, *world: Any) -> None:
        start(device.partition(":")[0])
        self._gather, self._points, self._world = gather, points, world

    def run(self, job: float) -> dict[str, np.ndarray]:
        """Returns the arrays of an hour, as `wlm.bake.paths.Gathered` has them."""
        # Both modules can only be imported after Mitsuba's variant is set.
        from wlm.bake import paths
        from wlm.bake.world import make_hour

        world, tracing = make_hour(*self._world, job)
        return vars(getattr(paths, self._gather)(world, self._points, tracing, report=self.report))


def each_hour(
    task: Bake,
    geometry: Geometry,
    gather: str,
    points: Any,
    shape: tuple[int, int],
    place: Place,
    checkpoint: Checkpoint | None,
    progress: OnProgress | None,
) -> list[dict[str, np.ndarray]]:
    """Bakes the hours of a scene, in ascending order, except those in the checkpoint; for `gather` and `points` see
    `HourBaker`. `shape` is the number of points and of the numbers of each."""
    if place.device != "cpu" and place.cluster is None and (place.workers or 1) > 1:
        raise WlmError(f"workers: expected 1 on a GPU of this machine, as Mitsuba uses the first, got {place.workers}")
    table = {
        "mean": Part(np.float32, shape, least=0.0 if gather == "irradiance" else None),
        "noise": Part(np.float32, shape, least=0.0),
        "back": Part(np.float32, shape[:1], least=0.0, most=1.0),
    }
    # Workers need no part of the file but the surfaces.
    bare = replace(geometry, document=replace(geometry.document, content={}, buffers=()), replacements=())
    worker, hours = (HourBaker, gather, points, task.scene, bare, task.sky), sorted(task.scene.hours)
    meter = Meter(progress, "bake", _REPORTS * len(hours))
    tasks = [Task((i,), _REPORTS, partial(float, hour), table=table) for i, hour in enumerate(hours)]
    results = gathered(worker, tasks, meter, place, checkpoint)
    return [results[number] for number in range(len(hours))]
