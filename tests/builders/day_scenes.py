"""A scene of known light: a floor and a wall of one colour each, a moving square, and smoke."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from builders.gltf_maker import GltfMaker
from builders.synthetic import random_sheet

import wlm
from wlm.formats.exr import write_exr
from wlm.lightmap.model import LightmapModel
from wlm.lightmap.sheet import Sheet
from wlm.smoke.camera import Camera

TIMES = (0.0, 6.0, 12.0, 18.45, 18.55, 22.0)
"""Hours of the lightmaps: a lamp is switched between 18.45 and 18.55."""
SKY = np.array([[0.1, 1.0, 4.0, 1.0, 9.0, 8.0], [0.2, 0.5, 2.0, 0.5, 3.0, 3.0]])[..., None] * [1.0, 0.8, 0.5]
"""Irradiance of the group "sky": of the floor and of the wall at each time, [2, T, 3]."""
SUN = np.array([[0.0, 0.5, 3.0, 0.25, 0.25, 0.0], [0.0, 1.0, 1.0, 1.0, 1.0, 0.0]])[..., None] * [1.0, 0.9, 0.8]
"""Irradiance of the group "sun"."""
FLOOR, WALL, SQUARE = (0.5, 0.5, 0.5), (0.8, 0.2, 0.1), (0.25, 0.5, 1.0)
"""Base colours."""
LIGHT = {0.0: 0.25, 12.0: 3.0}
"""Radiance that is the same in all directions, at the hours of the probes."""
HEIGHT, WIDTH, SEEN = 108, 247, 128
"""Texels of the lightmap, and columns of the floor's tile."""


def square(corners: Any, colour: Any, uv: Any = None) -> dict[str, np.ndarray]:
    """Attributes of a square with one colour."""
    made = {"POSITION": np.array(corners, np.float32), "COLOR_0": np.tile(np.float32(colour), (4, 1))}
    return made | ({} if uv is None else {"TEXCOORD_0": np.array(uv, np.float32)})


def write_glb(path: Path, squares: list[dict[str, np.ndarray]]) -> Path:
    """Writes squares, each as a mesh of its own."""
    maker = GltfMaker()
    corners = maker.add(np.array([0, 1, 2, 0, 2, 3], np.uint16))
    primitives = [{"attributes": {n: maker.add(a) for n, a in each.items()}, "indices": corners} for each in squares]
    meshes = [{"primitives": [each]} for each in primitives]
    nodes = [{"mesh": i} for i in range(len(meshes))]
    maker.content |= {"scene": 0, "scenes": [{"nodes": list(range(len(nodes)))}], "nodes": nodes, "meshes": meshes}
    return maker.save(path)


def model() -> LightmapModel:
    """Two constant tiles in each of two groups."""
    made = {}
    for group, light in {"sky": SKY, "sun": SUN}.items():
        sheet = random_sheet(kinds=(1, 1), times=TIMES)
        made[Sheet(group=group)] = replace(sheet, name="room", constant=light.astype(np.float16))
    return LightmapModel("room", "0123456789abcdef", sheet.profile, made)


def write_scene(folder: Path, **changes: Any) -> Path:
    """Writes the scene with changed keys, and returns the path of its YAML file."""
    u = SEEN / WIDTH
    floor = [[-2, 0, 2], [2, 0, 2], [2, 0, -2], [-2, 0, -2]], FLOOR, [[0, 1], [u, 1], [u, 0], [0, 0]]
    wall = [[-2, 0, -2], [2, 0, -2], [2, 3, -2], [-2, 3, -2]], WALL, [[u, 1], [1, 1], [1, 0], [u, 0]]
    write_glb(folder / "room.glb", [square(*floor), square(*wall)])
    write_glb(folder / "car.glb", [square([[-0.4, 0, 0], [0.4, 0, 0], [0.4, 0.6, 0], [-0.4, 0.6, 0]], SQUARE)])
    model().save(folder / "room.wlm")
    y, x, z = np.mgrid[0:4, -2:3, -2:3].reshape(3, -1)
    values = np.zeros((len(LIGHT), len(x), 9, 3))
    values[:, :, 0] = np.array(list(LIGHT.values()))[:, None, None] * np.sqrt(4 * np.pi)  # that of even light
    values[:, :, 1] = 1e-3 * np.random.default_rng(0).standard_normal((len(x), 3))  # components need some variance
    position = np.stack([x, y, z], 1).astype(float)
    probes = wlm.probe.from_arrays(position, values.reshape(len(LIGHT), len(x), 27), times=list(LIGHT))
    wlm.probe.compress(probes, "pca", positions=True).save(folder / "probes.wlm")
    (folder / "smoke").mkdir()
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), extent=1.0, height=8, width=8)
    for number in (1, 2):
        maps = torch.full((6, 8, 8), 0.2 * number)
        six = wlm.smoke.SixWay(maps, torch.full((8, 8), 0.5), camera=camera)
        wlm.smoke.write_six_way(folder / "smoke" / f"six_{number:04}.exr", six)
    for index, hour in ((2, 12.0), (5, 22.0)):
        light = np.repeat((SKY + SUN)[:, index], [SEEN, WIDTH - SEEN], 0).astype(np.float32)
        write_exr(folder / f"original_{hour:.2f}h.exr", np.broadcast_to(light, (HEIGHT, WIDTH, 3)))
    return write_file(folder / "room.yaml", **changes)


def write_file(path: Path, **changes: Any) -> Path:
    """Writes the scene's YAML file with changed keys; None removes a key."""
    content = {
        "title": "a room",
        "mesh": "room.glb",
        "light": "room.wlm",
        "probes": "probes.wlm",
        "sky": [
            {"hour": 0, "colour": [0.0, 0.0, 0.1], "exposure": 1.0},
            {"hour": 12, "colour": [0.5, 0.6, 0.8], "exposure": -1.0},
        ],
        "moving": [{"mesh": "car.glb", "path": [[-0.6, 0.2, -1], [-0.6, 0.2, 1]], "seconds": 4}],
        "smoke": [{"files": "smoke", "position": [1, 0.2, -1], "size": 1.0, "rate": 2}],
        "camera": [
            {"second": 0, "eye": [0, 1.5, 4], "target": [0, 1, 0], "fov": 60},
            {"second": 2, "eye": [0.5, 1.5, 4], "target": [0, 1, 0], "fov": 60},
            {"second": 4, "eye": [0, 1.5, 3.5], "target": [0, 1, 0], "fov": 60},
        ],
        "day": {"first": 5, "last": 29, "seconds": 4},
        "originals": ["original_12.00h.exr", "original_22.00h.exr"],
    } | changes
    path.write_text(yaml.safe_dump({name: value for name, value in content.items() if value is not None}))
    return path
