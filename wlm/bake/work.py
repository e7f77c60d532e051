"""What bakes share: hours one after another, kept in a checkpoint; what the result depends on."""

import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from wlm.bake.settings import BakeScene, load_scene
from wlm.errors import WlmError
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.light import read_light
from wlm.formats.limits import MESH_BYTES
from wlm.formats.parts import Part
from wlm.formats.reading import read_file
from wlm.system import Meter, OnProgress

_REPORTS = 100  # of an hour


@dataclass(frozen=True, eq=False)
class Task:
    """A scene file and what it names.

    Attributes:
        scene: The settings.
        path: The YAML file.
        geometry: The glTF file.
        sky: The sky's picture, float32 [H, W, 3], or None.
        source: 32 hexadecimal digits of BLAKE2b over the geometry and the picture.
        trust: Whether the files may name others outside their folder.
    """

    scene: BakeScene
    path: Path
    geometry: Path
    sky: np.ndarray | None
    source: str
    trust: bool


def open_task(path: str | os.PathLike[str], trust: bool = False, directional: bool = False) -> Task:
    """Reads a scene file and the sky's picture.

    Args:
        path: The YAML file.
        trust: Whether it may name files outside its folder.
        directional: Whether lightmaps tell where their light comes from, also where the file doesn't say so.

    Raises:
        WlmError: A file can't be read, a setting is wrong, or the picture isn't one of light from all around.
    """
    scene, geometry, picture = load_scene(path, trust)
    if directional:
        lightmap = scene.lightmap.model_copy(update={"directional": True})
        scene = scene.model_copy(update={"lightmap": lightmap})
    digest = hashlib.blake2b(read_file(geometry, MESH_BYTES, "the glTF file"), digest_size=16)
    sky = None
    if picture is not None:
        sky = np.ascontiguousarray(read_light(picture)[0][..., :3])
        if not np.isfinite(sky).all() or (sky < 0).any():
            raise WlmError(f"{picture}: expected finite light, not negative")
        if sky.shape[1] != 2 * sky.shape[0]:
            raise WlmError(f"{picture}: expected a picture twice as wide as high, found {sky.shape[1]}x{sky.shape[0]}")
        digest.update(sky)
    return Task(scene, Path(path), geometry, sky, digest.hexdigest(), trust)


def open_checkpoint(
    output: str | os.PathLike[str], task: Task, what: str, device: str, *, resume: bool = False
) -> Checkpoint:
    """Opens the file that keeps a bake's finished hours, beside its output.

    Args:
        output: Of the bake.
        task: The scene.
        what: "lightmaps" or "probes".
        device: "cpu" or "cuda".
        resume: Whether to go on from it, if it is there.

    Raises:
        WlmError: With `resume`: it is damaged, or of another bake.
    """
    # Those of the other bake change nothing.
    settings = task.scene.model_dump(mode="json", exclude={"probes" if what == "lightmaps" else "lightmap"})
    fit = {"input": task.source, "scene": settings, "device": device}
    path = os.path.realpath(output)
    return Checkpoint(path, f"bake-{what}", fit, task.source, resume=resume)


def each_hour(
    hours: Sequence[float],
    checkpoint: Checkpoint | None,
    table: Mapping[str, Part],
    make: Callable[[float, Callable[[float], None]], dict[str, np.ndarray]],
    progress: OnProgress | None,
) -> list[dict[str, np.ndarray]]:
    """Makes what belongs to each hour, but for those that the checkpoint has.

    Args:
        hours: The hours.
        checkpoint: Where they are kept; None: nowhere.
        table: What an hour's result holds.
        make: Makes an hour's, and calls its second argument with the share that is done.
        progress: Called from time to time.
    """
    try:
        return _hours(hours, checkpoint, table, make, Meter(progress, "bake", _REPORTS * len(hours)))
    except KeyboardInterrupt:
        if checkpoint is not None:
            # Hours that come fast aren't written one by one.
            checkpoint.flush()
        raise


def _hours(
    hours: Sequence[float],
    checkpoint: Checkpoint | None,
    table: Mapping[str, Part],
    make: Callable[[float, Callable[[float], None]], dict[str, np.ndarray]],
    meter: Meter,
) -> list[dict[str, np.ndarray]]:
    results = []
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
    return results
