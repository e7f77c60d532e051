"""Light groups over the same UVs: sky and sun by the hour, and lamps."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from builders.small_sets import HOURS, moving_light
from builders.synthetic import random_sheet

from benchmarks.lightmap_exact import decode_tile64
from wlm.formats.exr import write_exr
from wlm.lightmap.data import LightmapSet, from_arrays
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.sheet import LIGHT
from wlm.lightmap.tiles import place
from wlm.texels import near_gaps

DARK = "unlit"
"""A group without light in the model of `random_groups`."""


def random_groups(mask: np.ndarray | None = None) -> LightmapModel:
    """A model of random maps of four tiles: every kind of tile meets every other, and groups have their own times."""
    sheets = {
        "sky": random_sheet((3, 3, 3, 0), seed=1, mask=mask),
        "sun": random_sheet((1, 4, 3, 3), times=(6.0, 12.5, 18.0), seed=2, mask=mask),
        "lamp": random_sheet((4, 3, 0, 1), times=(0.0,), seed=3, mask=mask),
        DARK: random_sheet((1, 1, 1, 0), times=(0.0,), seed=4, mask=mask),
    }
    sheets[DARK].constant[:] = 0.0
    for own in sheets.values():
        own.mask = sheets["sky"].mask
    named = {replace(LIGHT, group=group): own for group, own in sheets.items()}
    return LightmapModel("random groups", "0123456789abcdef", sheets["sky"].profile, named)


def few_texels() -> LightmapModel:
    """A model of two groups whose file is small: constants and frames of a few valid texels."""
    mask = np.zeros((108, 247), bool)
    mask[7:9, 100:140] = True
    sheets = {"sky": random_sheet((1, 4), times=(0.0, 7.5, 19.0), seed=1, mask=mask)}
    sheets["lamp"] = random_sheet((4, 1), times=(0.0,), seed=2, mask=mask)
    named = {replace(LIGHT, group=group): own for group, own in sheets.items()}
    return LightmapModel("few texels", "0123456789abcdef", sheets["sky"].profile, named)


def sum64(model: LightmapModel, time: float, weights: dict[str, tuple[float, float, float]]) -> np.ndarray:
    """The sum of the groups in float64 NumPy, [H, W, 3], gaps filled; a group that is not named has the weight 1."""
    whole = np.zeros((model.light.height, model.light.width, 3))
    for sheet, own in model.sheets.items():
        frame, numbers = np.zeros_like(whole), np.flatnonzero(own.kind)
        place(frame, np.stack([decode_tile64(own, int(number), time) for number in numbers]), numbers, own.grid)
        whole += np.asarray(weights.get(sheet.group, (1.0, 1.0, 1.0))) * frame
    for target, source in zip(*near_gaps(model.light.mask), strict=True):
        whole[tuple(target)] = whole[tuple(source)]
    return whole


def lit_sets(size: int = 128) -> dict[str, LightmapSet]:
    """Sky and sun at different hours, and three lamps with one lightmap each."""
    v, u = np.mgrid[:size, :size] / 128.0
    wall = np.random.default_rng(5).uniform(0.6, 1.0, (size, size, 1))
    sets = {"sky": moving_light(size, size, HOURS[:3], gain=0.3), "sun": moving_light(size, size, HOURS[2:], seed=1)}
    for i, colour in enumerate(([1.0, 0.7, 0.4], [0.3, 0.5, 1.0], [0.8, 0.8, 0.8])):
        spot = np.exp(-20.0 * ((u - 0.25 * (i + 1)) ** 2 + (v - 0.5) ** 2))[..., None] * wall * colour
        sets[f"lamp {i}"] = from_arrays(spot[None], [0.0], name=f"lamp {i}")
    return sets


def write_groups(folder: Path, sets: dict[str, LightmapSet], **changes: object) -> Path:
    """Writes a `set.json` that names the groups of sets of one sheet, and their EXRs; returns its path."""
    folder.mkdir()
    groups = []
    for number, (name, own) in enumerate(sets.items()):
        lightmaps = []
        for i, frame in enumerate(own.light.frames):
            lightmaps.append({"file": f"{number}_{i}.exr", "time_hours": float(own.times[i])})
            write_exr(folder / lightmaps[-1]["file"], frame, half=False)
        if len(own.times) == 1:
            del lightmaps[0]["time_hours"]
        groups.append({"name": name, "lightmaps": lightmaps})
    (folder / "set.json").write_text(json.dumps({"name": "lit", "period_hours": 24, "groups": groups} | changes))
    return folder / "set.json"
