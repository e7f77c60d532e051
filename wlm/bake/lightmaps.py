"""Bakes a scene's lightmaps for each hour: irradiance and noise per texel, coverage, and the set's `set.json`."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wlm.bake.backend import start
from wlm.bake.geometry import Geometry, check_lamps, read_geometry
from wlm.bake.texels import Texels, place_texels
from wlm.bake.work import Bake, each_hour, noise_share
from wlm.dispatch import Place
from wlm.errors import WlmError, one_line
from wlm.formats.checkpoint import Checkpoint
from wlm.formats.exr import HALF_MAX, write_exr, write_planes
from wlm.formats.folder import compact_json, staged
from wlm.formats.gltf_writer import write_glb
from wlm.formats.hdr_blocks import need
from wlm.formats.mask import write_mask
from wlm.system import OnProgress
from wlm.texels import fill_gaps

INDEX = "bake.json"
FORMAT = "wlm-bake"
_VERSION = 1
SET_FILE = "set.json"
_MESH, _MASK, _COVERAGE = "scene.glb", "mask.png", "coverage.exr"
_HIDDEN = 0.5  # share of rays that hit back faces above which a texel counts as inside an object
_ABOUT = (
    "set.json lists the lightmaps. noise_*.exr: the standard error of each texel's light before denoising, as noise.R, "
    "noise.G and noise.B. coverage.exr: coverage, the share of a texel that is on a surface, and back, the share of "
    "rays that hit backs: above one half the texel is within an object, and has its neighbours' light."
)


@dataclass(frozen=True, eq=False)
class BakedLightmaps:
    """The baked lightmaps of a scene, for T hours in ascending order.

    `light`, float16 [T, H, W, 3], is irradiance, outside `mask`, bool [H, W], that of the nearest valid texel; `noise`
    of this shape is its standard error, 0 outside the charts. `coverage`, float32 [H, W], is the share of each texel
    that is on a surface, and `back` the share of rays that hit back faces. `geometry` has lightmap UVs.
    """

    hours: tuple[float, ...]
    light: np.ndarray
    noise: np.ndarray
    mask: np.ndarray
    coverage: np.ndarray
    back: np.ndarray
    geometry: Geometry

    @property
    def error(self) -> list[float]:
        """The RMS of the noise divided by the RMS of the light for each hour; 0 if all light is 0."""
        return [
            noise_share(light[self.mask], noise[self.mask]) for light, noise in zip(self.light, self.noise, strict=True)
        ]


def bake_lightmaps(
    task: Bake, *, checkpoint: Checkpoint | None = None, progress: OnProgress | None = None, **place: Any
) -> BakedLightmaps:
    """Bakes the lightmap of a scene at each of its hours.

    All hours use the same random numbers, so that remaining noise doesn't flicker between them.

    Args:
        task: The scene, from `wlm.bake.work.open_task`.
        checkpoint: From `wlm.bake.work.open_checkpoint`; None: the bake can't be resumed.
        progress: Called from time to time; a KeyboardInterrupt that it raises leaves a written checkpoint.
        place: `device`, "cpu" or "cuda" (the first GPU), and `workers` and `cluster`, by which hours are baked side by
            side with the same result: see `wlm.dispatch.Place`.

    Raises:
        WlmError: Mitsuba, LLVM or a GPU is missing, the geometry can't be read, lacks lightmap UVs or they overlap, or
            a lamp names a material that doesn't exist.
    """
    scene, where = task.scene, Place(**place)
    if where.cluster is None:
        start(where.device)
    denoise = need("pyoidn", "bake").denoise if scene.denoise else None
    geometry = read_geometry(task.geometry, scene.lightmap, task.trust)
    check_lamps(task.path, scene, geometry)
    texels = place_texels(str(task.geometry), geometry.surfaces, scene.lightmap.resolution, scene.lightmap.supersample)
    shape = len(texels.index), 3
    results = each_hour(task, geometry, "irradiance", texels, shape, where, checkpoint, progress)
    back = np.mean([each["back"] for each in results], axis=0)
    visible = back <= _HIDDEN
    if not visible.any():
        raise WlmError(
            f"{task.geometry}: every texel is inside an object, by the faces around it: turn its faces round"
        )
    mask = texels.image(visible.astype(np.float32)) > 0
    light = np.stack([_finished(texels, each["mean"], mask, denoise).astype(np.float16) for each in results])
    noise = np.stack([texels.image(np.minimum(each["noise"], HALF_MAX)).astype(np.float16) for each in results])
    hours, shares = tuple(sorted(scene.hours)), (texels.image(texels.coverage), texels.image(back.astype(np.float32)))
    return BakedLightmaps(hours, light, noise, mask, *shares, geometry)


def _finished(texels: Texels, values: np.ndarray, mask: np.ndarray, denoise) -> np.ndarray:
    """Makes an image of the texels' values; gaps take the nearest value, and `denoise`, unless None, filters it."""
    picture = fill_gaps(texels.image(np.minimum(values, HALF_MAX)), mask)
    if denoise is not None:
        try:
            picture = denoise(np.ascontiguousarray(picture), filter_type="RTLightmap")
        except RuntimeError as error:
            raise WlmError(f"bake: Open Image Denoise: {one_line(error)}") from error
        picture = fill_gaps(np.clip(picture, 0.0, HALF_MAX), mask)
    return picture


def write_lightmaps(folder: str | os.PathLike[str], task: Bake, baked: BakedLightmaps) -> list[Path]:
    """Writes a lightmap set for `wlm compress`, replacing an earlier one, and returns the paths of its files.

    Raises:
        WlmError: The folder can't be written, or contains files other than an earlier bake.
    """
    folder = Path(folder)
    height, width = baked.mask.shape
    stamps = [f"{hour:.9g}h" for hour in baked.hours]
    listed: dict[str, object] = {"name": task.scene.name, "width": width, "height": height}
    if task.scene.period is not None:
        listed["period_hours"] = task.scene.period
    listed["mask"] = _MASK
    if baked.geometry.usual:  # readers of the set can only select the default UV set
        listed["mesh"] = _MESH
    files = [f"light_{stamp}.exr" for stamp in stamps]
    listed["lightmaps"] = [{"time_hours": hour, "file": file} for hour, file in zip(baked.hours, files, strict=True)]
    with staged(folder, INDEX, FORMAT) as made:
        for file, stamp, light, noise in zip(files, stamps, baked.light, baked.noise, strict=True):
            write_exr(made / file, light)
            planes = dict(zip(("noise.R", "noise.G", "noise.B"), noise.transpose(2, 0, 1), strict=True))
            write_planes(made / f"noise_{stamp}.exr", planes)
        write_planes(made / _COVERAGE, {"coverage": baked.coverage, "back": baked.back})
        write_mask(made / _MASK, baked.mask)
        geometry = baked.geometry
        write_glb(made / _MESH, geometry.document, geometry.replacements, 1)
        (made / SET_FILE).write_text(json.dumps(listed, indent=1) + "\n", encoding="utf-8")
        content = {
            "format": FORMAT,
            "version": _VERSION,
            "about": _ABOUT,
            "scene": task.scene.model_dump(mode="json"),
            "uv_set": geometry.uv_set,
            "error": baked.error,
        }
        (made / INDEX).write_text(compact_json(content), encoding="utf-8")
        written = sorted(path.name for path in made.iterdir())
    return [folder / name for name in written]
