"""Small smoke for tests: a leaning plume, alone and as the frames of a scene."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from wlm.fluid.volume import DensityVolume, from_array, save_volume
from wlm.smoke.data import Frames, frame_file, open_frames, read_frames
from wlm.smoke.scene import Scene

SCENE = {
    "name": "plume",
    "grid": {"cells": [5, 6, 5], "cell": 0.2, "refine": 4, "origin": [-0.5, 0.0, -0.5]},
    "smoke": {"extinction": 8.0},
    "inlets": [{"face": "-y", "velocity": [0, 1, 0], "radius": 0.2}],
    "camera": {"resolution": 24},
    "frames": 3,
    "rate": 10.0,
}
"""A box of 1 x 1.2 x 1 m of 20 x 24 x 20 voxels."""

SPHERE = {"radius": 0.15, "path": [[0, -0.4, 0.6, 0.3], [0.4, 0.4, 0.6, 0.3]]}
"""An obstacle that crosses the box before the plume."""


def plume(frame: int = 3, *, hot: bool = False, device: str = "cpu") -> DensityVolume:
    """A column of SCENE's box that rises by a third of it a frame, thicker and leaning as it rises."""
    centres = [(np.arange(n) + 0.5) * 0.05 for n in (20, 24, 20)]
    x, y, z = np.meshgrid(centres[0] - 0.5, centres[1], centres[2] - 0.5, indexing="ij")
    wide = np.hypot(x - 0.15 * y, z) / (0.12 + 0.15 * y)
    density = np.clip(1.6 - wide, 0, 1) * np.clip((0.4 * frame - y) / 0.1, 0, 1)
    temperature = np.clip(1 - y / 0.6, 0, 1) * density if hot else None
    place = {"voxel": 0.05, "origin": (-0.5, 0.0, -0.5)}
    return from_array(density, extinction=8.0, temperature=temperature, device=device, **place)


def write_frames(folder: Path, **changed: object) -> Frames:
    """A folder as a simulation leaves it."""
    frames = open_frames(folder, Scene.model_validate(SCENE | changed))
    for number in range(1, frames.scene.frames + 1):
        save_volume(folder / frame_file(number), plume(number))
    return read_frames(folder)
