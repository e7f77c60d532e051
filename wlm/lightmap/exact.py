"""The float64 path: a stored tile decoded in plain NumPy, the reference of every other decoder."""

import math

import numpy as np
from scipy.special import erf

from wlm.errors import WlmError
from wlm.formats.bc7 import blocks_image, decode_image
from wlm.formats.bc7_modes import decode_blocks
from wlm.lightmap.model import TILE, LightmapModel, decode_scale
from wlm.lightmap.tiles import UNPACKED, TileGrid, TileKind
from wlm.lightmap.video_packing import WHITE, levels_of

SQRT_12 = math.sqrt(12.0)
"""Features in [0, 1] are fed to the network as (f - 1/2) sqrt(12): mean 0 and deviation 1 if they are uniform."""

_IMAGES = (TileKind.FRAMES, *UNPACKED)


def decode_tile64(model: LightmapModel, number: int, time: float) -> np.ndarray:
    """Decodes one tile in float64 (neural-dynamic-gi, eq. 4, with the scale of section 4 undone).

    Args:
        model: The model.
        number: Of the tile in the grid, row-major.
        time: In the unit of the set's times, stored or between, as for `wlm.lightmap.decode.Decoder`; gaps are left.

    Returns:
        Linear radiance, float64 [128, 128, 3]; 0 in an empty tile.

    Raises:
        WlmError: There is no such tile, or the time isn't finite.
    """
    _check(model, number, time)
    if model.kind[number] == TileKind.CONSTANT:
        return _filled(_constant(model, number, time))
    if model.kind[number] in _IMAGES:
        before, after, share = model.axis.neighbours(time)
        early, late = (_frame(model, number, at) ** model.profile.gamma for at in (before, after))
        return (1.0 - share) * early + share * late
    return sum(share * _colour(model, number, at) ** model.profile.gamma for at, share in model.axis.reads(time))


def colour_tile64(model: LightmapModel, number: int, time: float) -> np.ndarray:
    """The same tile in gamma space, radiance ** (1 / gamma): float64 [128, 128, 3]; see `decode_tile64`."""
    _check(model, number, time)
    kind = model.kind[number]
    if kind == TileKind.EMPTY:
        return np.zeros((TILE, TILE, 3))
    if kind == TileKind.CONSTANT:
        return _filled(_constant(model, number, time) ** (1.0 / model.profile.gamma))
    reads = model.axis.reads(time)
    if kind in _IMAGES and model.axis.neighbours(time)[2] == 0:
        return _frame(model, number, model.axis.neighbours(time)[0])
    if kind not in _IMAGES and len(reads) == 1:
        return _colour(model, number, reads[0][0])
    return decode_tile64(model, number, time) ** (1.0 / model.profile.gamma)


def _colour(model: LightmapModel, number: int, time: float) -> np.ndarray:
    """What the network of a tile makes of one time, in gamma space [128, 128, 3]; 0 in an empty tile."""
    if model.kind[number] == TileKind.EMPTY:
        return np.zeros((TILE, TILE, 3))
    before, after, share = model.axis.neighbours(time)
    place = _place(model, number)
    scale = model.scales[place].astype(np.float64)  # [T, 3]
    shift, spread = model.affine[place].astype(np.float64)
    output = _network_output(model, number, place, time)
    colour = (shift + spread * output) * ((1.0 - share) * scale[before] + share * scale[after])
    return np.maximum(colour, 0.0)


def bound64(model: LightmapModel, number: int, time: float) -> float:
    """Gamma-space colour that 255 of the 8-bit output stands for; 0 for a black or an empty tile.

    Args:
        model: The model.
        number: Of the tile in the grid.
        time: Between two stored times the larger of the two bounds holds.

    Raises:
        WlmError: As `decode_tile64`.
    """
    _check(model, number, time)
    if model.kind[number] == TileKind.EMPTY:
        return 0.0
    if model.kind[number] == TileKind.CONSTANT:
        return float(_constant(model, number, time).max() ** (1.0 / model.profile.gamma))
    before, after, share = model.axis.neighbours(time)
    if model.kind[number] == TileKind.FRAMES:
        peak = model.ranges[_row(model, number), :, 1].max(1)
    elif model.kind[number] in UNPACKED:
        peak = model.word_peaks[_row(model, number)]
    else:
        peak = decode_scale(model.peak[_place(model, number)], model.profile.gamma)
    return float(peak[before] if share == 0 else max(peak[before], peak[after]))


def _check(model: LightmapModel, number: int, time: float) -> None:
    TileGrid.of(model.height, model.width).origin(number)
    if not math.isfinite(time):
        raise WlmError(f"time: expected a finite number, got {time}")


