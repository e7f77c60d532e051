"""What the exported shader reads: textures of all tiles, the networks in fours, and a table for each hour.

What depends on the hour alone is in its table, so that the shader doesn't compute it in every texel: the places on the
axis of time, each tile's scale, and the first layer's bias with the encoded time in it. `wlm.lightmap.exporter` writes
these, `wlm.lightmap.shader` reads them.
"""

import math
from dataclasses import dataclass

import numpy as np

from wlm.errors import WlmError
from wlm.lightmap.exact import SQRT_12
from wlm.lightmap.model import TILE, LightmapModel
from wlm.lightmap.tiles import UNPACKED, TileKind, valid_texels

HEAD = 2
"""Fours in front of the tiles' records in a table."""

MOST_SIDE = 16384
"""Texels along a side of a texture of all tiles."""

MOST_LAYERS = 2048
"""Stored times of tiles that are frames, video or levels."""

CODES = {TileKind.STATIC: 1, TileKind.DYNAMIC: 2, TileKind.FRAMES: 3, **dict.fromkeys(UNPACKED, 4)}
"""A record's first number; 0 of empty and constant tiles."""

_MAPS, _TEMPORAL = 4, 12  # inputs that come from textures, of static and dynamic tiles; then the encoded time


@dataclass(frozen=True, eq=False)
class Texture:
    """A texture of all tiles.

    Attributes:
        data: Bytes or blocks; of an array layer after layer.
        fmt: A key of `wlm.formats.dds.DXGI_FORMATS`.
        width, height: In texels.
        layers: Of an array; 0: it is none.
    """

    data: np.ndarray
    fmt: str
    width: int
    height: int
    layers: int = 0


