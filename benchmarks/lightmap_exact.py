"""Reference decoder: decodes a stored tile in float64 with plain NumPy; tests compare all other decoders with it."""

import math

import numpy as np
from scipy.special import erf

from wlm.formats.bc7 import decode_image
from wlm.lightmap.model import SheetModel, decode_scale
from wlm.lightmap.tiles import TILE, TileKind


def decode_tile64(model: SheetModel, number: int, time: float) -> np.ndarray:
    """Decodes one tile in float64: evaluates its network (neural-dynamic-gi, eq. 4) and undoes the scale of section 4.

    Args:
        model: The sheet.
        number: Number of the tile in the grid, row-major.
        time: In the unit of the set's times, stored or between.

    Returns:
        Linear radiance, float64 [128, 128, 3]; gaps between charts are not filled; 0 in an empty tile.
    """
    _check(model, number, time)
    if model.kind[number] == TileKind.CONSTANT:
        return np.broadcast_to(_constant(model, number, time), (TILE, TILE, 3)).copy()
    if model.kind[number] == TileKind.FRAMES:
        before, after, share = model.axis.neighbours(time)
        early, late = (_frame(model, number, at) ** model.profile.gamma for at in (before, after))
        return (1.0 - share) * early + share * late
    return sum(share * _colour(model, number, at) ** model.profile.gamma for at, share in model.axis.reads(time))


def colour_tile64(model: SheetModel, number: int, time: float) -> np.ndarray:
    """Decodes one tile to gamma space, radiance ** (1 / gamma), float64 [128, 128, 3]; see `decode_tile64`."""
    return decode_tile64(model, number, time) ** (1.0 / model.profile.gamma)


def _colour(model: SheetModel, number: int, time: float) -> np.ndarray:
    """Evaluates the network of a tile at one time, in gamma space [128, 128, 3]; 0 in an empty tile."""
    if model.kind[number] == TileKind.EMPTY:
        return np.zeros((TILE, TILE, 3))
    before, after, share = model.axis.neighbours(time)
    row = model.row(number)
    scale = model.scales[row].astype(np.float64)  # [T, 3]
    shift, spread = model.affine[row].astype(np.float64)
    output = _network_output(model, row, time)
    colour = (shift + spread * output) * ((1.0 - share) * scale[before] + share * scale[after])
    return np.maximum(colour, 0.0)


def bound64(model: SheetModel, number: int, time: float) -> float:
    """Returns the gamma-space colour that byte 255 of the 8-bit output stands for; 0 for a black or an empty tile.

    Args:
        model: The sheet.
        number: Number of the tile in the grid.
        time: In the unit of the set's times. Between two stored times, the larger of the two colours is returned.
    """
    _check(model, number, time)
    if model.kind[number] == TileKind.EMPTY:
        return 0.0
    if model.kind[number] == TileKind.CONSTANT:
        return float(_constant(model, number, time).max() ** (1.0 / model.profile.gamma))
    before, after, share = model.axis.neighbours(time)
    if model.kind[number] == TileKind.FRAMES:
        peak = model.ranges[model.row(number), :, 1].max(1)
    else:
        peak = decode_scale(model.peak[model.row(number)], model.profile.gamma)
    return float(peak[before] if share == 0 else max(peak[before], peak[after]))


def _check(model: SheetModel, number: int, time: float) -> None:
    model.grid.origin(number)
    model.axis.wrap(time)


def _frame(model: SheetModel, number: int, at: int) -> np.ndarray:
    row = model.row(number)
    levels = decode_image(model.frames[row, at])[..., :3] / 255.0
    least, greatest = model.ranges[row, at].astype(np.float64)
    return least + levels * (greatest - least)


def _constant(model: SheetModel, number: int, time: float) -> np.ndarray:
    before, after, share = model.axis.neighbours(time)
    rows = model.constant[model.row(number)].astype(np.float64)
    return (1.0 - share) * rows[before] + share * rows[after]


def _network_output(model: SheetModel, row: int, time: float) -> np.ndarray:
    """Returns the output of a tile's network at one time, normalised colour [128, 128, 3]."""
    profile, periodic, tau = model.profile, model.axis.periodic, model.axis.place(time)
    centres = (np.arange(TILE) + 0.5) / TILE
    slices = decode_image(model.uvt[row]) / 255.0  # [S, R, R, 4]
    volume = _along(slices, np.array([tau]), periodic)[0]
    volume = _along(_along(volume, centres).swapaxes(0, 1), centres).swapaxes(0, 1)
    maps = [decode_image(model.uv[row]) / 255.0, volume]
    for plane, shape in ((model.ut, (1, TILE, 2)), (model.vt, (TILE, 1, 2))):
        line = _along(_along(plane[row] / 255.0, np.array([tau]), periodic)[0], centres)
        maps.append(np.broadcast_to(line.reshape(shape), (TILE, TILE, 2)))
    features = (np.concatenate(maps, axis=2) - 0.5) * math.sqrt(12.0)  # mean 0 and deviation 1 if they are uniform
    turn = (2.0 if periodic else 1.0) * math.pi * tau
    encoded = [math.sin(turn), math.cos(turn), math.sin(2.0 * turn), math.cos(2.0 * turn)]
    features = np.concatenate([features, np.broadcast_to(encoded, (TILE, TILE, 4))], axis=2)

    width, net = profile.hidden, model.net[row].astype(np.float64)
    split = (16 + width + 2) * width
    hidden, output = net[:split].reshape(-1, width), net[split:].reshape(-1, 3)
    x = _gelu(features @ hidden[:16] + hidden[16], profile.gelu)
    x = _gelu(x @ hidden[17:-1] + hidden[-1], profile.gelu)
    return x @ output[:-1] + output[-1]


def _along(values: np.ndarray, at: np.ndarray, periodic: bool = False) -> np.ndarray:
    """Interpolates the first axis linearly at coordinates in [0, 1]; texel centres are at (i + 1/2) / size."""
    size = len(values)
    position = at * size - 0.5
    low = np.floor(position).astype(int)
    share = (position - low).reshape(-1, *(1,) * (values.ndim - 1))
    pair = np.stack([low, low + 1])
    pair = pair % size if periodic else np.clip(pair, 0, size - 1)
    return (1.0 - share) * values[pair[0]] + share * values[pair[1]]


def _gelu(x: np.ndarray, kind: str) -> np.ndarray:
    if kind == "exact":
        return 0.5 * x * (1.0 + erf(x / math.sqrt(2.0)))
    return 0.5 * x * (1.0 + np.tanh(math.sqrt(2.0 / math.pi) * (x + 0.044715 * x**3)))