def _place(model: LightmapModel, number: int) -> int:
    """The tile's place among those that have maps."""
    return int((model.mapped < number).sum())


def _row(model: LightmapModel, number: int) -> int:
    """The tile's place among those of its kind; of video and levels among both."""
    kind = TileKind(int(model.kind[number]))
    return int(np.isin(model.kind[:number], UNPACKED if kind in UNPACKED else (kind,)).sum())


def _frame(model: LightmapModel, number: int, at: int) -> np.ndarray:
    """A frame of a tile in gamma space [128, 128, 3]."""
    row = _row(model, number)
    if model.kind[number] in UNPACKED:
        least, greatest = model.word_ranges[row, at].astype(np.float64)
        return least + levels_of(model.words[row, at]) / WHITE * (greatest - least)
    levels = blocks_image(decode_blocks(model.frames[row, at]))[..., :3] / 255.0
    least, greatest = model.ranges[row, at].astype(np.float64)
    return least + levels * (greatest - least)


def _constant(model: LightmapModel, number: int, time: float) -> np.ndarray:
    """Radiance of a constant tile [3]."""
    before, after, share = model.axis.neighbours(time)
    rows = model.constant[_row(model, number)].astype(np.float64)
    return (1.0 - share) * rows[before] + share * rows[after]


def _filled(colour: np.ndarray) -> np.ndarray:
    return np.broadcast_to(colour, (TILE, TILE, 3)).copy()


def _network_output(model: LightmapModel, number: int, place: int, time: float) -> np.ndarray:
    """The network's output y [128, 128, 3]."""
    profile = model.profile
    dynamic = model.kind[number] == TileKind.DYNAMIC
    row = _row(model, number)
    maps = [decode_image(model.uv[place]) / 255.0]
    if dynamic:
        periodic = model.axis.periodic
        tau = model.axis.place(time)
        centres = (np.arange(TILE) + 0.5) / TILE
        slices = np.stack([decode_image(s) for s in model.uvt[row]]) / 255.0  # [S, R, R, 4]
        volume = _along(slices, np.array([tau]), periodic)[0]
        volume = _along(_along(volume, centres).swapaxes(0, 1), centres).swapaxes(0, 1)
        maps.append(volume)
        for plane, shape in ((model.ut, (1, TILE, 2)), (model.vt, (TILE, 1, 2))):
            line = _along(_along(plane[row] / 255.0, np.array([tau]), periodic)[0], centres)
            maps.append(np.broadcast_to(line.reshape(shape), (TILE, TILE, 2)))
    features = (np.concatenate(maps, axis=2) - 0.5) * SQRT_12
    if dynamic:
        turn = (2.0 if model.axis.periodic else 1.0) * math.pi * model.axis.place(time)
        encoded = [math.sin(turn), math.cos(turn), math.sin(2.0 * turn), math.cos(2.0 * turn)]
        features = np.concatenate([features, np.broadcast_to(encoded, (TILE, TILE, 4))], axis=2)

    width, inputs = profile.hidden, profile.inputs(bool(dynamic))
    net = (model.net if dynamic else model.net_static)[row].astype(np.float64)
    split = (inputs + width + 2) * width
    hidden, output = net[:split].reshape(-1, width), net[split:].reshape(-1, 3)
    act = _gelu_exact if profile.gelu == "exact" else _gelu_tanh
    x = act(features @ hidden[:inputs] + hidden[inputs])
    x = act(x @ hidden[inputs + 1 : -1] + hidden[-1])
    return x @ output[:-1] + output[-1]


def _along(values: np.ndarray, at: np.ndarray, periodic: bool = False) -> np.ndarray:
    """Interpolates the first axis linearly at coordinates in [0, 1]; cell centres lie at (i + 1/2) / size."""
    size = len(values)
    position = at * size - 0.5
    low = np.floor(position).astype(int)
    share = (position - low).reshape(-1, *(1,) * (values.ndim - 1))
    pair = np.stack([low, low + 1])
    pair = pair % size if periodic else np.clip(pair, 0, size - 1)
    return (1.0 - share) * values[pair[0]] + share * values[pair[1]]


def _gelu_exact(x: np.ndarray) -> np.ndarray:
    return 0.5 * x * (1.0 + erf(x / math.sqrt(2.0)))


def _gelu_tanh(x: np.ndarray) -> np.ndarray:
    return 0.5 * x * (1.0 + np.tanh(math.sqrt(2.0 / math.pi) * (x + 0.044715 * x**3)))
