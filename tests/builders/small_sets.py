"""Lightmap sets of one to four tiles, and settings with which a fit takes a moment."""

from pathlib import Path

import numpy as np
from PIL import Image

from wlm.formats.exr import write_exr
from wlm.lightmap.data import LightmapSet, SheetFrames, from_arrays, load
from wlm.lightmap.profile import Profile

HOURS = (0.0, 5.0, 11.0, 13.5, 20.0)


def tiny_profile(**settings) -> Profile:
    """Networks of sizes that all these tests share, so that each kernel is compiled once; no tile is frames."""
    sizes = {"hidden": 16, "uvt_resolution": 8, "uvt_slices": 4, "plane_columns": 16, "plane_rows": 8}
    return Profile(name="tiny", **sizes | {"steps": 20, "samples": 128, "frames": "never"} | settings)


def moving_light(height=128, width=128, hours=HOURS, period=24.0, mask=None, seed=0, gain=1.0) -> LightmapSet:
    """A spot that moves with the hour over a rough wall."""
    v, u = np.mgrid[:height, :width] / 128.0
    wall = np.random.default_rng(seed).uniform(0.6, 1.0, (height, width, 3))
    frames = []
    for hour in hours:
        turn = 2.0 * np.pi * hour / 24.0
        spot = np.exp(-8.0 * ((u % 1.0 - 0.5 - 0.3 * np.cos(turn)) ** 2 + (v % 1.0 - 0.5 - 0.3 * np.sin(turn)) ** 2))
        frames.append(gain * (0.2 + spot[..., None] * [1.0, 0.8, 0.5]) * wall)
    return from_arrays(np.stack(frames), hours, mask, period, name="moving")


def four_tiles(holes: np.ndarray | None = None) -> LightmapSet:
    """Makes two dynamic tiles, a constant and an empty one; `holes`, bool [256, 256], are outside the mask too."""
    frames = np.zeros((5, 256, 256, 3), np.float32)
    frames[:, :128] = moving_light(128, 256).light.frames
    frames[:, 128:, :128] = (1.0 + np.arange(5.0))[:, None, None, None] / 5.0
    mask = np.ones((256, 256), bool)
    mask[128:, 128:] = False
    return from_arrays(frames, HOURS, mask if holes is None else mask & ~holes, 24.0, name="four tiles")


def write_set(folder: Path, lightmaps: LightmapSet) -> None:
    """Writes the frames of a set into a new folder, and its mask if not all is valid; their names tell their hours."""
    folder.mkdir()
    light = lightmaps.light
    if not light.mask.all():
        Image.fromarray(light.mask.astype(np.uint8) * 255).save(folder / "mask.png")
    for time, frame in zip(light.times, light.frames, strict=True):
        write_exr(folder / f"light_{time:05.2f}h.exr".replace(".", "_", 1), frame, half=False)


def load_sheet(*args, **options) -> SheetFrames:
    """Reads the first sheet of light of a set."""
    return load(*args, **options).light


def sheet_from_arrays(*args, **options) -> SheetFrames:
    """Makes the sheet of a set from arrays."""
    return from_arrays(*args, **options).light
