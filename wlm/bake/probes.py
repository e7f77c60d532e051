"""Bakes a scene's light probes for each hour: RGB radiance in spherical harmonics, at the points of a lattice."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bake.backend import start
from wlm.bake.geometry import Geometry, check_lamps, read_geometry
from wlm.bake.settings import ProbeSettings
from wlm.bake.work import Bake, each_hour, noise_share
from wlm.dispatch import Place
from wlm.errors import WlmError
from wlm.formats.atomic import atomic_path
from wlm.formats.checkpoint import Checkpoint
from wlm.probe.conventions import CANONICAL
from wlm.system import OnProgress

_MOST = 1 << 20
_NUMBERS = 27
_HIDDEN = 0.25  # share of rays that hit back faces above which a probe counts as inside an object and is 0


@dataclass(frozen=True, eq=False)
class BakedProbes:
    """The N baked probes of a scene at positions float32 [N, 3], metres, for T hours in ascending order: radiance in
    nine orthonormal spherical harmonics, RGB, float32 [T, N, 9, 3], 0 inside an object, and its standard error."""

    hours: tuple[float, ...]
    position: np.ndarray
    values: np.ndarray
    noise: np.ndarray

    @property
    def error(self) -> list[float]:
        """The RMS of the noise divided by the RMS of the values for each hour; 0 if all values are 0."""
        lit = [values.any(axis=(1, 2)) for values in self.values]
        return [noise_share(v[on], e[on]) for v, e, on in zip(self.values, self.noise, lit, strict=True)]


def place_probes(settings: ProbeSettings, geometry: Geometry) -> np.ndarray:
    """Computes the probes' positions, float32 [N, 3]: the middles of the cells of a lattice in the bounding box."""
    low, high = geometry.box
    # Each axis has the number of cells that fit, at least one.
    cells = np.maximum(1.0, np.floor((high - low) / settings.spacing + 1e-6))
    if (count := float(np.prod(cells))) > _MOST:
        raise WlmError(f"probes.spacing: expected at most {_MOST:,} probes, found {count:,.0f}: use a larger spacing")
    axes = [
        start + (np.arange(int(count)) + 0.5) * ((stop - start) / count)
        for start, stop, count in zip(low, high, cells, strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)


def bake_probes(
    task: Bake, *, checkpoint: Checkpoint | None = None, progress: OnProgress | None = None, **place: Any
) -> BakedProbes:
    """Bakes a scene's probes at each of its hours.

    Args:
        task, checkpoint, progress, place: As for `wlm.bake.bake_lightmaps`.

    Raises:
        WlmError: Mitsuba, LLVM or a GPU is missing, the geometry can't be read, there are too many probes, or a lamp
            names a material that doesn't exist.
    """
    scene, where = task.scene, Place(**place)
    if where.cluster is None:
        start(where.device)
    geometry = read_geometry(task.geometry, None, task.trust)
    check_lamps(task.path, scene, geometry)
    position = place_probes(scene.probes, geometry)
    hours = sorted(scene.hours)

    count = len(position)
    results = each_hour(task, geometry, "harmonics", position, (count, _NUMBERS), where, checkpoint, progress)
    hidden = np.mean([each["back"] for each in results], axis=0) > _HIDDEN
    shape = (len(hours), count, 9, 3)
    values = np.stack([np.where(hidden[:, None], 0.0, each["mean"]) for each in results]).astype(np.float32)
    noise = np.stack([each["noise"] for each in results])
    return BakedProbes(tuple(hours), position, values.reshape(shape), noise.reshape(shape))


def write_probes(path: str | os.PathLike[str], baked: BakedProbes) -> None:
    """Writes probes as `.npz`: `position`; for one hour `sh` and `noise`, for several `sh_HOURh` and `noise_HOURh`.

    Raises:
        WlmError: The file can't be written.
    """
    single = len(baked.hours) == 1
    arrays: dict[str, np.ndarray] = {"position": baked.position, "convention": np.array(CANONICAL)}
    for hour, values, noise in zip(baked.hours, baked.values, baked.noise, strict=True):
        key = "" if single else f"_{hour:.9g}h"
        arrays |= {f"sh{key}": values, f"noise{key}": noise}
    with atomic_path(Path(path)) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **arrays)
