"""A compressed scene of three squares."""

import dataclasses
import json

import numpy as np
import torch
from builders.gltf_scene import Thing, write_scene

from wlm.atlas.data import load
from wlm.atlas.decode import Decoder
from wlm.atlas.fit import compress
from wlm.atlas.model import COARSE_BITS, COUNT_BITS, ENTRY
from wlm.formats.exr import write_exr

STATES = ("dawn", "noon", "night")
# Left, top, right and bottom in the picture from -1 to 1, sheet and rectangle.
_SQUARES = {
    "left": ((-1, -1, 0, 1), 0, (0.5, 1.0, 0.0, 0.0)),
    "above": ((0, 0, 1, 1), 0, (0.5, 1.0, 0.5, 0.0)),
    "below": ((0, -1, 1, 0), 1, (1.0, 1.0, 0.0, 0.0)),
}


def scene_folder(folder, uv_set=1, states=STATES, **settings):
    """Writes the scene, compresses it, saves the model as `made.wlm` and returns it."""
    folder.mkdir()
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    things = []
    for name, ((left, low, right, high), _, _) in _SQUARES.items():
        place = np.array([left, low]) + square * [right - left, high - low]
        position = np.column_stack([place, np.zeros(4)])
        uv = np.column_stack([square[:, 0], 1 - square[:, 1]])
        things.append(Thing(name, position, [[0, 1, 2], [0, 2, 3]], [0.5 + 0 * uv] * uv_set + [uv]))
    path = write_scene(folder / "scene.gltf", things)
    sheets = []
    for number, (height, width) in enumerate(((40, 64), (36, 36))):
        row, column = np.mgrid[:height, :width] / [[[height]], [[width]]]
        for state, share in zip(states, (0.3, 1.0, 0.1), strict=False):
            sky = 1.2 + np.sin(4 * column + number) * np.cos(3 * row)
            lamp = np.exp(-8 * ((row - 0.3) ** 2 + (column - 0.6) ** 2))
            light = share * sky[..., None] * [0.6, 0.8, 1.0] + (1 - share) * lamp[..., None] * [2.0, 1.2, 0.5]
            write_exr(folder / f"{number}_{state}.exr", light)
        sheets.append({"files": [f"{number}_{state}.exr" for state in states]})
    objects = [{"node": name, "sheet": sheet, "scale_offset": place} for name, (_, sheet, place) in _SQUARES.items()]
    text = {"states": states, "sheets": sheets, "objects": objects, "uv_set": uv_set}
    (folder / "lights.json").write_text(json.dumps(text))
    scene = load(path, folder / "lights.json")
    model = compress(scene, views=1, **{"budget": 0.1} | settings)
    if model.lut.shape[2] == ENTRY:
        pages = {name: getattr(model, name) for name in ("texels", "blocks", "block_texels")}
        pages = {name: np.concatenate([0 * each, each]) for name, each in pages.items()}
        second = np.array([0, 0, 0, 1 << (COUNT_BITS + COARSE_BITS)], np.uint16)
        model = dataclasses.replace(model, lut=model.lut + second, **pages)
    model.save(folder / "made.wlm")
    return model


def expected_picture(model, size, state):
    """Returns the squares seen from the front, [size, size, 3], and a mask of the pixels far from tile borders."""
    decoder = Decoder(model)
    picture, inside = np.zeros((size, size, 3)), np.zeros((size, size), bool)
    y, x = 1 - (np.mgrid[:size, :size][0] + 0.5) / size * 2, (np.mgrid[:size, :size][1] + 0.5) / size * 2 - 1
    for (left, low, right, high), sheet, place in _SQUARES.values():
        here = (x > left) & (x < right) & (y > low) & (y < high)
        uv = np.stack([(x[here] - left) / (right - left), 1 - (y[here] - low) / (high - low)], 1)
        uv = (uv * place[:2] + place[2:]).astype(np.float32)
        light = decoder.read(torch.from_numpy(uv), torch.full((len(uv),), sheet), state)
        picture[here] = light.numpy()
        own = model.sheets[sheet]
        at = (uv * [own.width, own.height] - 0.5) / model.profile.tile
        inside[here] = np.abs(at - np.rint(at)).min(1) > 1e-3
    return picture, inside
