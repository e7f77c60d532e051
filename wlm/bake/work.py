"""Shared code of bakes: reading the scene, and computing the hours in order with a checkpoint."""

import hashlib
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.bake.settings import BakeScene
from wlm.config import load_settings
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.light import read_light
from wlm.formats.limits import MESH_BYTES
from wlm.formats.parts import Part
from wlm.formats.reading import named_file, read_file
from wlm.system import Meter, OnProgress

_REPORTS = 100  # progress reports per hour


@dataclass(frozen=True, eq=False)
class Task:
    """A scene file and the files that it refers to: the settings, the YAML file, the glTF file, and the environment
    map, float32 [H, W, 3] or None. `source` is a hash of geometry and map, 32 hexadecimal digits of BLAKE2b; `trust`
    tells whether the files may refer to files outside their folder.
    """

    scene: BakeScene
    path: Path
    geometry: Path
    sky: np.ndarray | None
    source: str
    trust: bool


def open_task(path: str | os.PathLike[str], trust: bool = False) -> Task:
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
    return Task(scene, Path(path), geometry, sky, digest.hexdigest(), trust)


def open_checkpoint(
    output: str | os.PathLike[str], task: Task, what: str, device: str, *, resume: bool = False
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


def each_hour(
    hours: Sequence[float],
    checkpoint: Checkpoint | None,
    table: Mapping[str, Part],
    make: Callable[[float, Callable[[float], None]], dict[str, np.ndarray]],
    progress: OnProgress | None,
) -> list[dict[str, np.ndarray]]:
    """Computes the result of each hour, except those in the checkpoint.

    `make(hour, report)` computes the arrays of an hour, which `table` describes, and calls `report` with the finished
    share of the work; `progress` is called regularly.
    """
    meter, results = Meter(progress, "bake", _REPORTS * len(hours)), []
    try:
        for number, hour in enumerate(hours):
            result = None if checkpoint is None else checkpoint.finished(number, table)
            if result is None:

                def report(share: float, number: int = number) -> None:
                    done = int(_REPORTS * (number + share))
                    if meter.due(done):
                        meter.report(done)

                result = make(hour, report)
                if checkpoint is not None:
                    checkpoint.add_finished(number, result)
            meter.report(_REPORTS * (number + 1))
            results.append(result)
    except KeyboardInterrupt:
        if checkpoint is not None:
            # Hours that finish quickly aren't written individually.
            checkpoint.flush()
        raise
    return results
