"""Exports a lightmap model for shaders: textures of all tiles, the networks, and a table of numbers for each hour.

The table of an hour holds all numbers that only depend on the hour, so that the shader does not compute them for every
texel: the positions on the time axis, the scale of each tile, and the bias of its network's first layer, to which the
contribution of the encoded time has been added.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from wlm.bundle import Bundle, Texture
from wlm.errors import WlmError
from wlm.formats.folder import rounded
from wlm.lightmap.decode import SheetDecoder
from wlm.lightmap.encodings import ENCODINGS, encoding_of
from wlm.lightmap.encodings.maps import shader_networks
from wlm.lightmap.model import LightmapModel, SheetModel
from wlm.lightmap.profile import encode_time
from wlm.lightmap.shader import EXACT, HEAD, decode_glsl, record_fours
from wlm.lightmap.sheet import Sheet
from wlm.lightmap.tiles import TILE, TileKind

MOST_SIDE = 16384
"""Largest side of a texture of all tiles, in texels."""

MOST_LAYERS = 2048
"""Largest number of layers of a texture array, and so of stored times if tiles are stored as frames."""

_ABOUT = {
    "tiles": "Tiles of tile_size texels at (column, row) of the grid. A tile that is not listed is empty: 0.",
    "images": "Each texture has images of all its tiles from left to right, across of them in a row. uv: image of a "
    "tile. uvt: slice s of a tile is image * slices + s. planes: F_ut is 2 * image, F_vt 2 * image + 1, time along "
    "the rows. frames is an array: layer i has the image of each tile at stored time i.",
    "time": "Wrap t modulo the period (without one clamp it to the stored times) and find the stored times around it; "
    "with a period the last and the first are neighbours. share is the position of t between the two, 0 to 1.",
    "interpolation": "Light between two stored times. radiance: decode both and mix their linear radiance by share "
    "(eq. 2). network: decode once, with tau and scale interpolated.",
    "tau": "Position on the textures' time axis: tau[i] of stored time i. Between two, tau[i] + share * (step), the "
    "step to the next one; for the rule 'frames' it is 1/T, and tau is taken modulo 1 if time_axis.repeats. For the "
    "rule 'paper' with a period tau is t / period.",
    "hours": "The buffer hours has a table for each stored time, hour_fours times four floats, which the shader reads. "
    "Fours 0 and 1: for F_uvt, and for F_ut and F_vt, the slices or rows before and after tau, and the share of the "
    "later one. Then record fours for each tile of the grid, in order: code (0 empty, 1 constant, 3 dynamic, 4 "
    "frames), image, network_four, share of the later frame. Code 1: colour. 3: shift * scale, spread * scale, then b1 "
    "with the encoded time in it: b1 + its four rows of W1 times sin, cos(turn * tau), sin, cos(2 turn * tau). "
    "4: least and layer, greatest, of the earlier, then of the later frame. "
    "Between two stored times, if interpolation is network, a table is computed in the same way.",
    "colour": "(shift + spread * y) * scale, not below 0, is the colour in gamma space; y is the output of the network "
    "(the shader). radiance = colour ** gamma, linear RGB. scale is interpolated linearly between stored times.",
    "peak": "An upper bound of the tile's colour in gamma space: the value of 255 if colour is kept in 8 bits. "
    "Between two stored times the larger one holds.",
    "network": "h1 = gelu(x W1 + b1), h2 = gelu(h1 W2 + b2), y = h2 W3 + b3, a row of W for each input. x is uv[4], "
    "uvt[4], ut[2], vt[2] as sampled, in [0, 1], then the encoded time[4]. The buffer "
    "networks has float32 W1 b1 W2 b2 W3 b3 of each tile, the rows filled up with zeros to fours, and rows of zeros "
    "added for those; a tile's begin at four network_four.",
    "radiance": "Linear RGB of a constant tile at each stored time, interpolated linearly.",
    "frames": "A tile of frames has an image for each stored time and no network: colour is least[i] + level * "
    "(greatest[i] - least[i]). Between two stored times their radiance is mixed, whatever interpolation says.",
}

_VALUES = (
    "The values of the colours 0 and 1: the texels are values, not light. In place of radiance read values[0] + "
    "colour * (values[1] - values[0]); gamma is 1."
)

_SHEETS = (
    "Each part is a sheet: up to three channels of a layer of an atlas, in the order of red, green and blue. Light of "
    "sheets that differ only in their group is added, weighted; each group has its own times."
)


def bundle(model: LightmapModel, *, device: str = "cpu") -> Bundle:
    """Makes the bundle of a model, or a collection with a bundle for each sheet if the model has several sheets;
    `device` decodes the reference image."""
    if len(model.sheets) == 1:
        ((sheet, own),) = model.sheets.items()
        return sheet_bundle(sheet, own, model.name, model.source, device)
    parts, sheets = {}, []
    for number, (sheet, own) in enumerate(model.sheets.items()):
        part = f"sheet_{number:02d}"
        # Engines name materials and shaders after the bundle.
        name = f"{model.name} {sheet.label.replace('/', ' ')}"
        parts[part] = sheet_bundle(sheet, own, name, model.source, device)
        named = {"atlas": sheet.atlas, "layer": sheet.layer, "channels": list(sheet.channels)}
        named["group"] = sheet.group
        sheets.append({"part": part} | named | {"encoding": sheet.encoding, "width": own.width, "height": own.height})
    document = {"about": _SHEETS, "times": model.times.tolist(), "period": model.period, "sheets": sheets}
    return Bundle("lightmap", model.name, "", document | {"source": model.source}, parts=parts)


def sheet_bundle(sheet: Sheet, model: SheetModel, name: str, source: str, device: str = "cpu") -> Bundle:
    """Makes the bundle (shader, textures and buffers) of one sheet, which has up to three channels of a layer.

    The textures `uv` (BC7) and `uvt` (BC7) hold the feature maps F_uv and F_uvt of all tiles, `planes` (R8G8_UNORM)
    holds F_ut and F_vt side by side (neural-dynamic-gi, table 1), `frames` (BC7) has a layer for each stored time, and
    `valid` is 255 inside charts. BC7 blocks are copied from the model without re-encoding. The buffer `networks`,
    float32 [n, 4], holds the weights, and `hours` the result of `hour_tables`. The reference image `frame` is the map
    at the first stored time, decoded on `device`.
    """
    textures = {key: texture for encoding in ENCODINGS for key, texture in encoding.textures(model).items()}
    for key, texture in textures.items():
        if max(texture.width, texture.height) > MOST_SIDE or texture.layers > MOST_LAYERS:
            raise WlmError(
                f"{name}: cannot export: {key} of all tiles is {texture.width}x{texture.height}x{texture.layers}, more "
                f"than {MOST_SIDE}x{MOST_SIDE}x{MOST_LAYERS} texels"
            )
    networks, hours = shader_networks(model), hour_tables(model, model.times.tolist())
    if not (np.isfinite(networks).all() and np.isfinite(hours).all()):
        raise WlmError(f"{name}: cannot export: a weight is NaN or infinite")
    buffers = {"hours": hours} | ({"networks": networks} if len(networks) else {})
    document = _document(model, textures, source) | {"hour_fours": hours.shape[1]}
    if sheet.values is not None:
        document |= {"values": list(sheet.values), "about": _ABOUT | {"values": _VALUES}}
    mask = model.mask.astype(np.uint8) * 255
    textures["valid"] = Texture(mask, "R8_UNORM", model.width, model.height)
    frame = SheetDecoder(model, device).frame(float(model.times[0]))
    if sheet.values is not None:
        frame = np.float32(sheet.values[0]) + np.float32(sheet.span) * frame
    shader = decode_glsl(model, sheet.values)
    compute = decode_glsl(model, sheet.values, pairs=True) if len(networks) else ""
    return Bundle("lightmap", name, shader, document, textures, buffers, {"frame": frame}, exact=EXACT, compute=compute)


def hour_tables(model: SheetModel, times: Sequence[float]) -> np.ndarray:
    """Computes the tables that the shader reads for stored times, or for any times if the model interpolates with the
    network (`Profile.interpolation`): float32 [times, rows, 4], two rows, then `record_fours` rows for each tile.

    The bundle's JSON document describes the content of a table under "about" and "hours". In addition, the fourth
    number of a table is the number of tile columns of the grid. Raises a ValueError for a time between two stored times
    if the model blends their radiance, which needs two tables.
    """
    axis, profile, size = model.axis, model.profile, record_fours(model)
    tables = np.zeros((len(times), HEAD + model.kind.size * size, 4), np.float32)
    for table, time in zip(tables, times, strict=True):
        if axis.neighbours(time)[2] and axis.interpolation == "radiance":
            raise ValueError(f"time: expected one of the stored times, got {time}")
        tau = axis.place(time)
        for i, count in enumerate((profile.uvt_slices, profile.plane_rows)):
            table[i, :3] = _between(tau, count, axis.periodic)
        table[0, 3] = model.grid.cols
    records = tables[:, HEAD:].reshape(len(times), -1, size, 4)
    records[:, :, 0, 0] = model.kind
    for encoding in ENCODINGS:
        encoding.fill_records(model, times, records)
    return tables


def _document(model: SheetModel, textures: dict[str, Texture], source: str) -> dict[str, Any]:
    profile, axis = model.profile, model.axis
    sides = {
        "uvt": (profile.uvt_resolution, profile.uvt_resolution),
        "planes": (profile.plane_columns, profile.plane_rows),
    }
    images = {}
    for name, texture in textures.items():
        width, height = sides.get(name, (TILE, TILE))
        images[name] = {"size": [width, height], "across": texture.width // width}
    tiles = []
    for number in np.flatnonzero(model.kind).tolist():
        row, column = divmod(number, model.grid.cols)
        kind = TileKind(int(model.kind[number]))
        tile = {"number": number, "kind": kind.name.lower(), "column": column, "row": row}
        tiles.append(tile | encoding_of(kind).describe(model, number))
    return {
        "about": _ABOUT,
        "source": source,
        "width": model.width,
        "height": model.height,
        "tile_size": TILE,
        "tile_columns": model.grid.cols,
        "gamma": profile.gamma,
        "hidden": profile.hidden,
        "gelu": profile.gelu,
        "times": model.times.tolist(),
        "interpolation": profile.interpolation,
        "period": model.period,
        "time_axis": {"rule": axis.kind, "repeats": axis.periodic, "turn": axis.turn},
        "tau": rounded(encode_time(axis)[0]),
        "slices": profile.uvt_slices,
        "record": record_fours(model),
        "images": images,
        "tiles": tiles,
    }


def _between(tau: float, count: int, repeats: bool) -> tuple[int, int, float]:
    """Returns the two texels that a linear filter reads at position `tau` in [0, 1], and the second texel's weight."""
    position = tau * count - 0.5
    low = int(np.floor(position))
    pair = [i % count if repeats else min(max(i, 0), count - 1) for i in (low, low + 1)]
    return pair[0], pair[1], position - low
