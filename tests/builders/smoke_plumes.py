"""Small smoke for tests: a leaning plume, alone and as the frames of a scene, and cameras in front of it."""

from pathlib import Path

import numpy as np

from wlm.fluid.volume import DensityVolume, from_array, save_volume
from wlm.smoke.camera import Camera
from wlm.smoke.data import Frames, load_frames, open_frames
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
    """Makes a leaning column in the box of SCENE, a third of the box higher with each frame."""
    centres = [(np.arange(n) + 0.5) * 0.05 for n in (20, 24, 20)]
    x, y, z = np.meshgrid(centres[0] - 0.5, centres[1], centres[2] - 0.5, indexing="ij")
    wide = np.hypot(x - 0.15 * y, z) / (0.12 + 0.15 * y)
    density = np.clip(1.6 - wide, 0, 1) * np.clip((0.4 * frame - y) / 0.1, 0, 1)
    temperature = np.clip(1 - y / 0.6, 0, 1) * density if hot else None
    place = {"voxel": 0.05, "origin": (-0.5, 0.0, -0.5)}
    return from_array(density, extinction=8.0, temperature=temperature, device=device, **place)


def unit_grid(n: int) -> list[np.ndarray]:
    """Returns x, y and z of the n^3 voxel centres of the box from -1 to 1."""
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    return np.meshgrid(axis, axis, axis, indexing="ij")


def facing(volume: DensityVolume, way: tuple = (0.0, 0.0, 1.0), size: int = 24, **options) -> Camera:
    """Makes a square camera in front of a volume; the image is 1.1 times the volume's longest edge by default."""
    edge = max(volume.shape) * volume.voxel
    position = volume.centre + 3.3 * edge * np.array(way) / np.linalg.norm(way)
    return Camera.look_at(position, volume.centre, **({"extent": 1.1 * edge, "height": size, "width": size} | options))


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Returns origins and unit directions of the rays through all pixels, in the world, both [H, W, 3]."""
    right, up, toward = camera.axes
    u = (np.arange(camera.width) + 0.5 - 0.5 * camera.width) * camera.pitch
    v = (0.5 * camera.height - np.arange(camera.height) - 0.5) * camera.pitch
    across = u[None, :, None] * right + v[:, None, None] * up
    if camera.perspective:
        way = across - toward
        return np.broadcast_to(camera.position, across.shape), way / np.linalg.norm(way, axis=-1, keepdims=True)
    return across + camera.position, np.broadcast_to(-toward, across.shape)


def write_frames(folder: Path, **changed: object) -> Frames:
    """Writes a folder like that of a simulation."""
    frames = open_frames(folder, Scene.model_validate(SCENE | changed))
    for number in range(1, frames.scene.frames + 1):
        save_volume(frames.file(number), plume(number))
    return load_frames(folder)