def fours(model: LightmapModel) -> int:
    """Fours of a layer of the networks, the last filled up with zeros."""
    return -(-model.profile.hidden // 4)


def record(model: LightmapModel) -> int:
    """Fours of a tile's record."""
    return 3 + max(fours(model), 2)


def columns(count: int, height: int, width: int) -> int:
    """Images in a row of a texture of that many, which is about as wide as high."""
    return max(math.ceil(math.sqrt(count * height / width)), 1)


def rows_of(model: LightmapModel) -> np.ndarray:
    """int [tiles], the place of each tile among those of its textures: dynamic tiles first, then static; -1: none."""
    rows = np.full(model.kind.size, -1)
    mapped = np.concatenate([np.flatnonzero(model.kind == kind) for kind in (TileKind.DYNAMIC, TileKind.STATIC)])
    rows[mapped] = np.arange(len(mapped))
    for numbers in (np.flatnonzero(model.kind == TileKind.FRAMES), model.unpacked):
        rows[numbers] = np.arange(len(numbers))
    return rows


def textures(model: LightmapModel, bare: bool = False) -> dict[str, Texture]:
    """The textures by name; those of kinds of tiles that the model hasn't are left out.

    Args:
        model: The model.
        bare: Texels of video and levels that belong to no chart are 0, which packs better.

    Raises:
        WlmError: One is larger than GPUs take.
    """
    profile, kinds = model.profile, model.kind[model.mapped]
    order = np.argsort(kinds != TileKind.DYNAMIC, kind="stable")
    side = profile.uvt_resolution
    planes = np.stack([model.ut, model.vt], 1).reshape(-1, *model.ut.shape[1:])
    made = {
        "uv": _sheet(model.uv[order], "BC7_UNORM", TILE, TILE),
        "uvt": _sheet(model.uvt.reshape(-1, *model.uvt.shape[2:]), "BC7_UNORM", side, side),
        "planes": _sheet(planes, "R8G8_UNORM", profile.plane_rows, profile.plane_columns),
        "frames": _layers(model.frames, "BC7_UNORM"),
    }
    if len(model.unpacked):
        words = model.words.astype("<u4")
        if bare:
            words *= np.stack([valid_texels(model.mask, number) for number in model.unpacked.tolist()])[:, None]
        made["video"] = _layers(words.view(np.uint8).reshape(*words.shape, 4), "R10G10B10A2_UNORM")
    made = {name: texture for name, texture in made.items() if texture is not None}
    for name, texture in made.items():
        if max(texture.width, texture.height) > MOST_SIDE or texture.layers > MOST_LAYERS:
            raise WlmError(
                f"{model.name}: cannot export: {name} of all tiles is {texture.width}x{texture.height}x{texture.layers}"
                f", more than {MOST_SIDE}x{MOST_SIDE}x{MOST_LAYERS} texels"
            )
    return made


def _sheet(images: np.ndarray, fmt: str, height: int, width: int) -> Texture | None:
    """Images [n, rows, columns, bytes] of texels or blocks side by side in one texture."""
    if not len(images):
        return None
    across = columns(len(images), height, width)
    data = _side_by_side(images, across)
    return Texture(data, fmt, across * width, -(-len(images) // across) * height)


def _layers(images: np.ndarray, fmt: str) -> Texture | None:
    """Tiles at all times [n, T, rows, columns, bytes], a layer for each time."""
    if not len(images):
        return None
    across = columns(len(images), TILE, TILE)
    data = np.stack([_side_by_side(images[:, i], across) for i in range(images.shape[1])])
    return Texture(data, fmt, across * TILE, -(-len(images) // across) * TILE, images.shape[1])


def _side_by_side(images: np.ndarray, across: int) -> np.ndarray:
    missing = -len(images) % across
    padded = np.concatenate([images, np.zeros((missing, *images.shape[1:]), images.dtype)])
    grid = padded.reshape(-1, across, *images.shape[1:]).swapaxes(1, 2)
    return np.ascontiguousarray(grid).reshape(grid.shape[0] * grid.shape[1], -1, images.shape[-1])


def networks(model: LightmapModel) -> tuple[np.ndarray, np.ndarray]:
    """The networks of all tiles, in the order of `rows_of`: W1, b1, W2, b2, W3 and b3, a row of W for each input.

    Rows are filled up with zeros to fours, and rows of zeros are added for the units that this adds. The centring of
    the textures' features, (f - 1/2) sqrt(12), is in W1 and b1.

    Returns:
        float32 [n, 4], and int [N_m], where each begins.
    """
    hidden, wide = model.profile.hidden, 4 * fours(model)
    made, starts = [np.zeros((0, 4), np.float32)], [0]
    for nets, centred in ((model.net, _TEMPORAL), (model.net_static, _MAPS)):
        for net in nets:
            count = len(net) - 3 * (hidden + 1)
            layers, output = net[:count].astype(np.float64).reshape(-1, hidden), net[count:].reshape(-1, 3)
            inputs = len(layers) - hidden - 2
            # W (f - 1/2) sqrt(12) + b = (sqrt(12) W) f + (b - sqrt(12)/2 W 1).
            layers[:centred] *= SQRT_12
            layers[inputs] -= 0.5 * layers[:centred].sum(0)
            added = wide - hidden
            layers = np.insert(layers, np.full(added, len(layers) - 1), 0.0, axis=0)
            output = np.insert(output.astype(np.float64), np.full(added, hidden), 0.0, axis=0)
            rows = np.pad(layers, ((0, 0), (0, added))).reshape(-1, 4), np.pad(output, ((0, 0), (0, 1)))
            made += [part.astype(np.float32) for part in rows]
            starts.append(starts[-1] + sum(map(len, rows)))
    return np.concatenate(made), np.array(starts[:-1])


def hour_table(model: LightmapModel, time: float, nets: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
    """The table of a stored time, or, of a model whose networks interpolate, of any time.

    Fours of floats: of F_uvt its slices before and after, the share of the second, and the grid's columns; the same of
    F_ut and F_vt, and 0. Then `record` of them for each tile of the grid:

        0    code, place among the tiles of its textures, start of its network, share of the second image
        1    of code 0 its colour; 1 and 2 gain (shift scale); 3 and 4 the least colour, and the first image's layer
        2    of 1 and 2 spread scale; of 3 and 4 the greatest colour
        3    of 1 and 2 the first layer's bias, with the encoded time in it; of 3 and 4, in two, the second image

    Args:
        model: The model.
        time: In the unit of the set's times.
        nets: What `networks` gives, not to compute it for each hour.

    Returns:
        float32 [2 + tiles record, 4].

    Raises:
        ValueError: Between two stored times of a model whose radiance is mixed: there are two tables.
    """
    axis, profile = model.axis, model.profile
    before, after, share = axis.neighbours(time)
    if share and axis.interpolation == "radiance":
        raise ValueError(f"time: expected a stored one, got {time}")
    weights, starts = networks(model) if nets is None else nets
    size, rows = record(model), rows_of(model)
    table = np.zeros((HEAD + model.kind.size * size, 4), np.float32)
    tau = axis.place(time)
    for i, count in enumerate((profile.uvt_slices, profile.plane_rows)):
        table[i, :3] = _between(tau, count, axis.periodic)
    table[0, 3] = model.tile_columns
    tiles = table[HEAD:].reshape(-1, size, 4)
    tiles[:, 0, 0] = [CODES.get(TileKind(int(kind)), 0) for kind in model.kind]
    tiles[:, 0, 1] = np.maximum(rows, 0)
    mixed = lambda values: (1.0 - share) * values[:, before] + share * values[:, after]  # noqa: E731
    constant = mixed(model.constant.astype(np.float64))
    tiles[model.kind == TileKind.CONSTANT, 1, :3] = constant ** (1.0 / profile.gamma)
    scale = mixed(model.scales.astype(np.float64))
    for place, number in enumerate(model.mapped.tolist()):
        start, wide = int(starts[rows[number]]), fours(model)
        shift, spread = model.affine[place].astype(np.float64)
        tiles[number, 0, 2] = start
        tiles[number, 1, :3], tiles[number, 2, :3] = shift * scale[place], spread * scale[place]
        temporal = model.kind[number] == TileKind.DYNAMIC
        inputs = _TEMPORAL if temporal else _MAPS
        encoded = axis.encode(time).astype(np.float64) if temporal else np.zeros(0)
        layer = weights[start + inputs * wide : start + (inputs + len(encoded) + 1) * wide].astype(np.float64)
        layer = layer.reshape(-1, wide, 4)
        tiles[number, 3 : 3 + wide] = layer[-1] + np.tensordot(encoded, layer[:-1], 1)
    framed = np.flatnonzero(model.kind == TileKind.FRAMES)
    for numbers, ranges in ((framed, model.ranges), (model.unpacked, model.word_ranges)):
        held = tiles[numbers]
        held[:, 0, 3] = share
        for first, image in ((1, before), (3, after)):
            held[:, first : first + 2, :3] = ranges[:, image]
            held[:, first, 3] = image
        tiles[numbers] = held
    return table


def hour_tables(model: LightmapModel) -> np.ndarray:
    """The tables of all stored times, float32 [T, rows, 4].

    Raises:
        WlmError: A number of the model isn't finite.
    """
    nets = networks(model)
    tables = np.stack([hour_table(model, float(time), nets) for time in model.times])
    if not (np.isfinite(nets[0]).all() and np.isfinite(tables).all()):
        raise WlmError(f"{model.name}: cannot export: a weight is NaN or infinite")
    return tables


def _between(tau: float, count: int, repeats: bool) -> tuple[int, int, float]:
    """The texels of an axis that a linear filter reads at tau, and the share of the second."""
    position = tau * count - 0.5
    low = math.floor(position)
    pair = [i % count if repeats else min(max(i, 0), count - 1) for i in (low, low + 1)]
    return pair[0], pair[1], position - low
