"""Layered lightmap sets and models of one or two small atlases."""

import json
from pathlib import Path

import numpy as np
from builders.small_sets import HOURS, moving_light
from builders.synthetic import random_sheet
from PIL import Image

from wlm.formats.exr import write_exr
from wlm.lightmap.data import Layer, LightmapSet, from_layers
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.sheet import Sheet

SHEETS = (
    Sheet("a", "light", ("R", "G", "B"), "radiance"),
    Sheet("a", "dir", ("R", "G", "B"), "signed"),
    Sheet("a", "dir", ("A",), "signed"),
    Sheet("b", "light", ("R", "G", "B"), "radiance"),
)


def random_layers(**settings) -> LightmapModel:
    """A model of random maps: atlas a with gaps and four more channels, atlas b of light alone."""
    mask = np.random.default_rng(3).random((108, 119)) < 0.7
    linear = {"gamma": 1.0, "peak": 1.0}
    models = [
        random_sheet((3,), 1, seed=1, mask=mask, **settings),
        random_sheet((4,), 1, seed=2, mask=mask, **linear, **settings),
        random_sheet((1,), 1, seed=3, mask=mask, **linear, **settings),
        random_sheet((3, 0), 2, seed=4, **settings),
    ]
    for model in models[1:]:
        model.mask = mask if model.mask.shape == mask.shape else model.mask
    return LightmapModel("random", "fedcba9876543210", models[0].profile, dict(zip(SHEETS, models, strict=True)))


def turning_directions(height=128, width=128, hours=HOURS) -> np.ndarray:
    """Directions of a light that goes round, on a wall of bumps: unit vectors, float32 [T, H, W, 3]."""
    v, u = np.mgrid[:height, :width] / 20.0
    turn = 2.0 * np.pi * np.array(hours)[:, None, None] / 24.0
    x, y = np.cos(turn) + 0.4 * np.sin(u), np.sin(turn) + 0.4 * np.cos(v)
    z = np.full_like(x, 0.5)
    return (np.stack([x, y, z], -1) / np.sqrt(x**2 + y**2 + z**2)[..., None]).astype(np.float32)


def small_layers(height=128, width=128, hours=HOURS, period=24.0) -> LightmapSet:
    """Light, directions and a mask of three channels, of which one is zero and two are equal."""
    light, directions = moving_light(height, width, hours).light.frames, turning_directions(height, width, hours)
    mask = np.zeros((len(hours), height, width, 3), np.float32)
    mask[..., 1] = mask[..., 2] = light[..., 0] / light.max()
    layers = [Layer(light, "light"), Layer(mask, "shadow", encoding="unit")]
    layers.insert(1, Layer(directions, "dir", encoding="signed"))
    return from_layers(layers, hours, period=period, name="layers")


def write_unity(folder: Path, hours=(0.0, 12.0), atlases=2) -> None:
    """Writes states of light as Unity names them: a folder for each, `day_12h`; atlas n is 16 + 8 n texels high."""
    folder.mkdir()
    for hour in hours:
        state = folder / f"day_{hour:g}h"
        state.mkdir()
        for atlas in range(atlases):
            random = np.random.default_rng([int(hour), atlas])
            size = (16 + 8 * atlas, 12)
            light = random.random((*size, 4)) + 0.5
            light[:3, ..., 3] = 0.0
            write_exr(state / f"Lightmap-{atlas}_comp_light.exr", light, half=False)
            directions = random.integers(0, 256, (*size, 4), np.uint8)
            Image.fromarray(directions).save(state / f"Lightmap-{atlas}_comp_dir.png")


def write_set_json(folder: Path, **changes: object) -> Path:
    """Writes a `set.json` of one atlas and one state over `a.exr`; a change to None takes its key out."""
    content = {"name": "room", "layers": {"light": "radiance"}, "atlases": {"0": {}}}
    content["lightmaps"] = [{"time_hours": 3.0, "files": {"0": {"light": "a.exr"}}}]
    content = {key: value for key, value in (content | changes).items() if value is not None}
    (folder / "set.json").write_text(json.dumps(content))
    return folder / "set.json"
